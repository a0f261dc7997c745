"""Random numbers of lanes: those of a lane depend on its own seed alone, not on the other lanes."""

from collections.abc import Mapping, Sequence
from enum import Enum, unique
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

DRAWN_AHEAD: Final = 1024
"""Steps whose numbers are generated at once."""

_LARGEST_SEED: Final = 2**63 - 1


@unique
class Purpose(Enum):
    """What an agent's random numbers are for; its value is the end of their seed, after the seed of the run,
    the replica and the agent. So no purpose changes the numbers of another, whatever is added here. numpy
    takes a seed that ends with zeros for the one without them: () and (0,) are one seed, which is harmless
    while weights alone have (0,), since torch generates these."""

    RANDOM_PLAY = ()
    """Actions and decisions of the random play beside a training."""
    WEIGHTS = (0,)
    """Weights of new networks."""
    TARGET_WEIGHTS = (1,)
    """Weights of targets that start as networks of their own."""
    EXPLORATION = (2,)
    """Actions in the training, also of agents that do not learn."""
    SAMPLING = (3,)
    """Which stored turns an update learns from."""
    EVALUATION = (4,)
    """Actions in fresh worlds: in evaluations, and of stored agents."""
    EXHIBITION = (5,)
    """Actions, beside a training, of agents that do not learn in what is shown of it."""
    NOISE = (6,)
    """Uniform numbers by which a loss samples."""
    TEAM_WEIGHTS = (0, 1)
    """Weights of the parts that a team adds to its members' networks; of a team its first member's."""
    TEAM_TARGET_WEIGHTS = (1, 1)
    """Likewise of targets."""
    DECISIONS = (18,)
    """Decisions in the training; behind it stands how often the agent has decided in a world, as behind the
    next two."""
    EVALUATED_DECISIONS = (20,)
    """Decisions in fresh worlds."""
    EXHIBITED_DECISIONS = (21,)
    """Decisions in what is shown of a training."""


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: Purpose
) -> list[tuple[int, ...]]:
    """Return the seed of each lane, replica by replica: (seed of the run, replica, agent, *purpose)."""
    return [(seed, replica, agent, *purpose.value) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """The name of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


def seed_of(seed: Sequence[int]) -> int:
    """The seed of a lane as one for a generator of torch."""
    return int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED)


class LaneRng:
    """Uniform numbers in 0..1, `count` for each lane and step.

    Args:
        seeds: the seed of each lane, e.g. of `lane_seeds`.
        count: numbers per lane and step.
        ahead: steps whose numbers are generated at once; it changes no number.
    """

    def __init__(self, seeds: Sequence[Sequence[int]], count: int, *, ahead: int = DRAWN_AHEAD) -> None:
        self.lanes, self.count, self._ahead = len(seeds), count, ahead
        self._chance = [np.random.Generator(np.random.Philox(np.random.SeedSequence(seed))) for seed in seeds]
        self._numbers = torch.empty((0, self.lanes, count), dtype=torch.float64)
        self._used = 0

    def next(self) -> Tensor:
        """The numbers of the next step, float64 [L, count]."""
        if self._used == len(self._numbers):
            ahead = [chance.random((self._ahead, self.count)) for chance in self._chance]
            self._numbers, self._used = torch.from_numpy(np.stack(ahead, 1)), 0
        self._used += 1
        return self._numbers[self._used - 1]

    def state_dict(self) -> dict[str, Any]:
        return {
            "chance": [_plain(chance.bit_generator.state) for chance in self._chance],
            "numbers": self._numbers,
            "used": self._used,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for chance, generator in zip(self._chance, state["chance"], strict=True):
            chance.bit_generator.state = _arrays(generator)
        self._numbers, self._used = state["numbers"].clone(), int(state["used"])


def _plain(state: Any) -> Any:
    """A generator's state as dicts, lists and numbers, which can be loaded without running code."""
    if isinstance(state, Mapping):
        return {name: _plain(value) for name, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def _arrays(state: Any) -> Any:
    if isinstance(state, Mapping):
        return {name: _arrays(value) for name, value in state.items()}
    return np.array(state, np.uint64) if isinstance(state, list) else state
