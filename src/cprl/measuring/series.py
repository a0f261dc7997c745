"""Observer: hands what happens in a training to its callbacks; means of recent numbers."""

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
from cprl.measuring.registry import AGENT_TOTALS, INSTITUTIONS
from cprl.measuring.tracker import Episode
from cprl.system.times import Speed
from cprl.values.array_types import Float64

GROUP_PREFIXES: Final = ("social/", INSTITUTIONS)
"""The prefixes of the names of numbers about all agents together."""
ENV_STEPS: Final = "time/env_steps"
SPEED: Final = "time/env_steps_per_s"
"""The environment steps of each replica so far, and the steps of all replicas per second, without
compilation."""


class Observer:
    """The caller of a training's callbacks: it hands them turns, episodes, and numbers by name.

    Numbers of an episode, by the names of docs/metrics.md, are handed out once all replicas have ended it,
    with the speed of the training. A `Training` has an observer; a custom loop makes one and calls `on_step`
    and `on_episode`.

    Args:
        callbacks: each has some of the methods of `cprl.training.Callback`.
        env: the worlds of all replicas R, and the names of the agents.
        worlds: the worlds W of each replica; numbers are means over every W episodes.
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

    def _call(self, name: str, *arguments: Any) -> None:
        for hook in self._hooks(name):
            hook(*arguments)

    def on_start(self, training: Any) -> None:
        """Continue at the step of a training, and call `on_start`."""
        self.steps = training.steps
        self._speed = Speed(self.steps * self._series.replicas)
        self._call("on_start", training)

    def on_step(self, batch: TensorDictBase) -> None:
        self.steps += self._series.worlds
        for on_step in self._on_step:
            on_step(batch)

    def on_game(self, env: EnvBase, changes: str) -> None:
        self._call("on_game", env, changes)

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        self._call("on_ended", ended)
        for episode, learning in ended:
            self.on_episode(episode, learning)

    def on_episode(self, episode: Episode, learning: dict[str, float]) -> None:
        """Hand out an episode, and its numbers if all replicas have ended it."""
        self._call("on_episode", episode, learning)
        numbers = self._series.add(episode, numbers_of(episode, learning, self._agents))
        if numbers is None:
            return
        if self.steps:
            numbers[ENV_STEPS] = np.array([float(self.steps)])
            numbers[SPEED] = np.array([self._speed.lap(self.steps * self._series.replicas)])
        self._call("on_numbers", episode.episode, numbers)

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
        learning: the numbers of learning in the episode by agent index: `agent_0/loss` and so on.
        agents: the agents' names, which replace `agent_0` and so on.
    """
    numbers = {logged(name): value for name, value in episode.metrics.items()}
    for agent, value in zip(agents, episode.return_, strict=True):
        numbers[f"{agent}/return"] = float(value)
    for name in AGENT_TOTALS:
        if (values := getattr(episode, name)) is not None:
            numbers |= {f"{agent}/{name}": float(value) for agent, value in zip(agents, values, strict=True)}
    names = {f"agent_{index}": agent for index, agent in enumerate(agents)}
    for name, value in learning.items():
        learner, slash, what = name.partition("/")
        numbers[f"{names.get(learner, learner)}{slash}{what}"] = float(value)
    return numbers


class Series:
    """The numbers of episodes that not all replicas have ended yet, so that they can be compared.

    With W worlds in each replica, numbers are means over every W episodes of a replica in which they are
    defined.
    """

    def __init__(self, replicas: int, worlds: int) -> None:
        self.replicas = replicas
        self.worlds = worlds
        self._waiting_numbers: dict[int, dict[int, list[dict[str, float]]]] = {}
        """The numbers of episodes by group of W episodes, and by replica."""

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
        waiting = self._waiting_numbers.setdefault(together, {})
        waiting.setdefault(episode.replica, []).append(dict(numbers))
        if len(waiting) < self.replicas or min(map(len, waiting.values())) < self.worlds:
            return None
        del self._waiting_numbers[together]
        names = {name: None for episodes in waiting.values() for numbers in episodes for name in numbers}
        series = {}
        for name in names:
            means = [self._mean(waiting[replica], name) for replica in range(self.replicas)]
            series[name] = np.array(means)
        return series

    def _mean(self, episodes: Sequence[Mapping[str, float]], name: str) -> float:
        if self.worlds == 1:
            return episodes[0].get(name, np.nan)
        return mean_of(np.array([numbers.get(name, np.nan) for numbers in episodes]))

    def state_dict(self) -> dict[str, Any]:
        """Return the numbers of episodes that not all replicas have ended."""
        return {"waiting": deepcopy(self._waiting_numbers)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the numbers of a state."""
        self._waiting_numbers = deepcopy(state["waiting"])


def mean_of(values: Float64) -> float:
    """Return the mean of the defined values; NaN if none is defined."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if len(defined) else float("nan")


class Recent:
    """A mean over the last episodes.

    Args:
        episodes: the episodes of the mean; with fewer, of all.
        each: the number of episodes that each value is already a mean of.
    """

    def __init__(self, episodes: int, *, each: int = 1) -> None:
        self.window = ceil(episodes / each)
        """The most values of the mean."""
        self._last: deque[float] = deque(maxlen=self.window)

    def add(self, value: float) -> float:
        """Add a value; return the mean of the last ones that are defined, NaN if none is."""
        self._last.append(float(value))
        defined = [value for value in self._last if not isnan(value)]
        return fmean(defined) if defined else float("nan")
