"""Random numbers of lanes: those of a lane depend on its own seed alone, not on the other lanes."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from cprl import arguments
from cprl.system.memory import check_memory

DRAWN_AHEAD: Final = 1024
"""Steps whose numbers are generated at once."""
MOST_LANES: Final = 2**20
"""The largest number of agents, of replicas and of lanes."""
_SEEDS: Final = "a sequence of integers >= 0 for each lane"


def check_lanes(seeds: Any, *, agents: int, worlds: int) -> tuple[int, int, int]:
    """Checks the numbers of lanes, and returns agents S, worlds k and replicas R.

    Args:
        seeds: the seeds of each lane, lane = replica x S + agent.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica.

    Raises:
        ValueError: if a number is no integer or below 1, or there is not one seed per lane.
    """
    agents = arguments.integer("agents", agents, 1, MOST_LANES)
    worlds = arguments.integer("worlds", worlds, 1, 2**32)
    lanes = len(arguments.listed("seeds", seeds, _SEEDS))
    if not lanes or lanes % agents:
        raise ValueError(
            f"there are {lanes} seeds for {agents} agents; allowed: one seed per lane, that is, a multiple "
            "of the number of agents"
        )
    return agents, worlds, lanes // agents


class LaneRng:
    """Uniform numbers in 0..1, `count` for each lane and step.

    Args:
        seeds: the seed of each lane, e.g. (seed, replica, agent, purpose).
        count: numbers per lane and step.
        ahead: steps whose numbers are generated at once; it changes no number.

    Raises:
        ValueError: if a seed is no sequence of integers of at least 0.
        TooLargeError: if there is less memory than those take that are generated ahead.
    """

    def __init__(self, seeds: Sequence[Sequence[int]], count: int, *, ahead: int = DRAWN_AHEAD) -> None:
        own = [_seed(lane, seed) for lane, seed in enumerate(arguments.listed("seeds", seeds, _SEEDS))]
        self.lanes, self.count = len(own), arguments.integer("count", count, 1, 2**40)
        self._ahead = arguments.integer("ahead", ahead, 1, DRAWN_AHEAD)
        check_memory(
            f"random numbers of {self.lanes:,} agents, {self.count:,} a step and {self._ahead} steps ahead,",
            8 * 2 * self._ahead * self.lanes * self.count,
            "smaller batches or rollouts, fewer evaluation episodes or fewer replicas",
        )
        self._chance = [np.random.Generator(np.random.Philox(np.random.SeedSequence(seed))) for seed in own]
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
        """The generators' states and the numbers generated ahead."""
        return {
            "chance": [_plain(chance.bit_generator.state) for chance in self._chance],
            "numbers": self._numbers,
            "used": self._used,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        for chance, own in zip(self._chance, state["chance"], strict=True):
            chance.bit_generator.state = _arrays(own)
        self._numbers, self._used = state["numbers"].clone(), int(state["used"])


def _seed(lane: int, seed: Any) -> list[int]:
    """The seed of a lane as ints."""
    parts = arguments.listed(f"seeds[{lane}]", seed, "a sequence of integers >= 0")
    return [arguments.integer(f"seeds[{lane}]", part, 0) for part in parts]


def _plain(state: Any) -> Any:
    """A generator's state as dicts, lists and numbers, which can be loaded without running code."""
    if isinstance(state, Mapping):
        return {name: _plain(value) for name, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state


def _arrays(state: Any) -> Any:
    if isinstance(state, Mapping):
        return {name: _arrays(value) for name, value in state.items()}
    return np.array(state, np.uint64) if isinstance(state, list) else state
