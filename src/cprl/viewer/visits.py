"""Visits: where each agent of the first replica spends its time, as a map for each agent."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from cprl.commons.colours import GROUND, PALETTE, WALL, agent_colour
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.viewer.logger import RerunLogger
from cprl.viewer.looks import Looks
from cprl.viewer.panels import Panels
from cprl.viewer.scenery import Scene

SAMPLED_EVERY: Final = 10
"""Steps from one look at the agents' cells to the next."""
_DARKEST: Final = 0.35
"""The brightness of a cell that was visited once; 1 is the cell with the longest stay."""


class Visits:
    """Counts the agents' cells in the first replica, the one that is shown, every `SAMPLED_EVERY` steps.

    The image has a map for each agent: hue the agent, brightness the time it spent on the cell while in play,
    by its square root, as a share of the longest time that any agent spent on one cell.

    Args:
        env: the worlds; the first is counted.
        logger: where the maps are logged, as `visits`.
        scene: the contents of the board.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, *, scene: Scene) -> None:
        self._logger, self._looks = logger, Looks(env, ("row", "col", "in_play"))
        self._size = scene.height, scene.width
        self._agents = np.arange(len(scene.agents)) * scene.height * scene.width
        self._counts = np.zeros(len(scene.agents) * scene.height * scene.width, np.int64)
        self._panels = Panels(len(scene.agents), (scene.height + 2, scene.width + 2))
        self._walls = np.ones((scene.height + 2, scene.width + 2), np.bool_)
        self._walls[1:-1, 1:-1] = False
        for row, col in scene.walls:
            self._walls[row + 1, col + 1] = True
        self._hues = np.array([agent_colour(agent) for agent in range(len(scene.agents))])
        self._ended = self._logged = 0
        logger.log_static("visits/labels", self._panels.labels())

    def on_step(self, step: int) -> None:
        """Notes where the agents are, if it is time."""
        if step % SAMPLED_EVERY:
            return
        self._looks.add()
        if self._looks.is_full:
            self._count()

    def _count(self) -> None:
        """Counts where the agents in play were."""
        row, col, in_play = (kept[:, 0] for kept in self._looks.take())
        cells = self._agents + row * self._size[1] + col
        self._counts += np.bincount(cells[in_play], minlength=len(self._counts))

    def on_episode(self, episode: Episode) -> None:
        """Notes how many episodes the first replica has ended."""
        if episode.world == 0:
            self._ended = episode.episode + 1

    def log(self) -> None:
        """Logs the maps at the logger's time, and counts from zero."""
        import rerun as rr

        image = self._panels.joined(self.maps(), PALETTE[GROUND])
        self._logger.log_row("visits", rr.Image(image))
        first, last = self._logged + 1, max(self._ended, self._logged + 1)
        episodes = f"episode {last}" if first == last else f"{first} to {last}"
        texts = [f"{agent}: {episodes}" for agent in range(len(self._agents))]
        self._logger.log_row("visits/labels", rr.Points2D.from_fields(labels=texts))
        self._counts[:] = 0
        self._logged = self._ended

    def maps(self) -> Any:
        """The maps of the time since the last image: uint8 [N, H + 2, W + 2, 3], with a rim of wall."""
        self._count()
        counts = self._counts.reshape(-1, *self._size)
        share = np.sqrt(counts / max(1, counts.max()))
        light = np.where(counts > 0, _DARKEST + (1 - _DARKEST) * share, 0.0)[..., None]
        inner = np.array(PALETTE[GROUND]) * (1 - light) + self._hues[:, None, None] * light
        whole = np.pad(inner, ((0, 0), (1, 1), (1, 1), (0, 0)))
        whole[:, self._walls] = PALETTE[WALL]
        return whole.round().astype(np.uint8)

    def state_dict(self) -> dict[str, Any]:
        """The counts [N x H x W], and the episodes ended and logged."""
        self._count()
        return {"counts": self._counts.tolist(), "ended": self._ended, "logged": self._logged}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._looks.take()
        self._counts[:] = state["counts"]
        self._ended, self._logged = int(state["ended"]), int(state["logged"])
