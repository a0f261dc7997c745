"""Lorenz: how evenly the agents share the harvest, as a Lorenz curve with its Gini coefficient."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.episodes import Episode
from cprl.viewer.axes import TITLE, Axes
from cprl.viewer.logger import RerunLogger

_EVEN: Final = (150, 150, 150)
_FIRST: Final = (0, 158, 115)
_LAST: Final = (230, 160, 0)
_TEXT: Final = (200, 200, 200)


def lorenz_curve(harvest: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of the harvest that the k agents with the least have together, k = 0..N; [N + 1].

    The area between it and the diagonal, doubled, is the Gini coefficient, 1 - equality. NaN without harvest.
    """
    total = harvest.sum()
    if total <= 0:
        return np.full(len(harvest) + 1, np.nan)
    return np.concatenate([[0.0], np.sort(harvest).cumsum() / total])


def gini(curve: NDArray[np.float64]) -> float:
    """The Gini coefficient of a Lorenz curve [N + 1], 0 for equal shares."""
    return float(1 - (curve[1:] + curve[:-1]).sum() / (len(curve) - 1))


class Lorenz:
    """Logs the mean Lorenz curve of the episodes of all replicas since the last one, beside the first one.

    The mean is over episodes, so its Gini coefficient is 1 minus their mean equality; episodes without a
    harvest have no curve and are left out.

    Args:
        logger: where the curves are logged, as `lorenz`.
        agents: the number of agents N.
    """

    def __init__(self, logger: RerunLogger, agents: int) -> None:
        self._logger, self._agents = logger, agents
        self._sums: dict[int, NDArray[np.float64]] = {}
        self._first: tuple[list[float], str] | None = None
        self._axes = Axes("agents, the poorest first, %", x_end=100, y_end=100)
        lines, texts = self._axes.drawn()
        logger.log_static("lorenz/axes", lines)
        logger.log_static("lorenz/axes/texts", texts)

    def on_episode(self, episode: Episode) -> None:
        """Adds an episode of a replica."""
        if episode.harvest is not None and episode.harvest.sum() > 0:
            row = np.append(lorenz_curve(episode.harvest), 1.0)
            self._sums[episode.episode] = self._sums.get(episode.episode, 0.0) + row

    def log(self, first: int, last: int) -> None:
        """Logs the curve of these episodes, counted from 1, at the logger's time, if any had a harvest."""
        import rerun as rr

        taken = [self._sums.pop(episode) for episode in sorted(self._sums) if episode < last]
        if not taken:
            return
        *total, count = np.sum(taken, 0)
        curve = np.array(total) / count
        episodes = f"episode {last}" if first == last else f"episodes {first} to {last}"
        self._first = self._first or (curve.tolist(), episodes)
        earliest, began = np.array(self._first[0]), self._first[1]
        share = np.linspace(0, 100, self._agents + 1)
        curves = share / 100, earliest, curve
        strips = [self._axes.placed(share, 100 * own) for own in curves]
        lines = rr.LineStrips2D(strips, colors=[_EVEN, _FIRST, _LAST], radii=[0.3, 0.5, 1.0])
        self._logger.log_row("lorenz", lines)
        text = (
            f"Gini {gini(curve):.2f}: {episodes}, {count:.0f} with a harvest "
            f"(green: {began}, {gini(earliest):.2f}; grey: equal shares)"
        )
        title = rr.Points2D([TITLE], labels=[text], radii=0.0, colors=_TEXT, show_labels=True)
        self._logger.log_row("lorenz/title", title)

    def state_dict(self) -> dict[str, Any]:
        """The sums of curves and their numbers, by episode, and the first curve."""
        sums = [[episode, *row.tolist()] for episode, row in self._sums.items()]
        return {"sums": sums, "first": self._first}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._sums = {int(episode): np.array(row) for episode, *row in state["sums"]}
        first = state["first"]
        self._first = None if first is None else (list(first[0]), str(first[1]))
