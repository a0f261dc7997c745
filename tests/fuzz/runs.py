"""Small runs that cases read, damage and resume, and trainings that stop after a few steps."""

import atexit
import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any, Final

import torch

import cprl
from cprl import Custom, Experiment
from cprl.collectors import StepCollector
from cprl.config import KINDS, to_config
from cprl.population import Scripted
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.export import export_results

from . import things

NAMES: Final = ("finished", "plain", "stopped", "results", "nothing", "file")
PLACE: Final = "CPRL_FUZZ_RUNS"
"""The environment variable that says where the runs are; workers share those of the process that began."""
STEPS: Final = 9
"""After which the run called "stopped" stopped: after its first episodes, and after its first update."""

CONFIGS: Final = tuple(
    to_config(own) for kind, values in things.EXAMPLES.items() if kind in KINDS.values() for own in values
)
"""Tables that `from_config` reads."""


class Stopped(BaseException):
    """Ends a training that was accepted and has taken its steps; no error."""


def experiment(*, number: int = 2) -> Experiment:
    """A recipe.

    Args:
        number: of episodes.
    """
    return replace(things.EXPERIMENT, episodes=number)


WHOLE: Final = Experiment(
    name="fuzz",
    game=things.MEADOW,
    agents=(things.DQN_AGENT, Scripted("greedy")),
    episodes=3,
    replicas=2,
    evaluation_episodes=1,
    engine="eager",
    transforms=(
        Custom(
            "torchrl.envs.transforms:RewardScaling",
            arguments={"loc": 0.0, "scale": 2.0, "in_keys": [["agents", "reward"]]},
        ),
    ),
    loggers=("csv",),
)
ALLOW: Final = ("torchrl.envs.transforms:RewardScaling",)


@cache
def root() -> Path:
    """The folder of the runs, made at the first call."""
    given = os.environ.get(PLACE)
    if given:
        return Path(given)
    made = Path(tempfile.mkdtemp(prefix="cprl-fuzz-"))
    owner = os.getpid()
    atexit.register(lambda: os.getpid() == owner and shutil.rmtree(made, ignore_errors=True))
    os.environ[PLACE] = str(made)
    _make(made)
    return made


def folder(name: str) -> Path:
    """A run, by one of `NAMES`; nothing may be written to it."""
    return root() / name


_numbers: Final = count()


def copied(name: str) -> Path:
    """A run of its own, in the working directory."""
    target = Path(f"run-{next(_numbers)}")
    shutil.copytree(folder(name), target)
    return target


def _make(place: Path) -> None:
    with open(os.devnull, "w") as null, contextlib.redirect_stdout(null):
        cprl.run(WHOLE, place / "finished", watch="off")
        cprl.run(replace(WHOLE, transforms=(), loggers=()), place / "plain", watch="off")
        with stopped_after(STEPS), contextlib.suppress(Stopped), _saving_each(4):
            cprl.run(WHOLE, place / "stopped", watch="off")
        export_results(place / "finished", place / "results")
    torch.set_flush_denormal(False)
    (place / "nothing").mkdir()
    (place / "file").write_text("no run")


@contextlib.contextmanager
def stopped_after(steps: int) -> Iterator[None]:
    """Every collector ends the training after so many steps."""
    usual = StepCollector.__iter__

    def iterate(self: Any) -> Iterator[Any]:
        turns = usual(self)
        for _ in range(steps):
            yield next(turns)
        raise Stopped

    StepCollector.__iter__ = iterate  # type: ignore[method-assign]
    try:
        yield
    finally:
        StepCollector.__iter__ = usual  # type: ignore[method-assign]


@contextlib.contextmanager
def _saving_each(steps: int) -> Iterator[None]:
    """Checkpoints are saved after so many steps each, not by the clock."""
    usual = Checkpointer.after_step

    def after_step(self: Checkpointer, training: Any) -> None:
        if training.steps % steps == 0:
            self.save(training)

    Checkpointer.after_step = after_step  # type: ignore[method-assign]
    try:
        yield
    finally:
        Checkpointer.after_step = usual  # type: ignore[method-assign]
