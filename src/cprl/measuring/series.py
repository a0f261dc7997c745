"""Numbers that come episode by episode: of all replicas once each has ended it, and their recent mean."""

from collections import deque
from collections.abc import Mapping, Sequence
from math import ceil, isnan
from statistics import fmean
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.episodes import Episode

Values = NDArray[np.float64]

OF_AGENTS: Final = ("fines", "transfers", "violations")
"""The fields of an episode that are numbers of each agent, where the game has institutions."""


def numbers_of(episode: Episode, learning: Mapping[str, float], agents: Sequence[str]) -> dict[str, float]:
    """The numbers of an episode, by the names of docs/metrics.md; NaN where undefined.

    Args:
        learning: the numbers of learning in it, by agent index: `agent_0/loss` and so on.
        agents: the agents' names, which replace `agent_0` and so on.
    """
    numbers = {f"social/{name}": value for name, value in episode.social.items()}
    for agent, value in zip(agents, episode.return_, strict=True):
        numbers[f"{agent}/return"] = float(value)
    numbers |= episode.of_institutions
    for name in OF_AGENTS:
        if (values := getattr(episode, name)) is not None:
            numbers |= {f"{agent}/{name}": float(value) for agent, value in zip(agents, values, strict=True)}
    named = {f"agent_{index}": agent for index, agent in enumerate(agents)}
    for name, value in learning.items():
        of, slash, what = name.partition("/")
        numbers[f"{named.get(of, of)}{slash}{what}"] = float(value)
    return numbers


class Series:
    """Collects the numbers of an episode until all replicas have ended it, so that they are comparable."""

    def __init__(self, replicas: int) -> None:
        self.replicas = replicas
        self._waiting: dict[int, dict[int, dict[str, float]]] = {}

    def add(self, episode: int, replica: int, numbers: Mapping[str, float]) -> dict[str, Values] | None:
        """Adds the numbers of an episode of a replica.

        Returns:
            Its numbers, [R] by name, NaN where a replica has none, if all replicas have ended the episode;
            else None.
        """
        of_episode = self._waiting.setdefault(episode, {})
        of_episode[replica] = dict(numbers)
        if len(of_episode) < self.replicas:
            return None
        del self._waiting[episode]
        names = {name: None for numbers in of_episode.values() for name in numbers}
        return {
            name: np.array([of_episode[r].get(name, np.nan) for r in range(self.replicas)]) for name in names
        }

    def state_dict(self) -> dict[str, Any]:
        """The incomplete episodes."""
        return {"waiting": {episode: dict(numbers) for episode, numbers in self._waiting.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues with the incomplete episodes of a state."""
        self._waiting = {int(episode): dict(numbers) for episode, numbers in state["waiting"].items()}


def mean_of(values: Values) -> float:
    """The mean of the defined values; NaN if none is defined."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")


class Recent:
    """The mean of the last values: of a share of those so far, but of `least` at least.

    Args:
        least: how many values at least; with fewer, the mean is that of all.
        share: of the values so far, 0..1; 0 for a window of always `least`.
    """

    def __init__(self, least: int, *, share: float = 0.0) -> None:
        self.least = least
        self.share = share
        self.count = 0
        """Values so far."""
        self._last: deque[float] = deque()

    @property
    def window(self) -> int:
        """How many values the mean is of, at most."""
        return max(self.least, ceil(self.share * self.count))

    def add(self, value: float) -> float:
        """Adds a value; returns the mean of the last ones that are defined, NaN if none is."""
        self.count += 1
        self._last.append(float(value))
        while len(self._last) > self.window:
            self._last.popleft()
        defined = [value for value in self._last if not isnan(value)]
        return fmean(defined) if defined else float("nan")
