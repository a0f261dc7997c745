"""Joins the numbers of each episode over all replicas, once every replica has ended it."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import arguments
from cprl.measuring.episodes import Episode
from cprl.measuring.replicas import institution_metrics, social_metrics

Values = NDArray[np.float64]

OF_AGENTS: Final = ("fines", "transfers", "violations")
"""The fields of an episode that are numbers of each agent, where the game has institutions."""


def numbers_of(episode: Episode, learning: Mapping[str, float], agents: Sequence[str]) -> dict[str, float]:
    """The numbers of an episode, by the names of docs/metrics.md; NaN where undefined.

    Args:
        episode: the episode.
        learning: the numbers of learning in it, by agent index: `agent_0/loss` and so on.
        agents: the agents' names, which replace `agent_0` and so on.

    Raises:
        ValueError: for something else than numbers by name in `learning`, as a callback may write there.
    """
    numbers = {f"social/{name}": value for name, value in social_metrics(episode).items()}
    for agent, value in zip(agents, episode.return_, strict=True):
        numbers[f"{agent}/return"] = float(value)
    numbers |= {f"institutions/{name}": value for name, value in institution_metrics(episode).items()}
    for name in OF_AGENTS:
        if (values := getattr(episode, name)) is not None:
            numbers |= {f"{agent}/{name}": float(own) for agent, own in zip(agents, values, strict=True)}
    named = {f"agent_{index}": agent for index, agent in enumerate(agents)}
    for name, value in learning.items():
        arguments.object_of("a name in learning", name, str, "a text")
        of, slash, what = name.partition("/")
        try:
            numbers[f"{named.get(of, of)}{slash}{what}"] = float(value)
        except (TypeError, ValueError, RuntimeError) as error:
            raise arguments.refusal(f"learning[{name!r}]", value, "a number") from error
    return numbers


class Series:
    """Collects the numbers of an episode until all replicas have ended it, so that replicas are comparable.

    Args:
        replicas: the number of replicas R.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(self, replicas: int) -> None:
        self.replicas = arguments.integer("replicas", replicas, 1)
        self._waiting: dict[int, dict[int, dict[str, float]]] = {}

    def add(self, episode: int, replica: int, numbers: Mapping[str, float]) -> dict[str, Values] | None:
        """Adds the numbers of an episode of a replica.

        Returns:
            Its numbers, [R] by name, NaN where a replica has none, if all replicas have ended the episode;
            else None.
        """
        episode = arguments.integer("episode", episode, 0)
        replica = arguments.integer("replica", replica, 0, self.replicas - 1)
        of_episode = self._waiting.setdefault(episode, {})
        arguments.object_of("numbers", numbers, Mapping, "numbers by name")
        of_episode[replica] = dict(numbers)
        if len(of_episode) < self.replicas:
            return None
        del self._waiting[episode]
        names = {name: None for own in of_episode.values() for name in own}
        return {
            name: np.array([of_episode[r].get(name, np.nan) for r in range(self.replicas)]) for name in names
        }

    def state_dict(self) -> dict[str, Any]:
        """The incomplete episodes."""
        return {"waiting": {episode: dict(own) for episode, own in self._waiting.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues with the incomplete episodes of a state."""
        self._waiting = {int(episode): dict(own) for episode, own in state["waiting"].items()}


def mean_of(values: Values) -> float:
    """The mean of the defined values; NaN if none is defined."""
    values = arguments.floats("values", values)
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")
