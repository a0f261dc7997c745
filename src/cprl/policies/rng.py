"""Seeds, names and random numbers of lanes.

The random numbers of a lane depend on its own seed alone. So an agent acts and learns the same, whether or
not other agents and replicas are computed beside it.
"""

from collections.abc import Mapping, Sequence
from enum import Enum, unique
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

DRAWN_AHEAD: Final = 1024
"""The steps whose random numbers are generated at once, by default."""

_LARGEST_SEED: Final = 2**63 - 1


@unique
class Purpose(Enum):
    """The purposes for which an agent needs random numbers, each with a seed of its own.

    The value of a purpose is the end of its seed, after the seed of the run, the replica and the agent. So a
    new purpose does not change the numbers of the others.

    numpy ignores zeros at the end of a seed, so () and (0,) are the same seed. That is harmless as long as
    (0,) is used for weights alone, which torch generates and not numpy.
    """

    RANDOM_PLAY = ()
    """Actions and decisions of the random play beside a training."""
    WEIGHTS = (0,)
    """Weights of new networks."""
    TARGET_WEIGHTS = (1,)
    """Weights of targets that do not start as copies, see `DQNSettings.own_target_weights`."""
    EXPLORATION = (2,)
    """Actions in the training, of learning and other agents."""
    SAMPLING = (3,)
    """The choice of the stored turns that an update learns from."""
    EVALUATION = (4,)
    """Actions in fresh worlds: in evaluations, and of stored agents."""
    EXHIBITION = (5,)
    """Actions of agents that do not learn, in the game that viewers show beside a training."""
    NOISE = (6,)
    """Uniform numbers by which a loss samples."""
    TEAM_WEIGHTS = (0, 1)
    """Weights of the networks that a team adds to those of its members, such as mixers; a team takes the
    seed of its first member."""
    TEAM_TARGET_WEIGHTS = (1, 1)
    """Weights of the targets of these networks."""
    # After the purposes of decisions the seed has one more number: how often the agent has decided before.
    DECISIONS = (18,)
    """Decisions in the training."""
    EVALUATED_DECISIONS = (20,)
    """Decisions in fresh worlds, in evaluations."""
    EXHIBITED_DECISIONS = (21,)
    """Decisions in the game that viewers show beside a training."""


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: Purpose
) -> list[tuple[int, ...]]:
    """Return the seed of each lane, replica by replica: (seed of the run, replica, agent, *purpose).

    Args:
        seed: the seed of the run.
    """
    return [(seed, replica, agent, *purpose.value) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    """Return the name of an agent of a replica, e.g. "replica_0/agent_0"."""
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """Return the name of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


def seed_of(seed: Sequence[int]) -> int:
    """Return the seed of a lane as one integer, as torch's generators take it."""
    return int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED)


class LaneRng:
    """A generator of uniform numbers in 0..1 for L lanes: `count` numbers for each lane in each step.

    Args:
        seeds: the seed of each lane, see `lane_seeds`.
        count: numbers per lane and step.
        ahead: the steps whose numbers are generated at once; the numbers do not depend on it.
    """

    def __init__(self, seeds: Sequence[Sequence[int]], count: int, *, ahead: int = DRAWN_AHEAD) -> None:
        self.lanes = len(seeds)
        self.count = count
        self._ahead = ahead
        self._generators = [
            np.random.Generator(np.random.Philox(np.random.SeedSequence(seed))) for seed in seeds
        ]
        self._numbers = torch.empty((0, self.lanes, count), dtype=torch.float64)
        self._used = 0

    def next(self) -> Tensor:
        """Return the numbers of the next step, float64 [L, count]."""
        if self._used == len(self._numbers):
            by_lane = [generator.random((self._ahead, self.count)) for generator in self._generators]
            self._numbers = torch.from_numpy(np.stack(by_lane, 1))
            self._used = 0
        self._used += 1
        return self._numbers[self._used - 1]

    def state_dict(self) -> dict[str, Any]:
        return {
            "chance": [_to_plain(generator.bit_generator.state) for generator in self._generators],
            "numbers": self._numbers,
            "used": self._used,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for generator, stored in zip(self._generators, state["chance"], strict=True):
            generator.bit_generator.state = _from_plain(stored)
        self._numbers = state["numbers"].clone()
        self._used = int(state["used"])


def _to_plain(state: Any) -> Any:
    """Return a generator's state as dicts, lists and numbers, which torch can load without running code."""
    if isinstance(state, Mapping):
        return {name: _to_plain(value) for name, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def _from_plain(state: Any) -> Any:
    """Return a generator's state from what `_to_plain` made of it."""
    if isinstance(state, Mapping):
        return {name: _from_plain(value) for name, value in state.items()}
    return np.array(state, np.uint64) if isinstance(state, list) else state
