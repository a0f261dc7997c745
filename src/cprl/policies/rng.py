"""Random numbers of lanes: those of a lane depend on its own seed alone, not on the other lanes."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

DRAWN_AHEAD: Final = 1024
"""Steps whose numbers are generated at once."""

_LARGEST_SEED: Final = 2**63 - 1

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION, EXHIBITION, NOISE = range(7)
"""The purposes of a lane's random numbers; each has its own seed."""


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """The seed of each lane, replica by replica: (seed of the run, replica, agent, purpose)."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in agents]


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
        seeds: the seed of each lane, e.g. (seed, replica, agent, purpose).
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
