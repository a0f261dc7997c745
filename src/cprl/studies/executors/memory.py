"""What a trial takes of memory: estimated before any has finished, then by what finished ones took."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import make_env, spaces_of
from cprl.experiment import Experiment
from cprl.learners.buffer.storage import storage_bytes, torch_dtype
from cprl.population import Learning, Team
from cprl.studies.status import Status
from cprl.studies.trials import Task, state_of

BASE_BYTES: Final = 850_000_000
"""What a run takes without its buffers, compilation included: torch, Numba, the game, the networks."""
_COPIES: Final = 2
"""A checkpoint is made of a copy of the buffers."""
_MARGIN: Final = 1.1


class MemoryNeeds:
    """The bytes to ask for before a trial is started.

    They are estimated from its replay buffers. Once a trial of the study has finished, estimates are
    multiplied by the largest ratio of what one of them took to what had been estimated for it.

    Args:
        tasks: those of the study; what its finished ones took is in their status files.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._ratio = 0.0
        for task in tasks:
            if state_of(task.directory) == "finished":
                self.learn(task)

    def learn(self, task: Task) -> None:
        """Notes what a finished trial took."""
        taken = Status(Path(task.status), task.name).read().get("peak_bytes", 0)
        if isinstance(taken, int) and taken > 0:
            self._ratio = max(self._ratio, taken / estimated_bytes(task))

    def of(self, task: Task) -> int:
        """What to ask for, a tenth more than is expected."""
        return round(_MARGIN * estimated_bytes(task) * (self._ratio or 1.0))


def estimated_bytes(task: Task) -> int:
    """The largest memory that a trial takes, as far as its recipe says; for algorithms and games of the
    user's own, whose buffers nobody knows, `BASE_BYTES`."""
    buffers = 0
    with suppress(Exception):  # what is wrong with the recipe, or the user's code, the trial says itself
        experiment = Experiment.from_recipe(task.recipe, allow=task.allow, directory=task.directory)
        spaces = _spaces(experiment)
        for own in experiment.agents:
            settings = getattr(getattr(own, "algorithm", None), "settings", None)
            size = getattr(settings, "buffer_size", 0)
            if isinstance(own, Learning | Team) and size:
                members = own.agents if isinstance(own, Team) else (0,)
                buffers += experiment.replicas * len(members) * _buffer_bytes(size, spaces)
    return BASE_BYTES + _COPIES * buffers


def _buffer_bytes(transitions: int, spaces: Spaces) -> int:
    item = torch_dtype(spaces.observation_dtype).itemsize
    return storage_bytes(1, transitions, spaces.observation_shape, item_bytes=item)


def _spaces(experiment: Experiment) -> Spaces:
    if isinstance(experiment.game, Game) and not experiment.transforms:
        return experiment.game.spaces
    return spaces_of(make_env(experiment.game, seed=experiment.seed, transforms=experiment.transforms))
