"""View: a part of the recording of a training, which follows it turn by turn and episode by episode.

Here are lines over episodes, and the shares of joint actions.
"""

from collections.abc import Mapping, Sequence
from math import isnan, nan
from statistics import fmean
from typing import Final

import numpy as np
import rerun as rr
from tensordict import TensorDictBase

from cprl import keys
from cprl.measuring.episodes import Episode
from cprl.measuring.registry import INCOME, OF_AGENTS
from cprl.measuring.series import OF_GROUP, STEPS, Recent, mean_of
from cprl.values.arrays import Float64
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import JOINT, RANDOM_PLAY


class View:
    """A part of the recording of a training; a callback of `cprl.training`, which logs at the logger's time.

    Its state follows from the episodes: of a run that is resumed it gets those so far again, while the logger
    is silent.
    """

    stride = 0
    """The view needs to look at the worlds in every so many turns; 0 for no certain ones."""

    def on_step(self, batch: TensorDictBase) -> None:
        """Look at the worlds after a turn: at least in those that it needs, and in all that are recorded."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Add an episode of a replica."""

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        """Add an episode that all replicas have ended; see `cprl.training.Callback`."""

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the training with these episodes of random play."""

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Show the evaluation of a run that is over: the episodes of "trained" and "random"."""

    def resumed(self) -> None:
        """Return the episodes so far have been added again, but not their steps."""

    def close(self) -> None:
        """Log what is left; a second call does nothing."""


def has_died(episode: Episode) -> bool | None:
    """Return whether the episode ended before its time because no apple was left; None if no stock is
    reported."""
    return None if episode.depletion_step is None else episode.terminated


_WITH_MEAN: Final = tuple(f"/{name}" for name in ("return", *OF_AGENTS))


class Plots(View):
    """Logs the lines of all numbers that are handed out: those of the group and what agents get and pay with
    a running mean, all else as it is."""

    def __init__(self, logger: RerunLogger) -> None:
        self._logger = logger
        self._recent: dict[str, Recent] = {}
        self._random: dict[str, float] = {}

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Set the lines of random play: the mean of each metric in these episodes, where it is defined."""
        curves = self._logger.curves
        names = [*curves.metrics, *([INCOME] if curves.unit == "return" else [])]
        played = [{**episode.metrics, INCOME: float(episode.return_.sum())} for episode in episodes]
        for name in names:
            values = [numbers.get(name, nan) for numbers in played]
            defined = [value for value in values if not isnan(value)]
            if defined:
                self._random[name] = fmean(defined)
        for name, mean in self._random.items():  # a line in plots that have no curve yet
            points = rr.Scalars.columns(scalars=[mean, mean])
            self._logger.log_columns(
                f"{RANDOM_PLAY}/{name}", ([0, 0], [0, 1], [0, 0]), points, live_only=True
            )

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        curves = self._logger.curves
        if curves.unit == "return":
            numbers = {**numbers, INCOME: np.sum([numbers[f"{name}/return"] for name in curves.agents], 0)}
        for name, values in numbers.items():
            if name == STEPS:  # what its timeline says
                continue
            is_of_group = name.startswith((*OF_GROUP, INCOME))
            mean = mean_of(values)
            lines = [*values, mean] if is_of_group and len(values) > 1 else [mean]
            if is_of_group or name.endswith(_WITH_MEAN):
                recent = self._recent.setdefault(name, Recent(curves.mean_over, each=curves.worlds))
                lines.append(recent.add(mean))
            self._logger.log_lines(name, lines)
        for name, mean in self._random.items():
            self._logger.log_lines(f"{RANDOM_PLAY}/{name}", [mean])


class JointActions(View):
    """Logs the share of turns in which agents of a small matrix game chose each joint action: the mean over
    replicas and over the last episodes."""

    stride = 1

    def __init__(self, logger: RerunLogger, *, actions: int) -> None:
        curves = logger.curves
        self._logger = logger
        self._worlds = np.arange(curves.replicas * curves.worlds)
        self._places = actions ** np.arange(len(curves.agents))[::-1]
        self._counts = np.zeros((len(self._worlds), len(curves.joint)))
        self._shares: dict[int, list[Float64]] = {}
        """Of the episodes that replicas have ended, by the number of W episodes."""
        self._recent = [Recent(curves.mean_over, each=curves.worlds) for _ in curves.joint]

    def on_step(self, batch: TensorDictBase) -> None:
        action = batch[keys.ACTION].cpu().numpy()
        self._counts[self._worlds, action @ self._places] += 1

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        counts = self._counts[episode.world]
        if counts.any():
            together = episode.episode // self._logger.curves.worlds
            self._shares.setdefault(together, []).append(counts / counts.sum())
        counts[:] = 0

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        if shares := self._shares.pop(episode // self._logger.curves.worlds, None):
            means = zip(self._recent, np.mean(shares, 0), strict=True)
            self._logger.log_lines(JOINT, [recent.add(share) for recent, share in means])
