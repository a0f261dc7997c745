"""Wall: the boards of all replicas side by side, at the same step of the training."""

import time
from functools import partial
from itertools import chain
from math import ceil
from typing import Any, Final

import numpy as np

from cprl.commons.decoding import UNSEEN
from cprl.compat import send_chunk
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.viewer.batches import components, timelines, times
from cprl.viewer.header import has_died
from cprl.viewer.logger import RerunLogger
from cprl.viewer.panels import Panels
from cprl.viewer.scenery import BACKGROUND, STATES, Scene
from cprl.viewer.stage import boards, image_form

WALL_BYTES: Final = 4_000_000
"""The target size of the wall in a file, about."""
_LIVE_PERIOD_S: Final = 2.0
_LIVE_ROWS: Final = 10_000
"""From then on rows for viewers get rarer, because a server's memory holds them: period = time / rows."""
_FEWEST_STEPS: Final = 10
"""Steps from one row of the file to the next, at least."""
_DIED: Final = STATES["tragedy"]
_Row = tuple[int, int, int, Any, list[str], Any]
"""A step, episode and frame, the image, and the label and outline of each board."""


class Wall:
    """Logs the boards of all replicas: same rules, as many fates.

    Viewers get them every two seconds, after hours more rarely; the file gets every `stride`-th step of the
    episodes whose frames are recorded. A board is outlined while the last episode of its replica has ended
    because no apple was left.

    Args:
        env: the worlds, one for each replica R.
        logger: where they are logged.
        scene: the contents of a board.
        recorded_steps: the steps of the run whose frames are recorded, about; determines the stride.
    """

    def __init__(self, env: CommonsEnv, logger: RerunLogger, *, scene: Scene, recorded_steps: int) -> None:
        import rerun as rr

        self._env, self._logger, self._scene = env, logger, scene
        self._panels = Panels(scene.replicas, (scene.height + 2, scene.width + 2))
        rows, columns = self._panels.shape
        row_bytes = 100 + 20 * scene.replicas + 0.35 * rows * columns
        self.stride = max(_FEWEST_STEPS, ceil(recorded_steps * row_bytes / WALL_BYTES))
        """Steps from one row of the file to the next."""
        self._died = np.zeros(scene.replicas, np.bool_)
        self._rows: list[_Row] = []
        self._began = self._due = time.perf_counter()
        form = rr.SegmentationImage.from_fields(format=image_form(self._panels.shape), opacity=1.0)
        logger.log_static("wall/boards", form)
        logger.log_static("wall/labels", self._panels.labels())
        logger.log_static("wall/died", self._panels.frames())

    def on_step(self, step: int, episode: int, frame: int | None) -> None:
        """Logs the boards if they are due; `frame` is the number of the recorded one, if any."""
        if frame is not None and step % self.stride == 0:
            self._rows.append(self._row(step, episode, frame))
        elif (now := time.perf_counter()) > self._due:
            self._due = now + max(_LIVE_PERIOD_S, (now - self._began) / _LIVE_ROWS)
            if self._logger.is_live:
                self._send([self._row(step, episode, self._logger.frames)], live_only=True)

    def on_episode(self, episode: Episode) -> None:
        """Notes whether the replica's board has died, and sends the rows of the episode."""
        self._died[episode.world] = bool(has_died(episode))
        if episode.world == 0:
            self.send()

    def send(self) -> None:
        """Sends the rows that wait for the file."""
        if self._rows:
            self._send(self._rows)
            self._rows = []

    def _row(self, step: int, episode: int, frame: int) -> _Row:
        """A step, episode and frame, the image, and the label and outline of each board."""
        now, read = self._env.worlds.now, self._env.worlds.driver.read
        state = {name: read(getattr(now, name)) for name in ("stock", "in_play", "row", "col")}
        image = self._panels.joined(boards(self._scene, {"step": state["stock"], **state}), UNSEEN)
        turns = read(now.step)[:, 0].tolist()
        labels = [f"{replica}: turn {turn}" for replica, turn in enumerate(turns)]
        outlines = np.where(self._died[:, None], _DIED, BACKGROUND).astype(np.uint8)
        return step, episode, frame, image, labels, outlines

    def _send(self, rows: list[_Row], *, live_only: bool = False) -> None:
        self._logger.do(partial(_send_rows, rows=rows), live_only=live_only)

    def state_dict(self) -> list[bool]:
        """Whether each replica's last episode died; rows are sent first."""
        self.send()
        died: list[bool] = self._died.tolist()
        return died

    def load_state_dict(self, state: list[bool]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._died = np.array(state, np.bool_)


def _send_rows(recording: Any, *, rows: list[_Row]) -> None:
    """Sends rows, for viewers in the thread that sends."""
    import rerun as rr

    steps, episodes, frames, images, labels, outlines = zip(*rows, strict=True)
    at, replicas = timelines(times(steps, episodes, frames)), [len(labels[0])] * len(rows)
    parts = {
        "wall/boards": rr.SegmentationImage.columns(buffer=np.stack(images).reshape(len(rows), -1)),
        "wall/labels": rr.Points2D.columns(labels=list(chain(*labels))).partition(replicas),
        "wall/died": rr.Boxes2D.columns(colors=np.concatenate(outlines)).partition(replicas),
    }
    for entity, columns in parts.items():
        send_chunk(recording, entity, at, components(columns))
