"""Plots: the numbers of each episode as lines, with their running means and random play."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, Final

from cprl.measuring.episodes import Episode
from cprl.measuring.recent import Recent
from cprl.measuring.replicas import social_metrics
from cprl.measuring.series import OF_AGENTS, Values, mean_of
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scenery import RANDOM_PLAY, Curves

WINDOW: Final = 0.02
"""The share of the run's episodes whose mean is the bold line."""
SHORTEST: Final = 10
"""Its episodes at least."""
_WITH_MEAN: Final = tuple(f"/{name}" for name in ("return", *OF_AGENTS))


def _of_institutions(episode: Episode) -> dict[str, float]:
    return {f"institutions/{name}": value for name, value in episode.institutions.items()}


class Plots:
    """Logs the lines of each episode: social metrics, those of institutions and what agents get and pay
    with a running mean, all else as it is.

    Args:
        logger: where they are logged.
        curves: what is plotted.
        episodes: of the run; determines the window of running means.
    """

    def __init__(self, logger: RerunLogger, curves: Curves, *, episodes: int) -> None:
        self._logger, self._curves = logger, curves
        self.window = max(SHORTEST, round(WINDOW * episodes))
        """Episodes of a running mean."""
        self._recent: dict[str, Recent] = {}
        self._random: dict[str, float] = {}

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Sets the lines of random play: the mean of each metric in these episodes, where it is defined."""
        metrics = [{**social_metrics(episode), **_of_institutions(episode)} for episode in episodes]
        for name in (*self._curves.metrics, *(f"institutions/{own}" for own in self._curves.institutions)):
            defined = [own[name] for own in metrics if name in own and own[name] == own[name]]
            if defined:
                self._random[name] = fmean(defined)

    def on_episode(self, of_all: Mapping[str, Values]) -> None:
        """Logs an episode at the logger's time: the numbers [R] of each name."""
        for name, values in of_all.items():
            is_social = name.startswith(("social/", "institutions/"))
            singles = values.tolist() if is_social and len(values) > 1 else []
            line = [*singles, mean := mean_of(values)]
            if is_social or name.endswith(_WITH_MEAN):
                line.append(self._recent.setdefault(name, Recent(self.window)).add(mean))
            self._logger.log_lines(name, line)
        for name, mean in self._random.items():
            self._logger.log_scalar(f"{RANDOM_PLAY}/{name}", mean)

    def state_dict(self) -> dict[str, Any]:
        """The last values of each running mean."""
        return {name: recent.state_dict() for name, recent in self._recent.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        for name, own in state.items():
            self._recent.setdefault(name, Recent(self.window)).load_state_dict(own)
