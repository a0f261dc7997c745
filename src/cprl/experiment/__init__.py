"""What is trained, as values.

Modules:
    experiment  Experiment: everything that decides a training; EarlierGame, which it plays first
    engine      which engine trains it, if it says "auto"
    presets     the published games and hyper-parameters by name
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cprl.experiment.experiment import EarlierGame, Experiment, changes

__all__ = ["EarlierGame", "Experiment", "changes"]


def __getattr__(name: str) -> Any:
    if name in __all__:  # imports torch, which the published games do not need
        return getattr(import_module("cprl.experiment.experiment"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
