"""View: one part of a recording, such as a set of plots, which follows the training turn by turn.

The module also holds the two views of lines over episodes: `Plots` and `JointActions`.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isnan, nan
from statistics import fmean
from typing import Any, Final

import numpy as np
import rerun as rr
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.registry import AGENT_TOTALS, INCOME
from cprl.measuring.series import ENV_STEPS, GROUP_PREFIXES, Recent, mean_of
from cprl.measuring.tracker import Episode
from cprl.values.array_types import Float64
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import JOINT, RANDOM_PLAY_FOLDER
from cprl.viewer.scene import Scene

Numbers = Mapping[str, Float64]
"""All numbers of an episode, float64 [R] each, by their names."""


class View:
    """A part of the recording of a training.

    `ViewerCallback` sets the logger's time and then calls the view, whose methods do nothing by default. The
    state of a view follows from the episodes: when a run is resumed, its earlier episodes are added again
    while the logger is silent.
    """

    stride = 0
    """The view needs `on_step` at least every so many turns; 0 if it does not need it."""

    def on_step(self, batch: TensorDictBase) -> None:
        """Look at the worlds after a turn: at every turn with a frame, and at least every `stride` turns."""

    def on_board(self, env: CommonsEnv, scene: Scene) -> None:
        """Show the worlds of another game from now on, if the view shows worlds."""

    def on_episode(self, episode: Episode) -> None:
        """Add an episode of one world."""

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        """Add the numbers of an episode that all replicas have ended; see `cprl.training.Callback`."""

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the training with these episodes of random play."""

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Show the evaluation after the training: the episodes of the policies "trained" and "random"."""

    def resumed(self) -> None:
        """Continue a resumed run, whose earlier episodes, but not their steps, have been added again."""

    def close(self) -> None:
        """Log the remaining data; a second call does nothing."""


Exhibit = Callable[[EnvBase, RerunLogger], Any]
"""A function that makes the view in which the current policy plays for live viewers, from the training's
environment and its logger; see `cprl.experimental.exhibition`."""


def has_died(episode: Episode) -> bool | None:
    """Return whether the episode ended early because no apple was left; None if the game reports no stock."""
    return None if episode.depletion_step is None else episode.terminated


_AVERAGED_SUFFIXES: Final = tuple(f"/{name}" for name in ("return", *AGENT_TOTALS))
"""The ends of the names of agents' numbers that are plotted with a running mean, such as "agent_0/return"."""


class Plots(View):
    """Logs the lines of all numbers; metrics of the group, and agents' amounts, have a running mean."""

    def __init__(self, logger: RerunLogger) -> None:
        self._logger = logger
        self._recent: dict[str, Recent] = {}
        self._random_means: dict[str, float] = {}
        """The mean of each metric in random play."""

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Set the lines of random play to the mean of each metric in the episodes where it is defined."""
        curves = self._logger.curves
        played = [{**episode.metrics, INCOME: float(episode.return_.sum())} for episode in episodes]
        names = list(curves.metrics)
        if curves.unit == "return":
            names.append(INCOME)
        for name in names:
            values = [metrics.get(name, nan) for metrics in played]
            defined = [value for value in values if not isnan(value)]
            if defined:
                self._random_means[name] = fmean(defined)
        for name, mean in self._random_means.items():  # plots without a curve so far show a line
            points = rr.Scalars.columns(scalars=[mean, mean])
            self._logger.log_columns(
                f"{RANDOM_PLAY_FOLDER}/{name}", ([0, 0], [0, 1], [0, 0]), points, live_only=True
            )

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        curves = self._logger.curves
        if curves.unit == "return":
            numbers = {**numbers, INCOME: np.sum([numbers[f"{name}/return"] for name in curves.agents], 0)}
        for name, values in numbers.items():
            if name == ENV_STEPS:  # the timeline `step` shows it
                continue
            is_group_metric = name.startswith((*GROUP_PREFIXES, INCOME))
            mean = mean_of(values)
            lines = [*values, mean] if is_group_metric and len(values) > 1 else [mean]
            if is_group_metric or name.endswith(_AVERAGED_SUFFIXES):
                recent = self._recent.setdefault(name, Recent(curves.mean_over, each=curves.worlds))
                lines.append(recent.add(mean))
            self._logger.log_lines(name, lines)
        for name, mean in self._random_means.items():
            self._logger.log_lines(f"{RANDOM_PLAY_FOLDER}/{name}", [mean])


class JointActions(View):
    """Logs how often the agents of a small matrix game chose each joint action.

    A line is the share of turns, as a mean over replicas and over the last episodes.
    """

    stride = 1

    def __init__(self, logger: RerunLogger, *, actions: int) -> None:
        curves = logger.curves
        self._logger = logger
        self._worlds = np.arange(curves.replicas * curves.worlds)
        # A joint action is the number whose digits, to the base `actions`, are the agents' actions.
        self._digit_values = actions ** np.arange(len(curves.agents))[::-1]
        self._counts = np.zeros((len(self._worlds), len(curves.joint)))
        self._shares: dict[int, list[Float64]] = {}
        """The shares in the episodes that replicas have ended, by the index of the block of W episodes."""
        self._recent = [Recent(curves.mean_over, each=curves.worlds) for _ in curves.joint]

    def on_step(self, batch: TensorDictBase) -> None:
        action = batch[keys.ACTION].cpu().numpy()
        self._counts[self._worlds, action @ self._digit_values] += 1

    def on_episode(self, episode: Episode) -> None:
        counts = self._counts[episode.world]
        if counts.any():
            block = episode.episode // self._logger.curves.worlds
            self._shares.setdefault(block, []).append(counts / counts.sum())
        counts[:] = 0

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        shares = self._shares.pop(episode // self._logger.curves.worlds, None)
        if shares:
            means = zip(self._recent, np.mean(shares, 0), strict=True)
            self._logger.log_lines(JOINT, [recent.add(share) for recent, share in means])
