"""The numbers of each episode of all replicas, together as soon as every replica has ended it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


class Series:
    """Waits for the replica that is last to end an episode, so that what is drawn is of the same episode.

    Args:
        replicas: R.
    """

    def __init__(self, replicas: int) -> None:
        self.replicas = replicas
        self._waiting: dict[int, dict[int, dict[str, float]]] = {}

    def add(self, episode: int, replica: int, numbers: Mapping[str, float]) -> dict[str, Values] | None:
        """Takes the numbers of an episode of a replica.

        Returns:
            Once all replicas have ended the episode, its numbers, [R] by name, NaN where a replica has none;
            else None.
        """
        of_episode = self._waiting.setdefault(episode, {})
        of_episode[replica] = dict(numbers)
        if len(of_episode) < self.replicas:
            return None
        del self._waiting[episode]
        names = {name: None for own in of_episode.values() for name in own}
        return {
            name: np.array([of_episode[r].get(name, np.nan) for r in range(self.replicas)]) for name in names
        }

    def state_dict(self) -> dict[str, Any]:
        """The episodes that are waited for."""
        return {"waiting": {episode: dict(own) for episode, own in self._waiting.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on waiting."""
        self._waiting = {int(episode): dict(own) for episode, own in state["waiting"].items()}


def mean_of(values: Values) -> float:
    """The mean of what is defined; NaN where nothing is."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")
