"""cprl: common-pool resources and multi-agent reinforcement learning, as a modular TorchRL pipeline.

The rooms, in the order in which the data flow:
    keys        every TensorDict entry that is handed on
    process     what a training wants of the process that it runs in
    commons     the game: maps, rules, turns; numpy and numba alone
    envs        doors into it: CommonsEnv for TorchRL
    acting      from seeing to doing: networks, policies, evaluation
    learning    from what happened to better values: settings, losses, the learner
    measuring   from what happened to what it meant: social metrics, episodes
    recording   what is kept: runs, tables, the Rerun recording, figures
    presets     the published games and learners by name
    population  who sits at each seat: learners, scripted and frozen agents
    train       the loop: act, store, learn, measure, record
    study       one study from its learners to its report
    replay      a stored policy plays again, recorded
    evaluation  stored agents in fresh worlds, among themselves and among each other
    reporting   finished runs beside the published study
    cli         the command cprl: watch, replay, report, keep, evaluate, crossplay
"""

from typing import TYPE_CHECKING, Any

from cprl import presets
from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.envs import CommonsEnv
from cprl.training import train

if TYPE_CHECKING:
    from cprl.evaluation import crossplay, evaluate_run
    from cprl.stored import load

__all__ = [
    "CommonsEnv",
    "Game",
    "Map",
    "Observation",
    "Rules",
    "crossplay",
    "evaluate_run",
    "load",
    "maps",
    "presets",
    "train",
]


def __getattr__(name: str) -> Any:
    """What brings all of recording with it, half a second that only those pay who want it."""
    if name == "load":
        from cprl.stored import load

        return load
    if name in ("crossplay", "evaluate_run"):
        from cprl import evaluation

        return getattr(evaluation, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
