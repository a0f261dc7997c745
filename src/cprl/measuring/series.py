"""Observer: what happens in a training, handed to all who show or write it; recent means of its numbers."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from math import ceil, isnan
from statistics import fmean
from typing import Any, Final

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.envs.unwrap import agent_names
from cprl.measuring.episodes import Episode
from cprl.measuring.registry import INSTITUTIONS, OF_AGENTS
from cprl.system.times import Speed
from cprl.values.arrays import Float64

OF_GROUP: Final = ("social/", INSTITUTIONS)
"""How the names of numbers begin that are of all agents together."""
STEPS: Final = "time/env_steps"
SPEED: Final = "time/env_steps_per_s"
"""The environment steps of each replica so far, and those of all per second, compiling left out."""


class Observer:
    """Watches a training, and hands its callbacks turns, episodes, and numbers by name.

    It is what calls callbacks. Numbers of an episode, by the names of docs/metrics.md, are handed out once
    all replicas have ended it, and their speed with them: loggers and the viewer write or draw what they get.
    A `Training` has one; a loop of your own makes one, and calls `on_step` and `on_episode`.

    Args:
        callbacks: Each has some of the methods of `cprl.training.Callback`.
        env: The worlds of all replicas R, and the names of the agents.
        worlds: The worlds W of each replica. Numbers are then means over every W episodes.
    """

    def __init__(self, callbacks: Sequence[Any], env: EnvBase, *, worlds: int = 1) -> None:
        self.callbacks = list(callbacks)
        self.steps = 0
        """Steps of each replica so far."""
        self._agents = agent_names(env)
        self._series = Series(env.batch_size.numel() // worlds, worlds)
        self._speed = Speed()
        self._on_step = self._hooks("on_step")

    def _hooks(self, name: str) -> list[Callable[..., None]]:
        return [getattr(callback, name) for callback in self.callbacks if hasattr(callback, name)]

    def on_start(self, training: Any) -> None:
        """Go on where a training is."""
        self.steps = training.steps
        self._speed = Speed(self.steps * self._series.replicas)
        for on_start in self._hooks("on_start"):
            on_start(training)

    def on_step(self, batch: TensorDictBase) -> None:
        self.steps += self._series.worlds
        for on_step in self._on_step:
            on_step(batch)

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        for on_ended in self._hooks("on_ended"):
            on_ended(ended)
        for episode, learning in ended:
            self.on_episode(episode, learning)

    def on_episode(self, episode: Episode, learning: dict[str, float]) -> None:
        """Hand out an episode, and its numbers if all replicas have ended it."""
        for on_episode in self._hooks("on_episode"):
            on_episode(episode, learning)
        numbers = self._series.add(episode, numbers_of(episode, learning, self._agents))
        if numbers is None:
            return
        if self.steps:
            numbers[STEPS] = np.array([float(self.steps)])
            numbers[SPEED] = np.array([self._speed.lap(self.steps * self._series.replicas)])
        for on_numbers in self._hooks("on_numbers"):
            on_numbers(episode.episode, numbers)

    def state_dict(self) -> dict[str, Any]:
        return {"steps": self.steps, **self._series.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.steps = int(state["steps"])
        self._series.load_state_dict(state)


def logged(metric: str) -> str:
    """Return the name by which a metric is logged."""
    return metric if "/" in metric else f"social/{metric}"


def numbers_of(episode: Episode, learning: Mapping[str, float], agents: Sequence[str]) -> dict[str, float]:
    """Return the numbers of an episode, by the names of docs/metrics.md; NaN where undefined.

    Args:
        learning: the numbers of learning in it, by agent index: `agent_0/loss` and so on.
        agents: the agents' names, which replace `agent_0` and so on.
    """
    numbers = {logged(name): value for name, value in episode.metrics.items()}
    for agent, value in zip(agents, episode.return_, strict=True):
        numbers[f"{agent}/return"] = float(value)
    for name in OF_AGENTS:
        if (values := getattr(episode, name)) is not None:
            numbers |= {f"{agent}/{name}": float(value) for agent, value in zip(agents, values, strict=True)}
    named = {f"agent_{index}": agent for index, agent in enumerate(agents)}
    for name, value in learning.items():
        of, slash, what = name.partition("/")
        numbers[f"{named.get(of, of)}{slash}{what}"] = float(value)
    return numbers


class Series:
    """Collects the numbers of an episode until all replicas have ended it, so that they are comparable.

    Of replicas in W worlds, which end as many episodes in the time of one, they are means over every W
    episodes, each replica's one after the other, of those in which they are defined.
    """

    def __init__(self, replicas: int, worlds: int = 1) -> None:
        self.replicas = replicas
        self.worlds = worlds
        self._waiting: dict[int, dict[int, list[dict[str, float]]]] = {}
        """By the number of W episodes, and by replica."""

    def add(self, episode: Episode, numbers: Mapping[str, float]) -> dict[str, Float64] | None:
        """Add the numbers of an episode of a replica.

        Returns:
            The numbers, [R] by name, NaN where a replica has none, if all replicas have ended the episode and
            it is the last of W; else None.

        Raises:
            ValueError: for an episode of a replica beyond R.
        """
        if episode.replica >= self.replicas:
            raise ValueError(
                f"an episode of replica {episode.replica}; allowed: of replicas 0 to {self.replicas - 1}, "
                "those of the environment"
            )
        together = episode.episode // self.worlds
        of_replicas = self._waiting.setdefault(together, {})
        of_replicas.setdefault(episode.replica, []).append(dict(numbers))
        if len(of_replicas) < self.replicas or min(map(len, of_replicas.values())) < self.worlds:
            return None
        del self._waiting[together]
        names = {name: None for each in of_replicas.values() for one in each for name in one}
        return {
            name: np.array([self._mean(of_replicas[r], name) for r in range(self.replicas)]) for name in names
        }

    def _mean(self, episodes: Sequence[Mapping[str, float]], name: str) -> float:
        if self.worlds == 1:
            return episodes[0].get(name, np.nan)
        return mean_of(np.array([numbers.get(name, np.nan) for numbers in episodes]))

    def state_dict(self) -> dict[str, Any]:
        """Return the incomplete episodes."""
        return {"waiting": deepcopy(self._waiting)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the incomplete episodes of a state."""
        self._waiting = deepcopy(state["waiting"])


def mean_of(values: Float64) -> float:
    """Return the mean of the defined values; NaN if none is defined."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")


class Recent:
    """The mean of the last values.

    Args:
        episodes: how many episodes it is of; with fewer, of all.
        each: the number of episodes that each value is the mean of.
    """

    def __init__(self, episodes: int, *, each: int = 1) -> None:
        self.window = ceil(episodes / each)
        """How many values it is of, at most."""
        self._last: deque[float] = deque(maxlen=self.window)

    def add(self, value: float) -> float:
        """Add a value; return the mean of the last ones that are defined, NaN if none is."""
        self._last.append(float(value))
        defined = [value for value in self._last if not isnan(value)]
        return fmean(defined) if defined else float("nan")
