"""Turns: the stock over the turns of an episode, a line for each replica."""

from math import ceil
from typing import Any, Final

import numpy as np

from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.viewer.axes import TITLE, Axes
from cprl.viewer.header import has_died
from cprl.viewer.logger import RerunLogger
from cprl.viewer.looks import Looks
from cprl.viewer.scenery import STATES

POINTS: Final = 100
"""The points of a line, at most."""
_LIVED: Final = (150, 150, 150)
_TEXT: Final = (200, 200, 200)


class Turns:
    """Logs the apples on the board over the turns of each replica's last episode, grey where the board lived
    until the time was up, in the colour of a tragedy where it died.

    Args:
        env: the worlds, one for each replica R.
        logger: where the lines are logged, as `turn/lines`.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger) -> None:
        game, replicas = env.game, env.worlds.size
        self._logger, self._looks = logger, Looks(env, ("step", "stock_left"))
        self.stride = ceil(game.rules.episode_steps / POINTS)
        """Turns from one point to the next."""
        self._every_replica = np.arange(replicas)
        self._playing = np.full((replicas, game.rules.episode_steps // self.stride + 1, 2), np.nan)
        """[R, points, 2], turn and stock of the episodes that are being played."""
        self._ended: list[list[tuple[float, float]]] = [[] for _ in range(replicas)]
        self._died = [False] * replicas
        self._axes = Axes(
            "turn of the episode",
            x_end=game.rules.episode_steps,
            y_end=max(1, len(game.map.sites)),
        )
        lines, texts = self._axes.drawn()
        logger.log_static("turn/axes", lines)
        logger.log_static("turn/axes/texts", texts)

    def on_step(self, step: int) -> None:
        """Notes the stock of every replica, each at its own turn, if it is time."""
        if step % self.stride:
            return
        self._looks.add()
        if self._looks.is_full:
            self._place()

    def _place(self) -> None:
        """Places the points that were noted, the latest last: it stays where two have the same place."""
        turn, stock = (kept[..., 0] for kept in self._looks.take())
        point = self._every_replica, turn // self.stride
        self._playing[(*point, 0)], self._playing[(*point, 1)] = turn, stock

    def on_episode(self, episode: Episode) -> None:
        """Ends the line of a replica."""
        self._place()
        playing = self._playing[episode.world]
        points = playing[playing[:, 0] < episode.steps]
        end = [] if episode.stock_left is None else [(float(episode.steps), float(episode.stock_left))]
        self._ended[episode.world] = [*map(tuple, points.tolist()), *end]
        self._died[episode.world] = bool(has_died(episode))
        playing[1:] = np.nan  # the first point is already that of the next episode, which begins alike

    def log(self) -> None:
        """Logs the lines at the logger's time."""
        import rerun as rr

        shown = [replica for replica, line in enumerate(self._ended) if len(line) > 1]
        if not shown:
            return
        strips = [self._axes.placed(*np.array(self._ended[replica]).T) for replica in shown]
        colours = [STATES["tragedy"] if self._died[replica] else _LIVED for replica in shown]
        self._logger.log_row("turn/lines", rr.LineStrips2D(strips, colors=colours, radii=0.5))
        died = sum(self._died)
        text = f"last episode of each replica: {died} of {len(shown)} boards died (orange)"
        title = rr.Points2D([TITLE], labels=[text], radii=0.0, colors=_TEXT, show_labels=True)
        self._logger.log_row("turn/title", title)

    def state_dict(self) -> dict[str, Any]:
        """The points of the running and of the last episodes."""
        self._place()
        return {"playing": self._playing.tolist(), "ended": self._ended, "died": self._died}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._looks.take()
        self._playing[:] = state["playing"]
        self._ended = [[(turn, stock) for turn, stock in line] for line in state["ended"]]
        self._died = list(state["died"])
