"""Views: the wall of replicas, where agents go, the stock over the turn and the Lorenz curve."""

from collections.abc import Mapping
from math import gcd
from typing import Any, Final

from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.viewer.logger import RerunLogger
from cprl.viewer.lorenz import Lorenz
from cprl.viewer.scenery import Curves, Scene, has_lorenz, has_wall
from cprl.viewer.turns import Turns
from cprl.viewer.visits import SAMPLED_EVERY, Visits
from cprl.viewer.wall import Wall

LONGEST: Final = 50
"""Episodes from one image of visits, stock and Lorenz curve to the next, at most."""
_IMAGES: Final = 20
"""The images of a short run, about."""


class Views:
    """Those of the views that the game has: without a board there is none of it, without a harvest no curve.

    Args:
        env: the worlds, one for each replica; None without boards.
        logger: where the views are logged.
        curves: what the game reports.
        episodes: the number of episodes of the run.
        every: episodes from one with recorded frames to the next; 0 without frames.
    """

    def __init__(
        self, env: CommonsEnv | None, logger: RerunLogger, curves: Curves, *, episodes: int, every: int
    ) -> None:
        self._logger = logger
        self.every = max(1, min(LONGEST, episodes // _IMAGES))
        """Episodes from one image to the next."""
        self.wall: Wall | None = None
        self.visits: Visits | None = None
        self.turns: Turns | None = None
        if env is not None and isinstance(curves, Scene) and not curves.is_replay:
            if has_wall(curves):
                recorded = env.game.rules.episode_steps * (episodes // max(1, every) + 1)
                self.wall = Wall(env, logger, scene=curves, recorded_steps=recorded)
            self.visits = Visits(env, logger, scene=curves)
            self.turns = Turns(env, logger)
        replayed = isinstance(curves, Scene) and curves.is_replay
        self.lorenz = Lorenz(logger, len(curves.agents)) if has_lorenz(curves) and not replayed else None
        self.sampled = 1 if self.turns is None else gcd(SAMPLED_EVERY, self.turns.stride)
        """Steps from one look at the worlds to the next where no frame is recorded."""
        self._logged = 0
        self._ended = 0

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        """Looks at the worlds after a step, if a view is due; `frame` is the number of the recorded one."""
        if frame is None and step % self.sampled:
            return
        if self.wall is not None:
            self.wall.on_step(step, episode, frame)
        if self.visits is not None and self.turns is not None:
            self.visits.on_step(step)
            self.turns.on_step(step)

    def on_episode(self, episode: Episode) -> None:
        """Adds an episode of a replica."""
        for view in (self.wall, self.visits, self.turns, self.lorenz):
            if view is not None:
                view.on_episode(episode)

    def on_all(self, episode: int) -> None:
        """Logs the images if they are due after an episode, counted from 0, that all replicas have ended; the
        logger's time is set."""
        self._ended = episode + 1
        if self._ended % self.every == 0:
            self.log()

    def log(self) -> None:
        """Logs the images of the episodes since the last ones, if there are any."""
        if self._ended == self._logged:
            return
        if self.visits is not None and self.turns is not None:
            self.visits.log()
            self.turns.log()
        if self.lorenz is not None:
            self.lorenz.log(self._logged + 1, self._ended)
        self._logged = self._ended

    def close(self) -> None:
        """Sends what is left."""
        self.log()
        if self.wall is not None:
            self.wall.send()

    def _there(self) -> dict[str, Any]:
        views = {"wall": self.wall, "visits": self.visits, "turns": self.turns, "lorenz": self.lorenz}
        return {name: view for name, view in views.items() if view is not None}

    def state_dict(self) -> dict[str, Any]:
        """What each view has added up."""
        views = {name: view.state_dict() for name, view in self._there().items()}
        return {"logged": self._logged, "ended": self._ended, **views}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned; views that it lacks begin anew."""
        self._logged = int(state["logged"])
        self._ended = int(state["ended"])
        for name, view in self._there().items():
            if name in state:
                view.load_state_dict(state[name])
