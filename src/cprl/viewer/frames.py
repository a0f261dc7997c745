"""Frames of the board: which episodes are recorded turn by turn, and the small boards of all replicas."""

import time
from collections.abc import Sequence
from itertools import chain
from math import ceil
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.cells import BEAM
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.tracker import Episode
from cprl.pictures.decoding import UNSEEN, classes_seen
from cprl.values.array_types import UInt8
from cprl.viewer.board import Frames, boards, image_format
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import DIED, TEXT
from cprl.viewer.scene import Scene, boards_of, windows_of
from cprl.viewer.view import View, has_died

FRAMES_BYTES: Final = 45_000_000
"""About the size of a file's regular frames; the frames after new bests add to it."""
_SEND_PERIOD_S: Final = 1.0
"""Seconds after which frames are sent before their episode ends, if they are at least `_FEWEST_FRAMES`."""
_FEWEST_FRAMES: Final = 50
"""The smallest number of frames that is sent within an episode, because each send has overhead."""
_MOST_FRAMES: Final = 5000
"""The number of frames that is sent at once, however little time has passed."""


class FrameRecorder:
    """Copies the state of the first world after each step, until `take` is called.

    Windows show the observations of the `CommonsEnv` itself, without transforms.
    """

    def __init__(self, env: CommonsEnv, scene: Scene, *, has_windows: bool = True) -> None:
        self._env = env
        self._has_tags = scene.has_tags
        self._has_windows = has_windows
        self._frames: list[dict[str, NDArray[Any]]] = []
        self._tagged_by = np.full(env.game.agents, -1, np.int32)
        """The agent that tagged each agent last; -1 if unknown."""

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, batch: TensorDictBase | None = None, *, step: int = 0, episode: int = 0) -> None:
        """Copy a frame.

        Args:
            batch: the latest step; None before the first one of an episode.
            step: the number of steps of the whole run.
        """
        if batch is not None and self._has_tags:
            tagged_by = batch["next"][keys.TAGGED_BY][0].cpu().numpy()
            tagged = tagged_by.any(1)
            first_shooter = tagged_by.argmax(1)
            self._tagged_by[tagged] = first_shooter[tagged]
        board = self._env.worlds.show(self._env.output)
        frame = {"step": step, "episode": episode, "beams": board.board == BEAM, "tagged_by": self._tagged_by}
        for name in ("stock", "row", "col", "heading", "in_play", "harvested"):
            frame[name] = getattr(board, name)
        if self._env.output.in_force.shape[1]:
            frame["rule"] = float(self._env.output.in_force[0, -1])
        if self._has_windows:
            frame["windows"] = board.observation
        self._frames.append({name: np.array(value) for name, value in frame.items()})

    def take(self) -> Frames | None:
        """Return the frames since the last call as columns [T, ...], for `RerunLogger.log_frames`.

        Return None if there are no frames.
        """
        rows = self._frames
        self._frames = []
        if not rows:
            return None
        columns = zip(*(row.values() for row in rows), strict=True)
        frames = dict(zip(rows[0], map(np.stack, columns), strict=True))
        if self._has_windows:
            frames["windows"] = classes_seen(self._env.game, frames["windows"])
        return frames


class FrameSchedule(View):
    """Decides in which episodes of the first world each turn is recorded, and logs these frames.

    They are every k-th episode, including the first and the last, and the episode after each new best; k is
    chosen so that the file's size stays near `FRAMES_BYTES`.

    Args:
        env: the worlds; None for a game without a board, which has no frames.
        episodes: the number of episodes that the first world plays.
    """

    def __init__(self, env: CommonsEnv | None, logger: RerunLogger, *, episodes: int) -> None:
        self._logger = logger
        self._last_episode = episodes - 1
        self._last_sent = time.perf_counter()
        self._recorder: FrameRecorder | None = None
        self._ended = 0
        """The number of episodes that the first world has ended."""
        self._is_requested = False
        """Whether `show` asks for the frames of the running episode."""
        self.was_on = False
        """Whether the last episode of the first world was recorded."""
        self.every = 0
        """The distance k between two recorded episodes; 0 for no frames."""
        self.frame: int | None = None
        """The number of the frame of this turn, if it has one."""
        scene = logger.scene
        if env is not None and scene is not None:
            self._recorder = FrameRecorder(env, scene)
            rows, columns = windows_of(len(scene.agents), scene.window).shape
            # An upper estimate; a trained population on the map `commons` takes 500 bytes.
            frame_bytes = 80 + 45 * len(scene.agents) + 0.35 * (rows * columns + scene.height * scene.width)
            run_bytes = episodes * env.game.rules.episode_steps * frame_bytes
            self.every = max(1, ceil(run_bytes / FRAMES_BYTES))
        self.is_on = self.is_shown(0)
        """Whether the running episode is recorded."""

    def is_shown(self, episode: int) -> bool:
        """Return whether the frames of the running episode, which has this index, are recorded."""
        if self.every == 0 or episode > self._last_episode:
            return False
        return episode % self.every == 0 or self._is_requested or episode == self._last_episode

    def show(self) -> None:
        """Record the running episode from this turn on, even if it is no k-th episode."""
        self._is_requested = True
        self.is_on = self.is_shown(self._ended)

    def on_board(self, env: CommonsEnv, scene: Scene) -> None:
        self.close()
        if self._recorder is not None:
            self._recorder = FrameRecorder(env, scene)

    def on_step(self, batch: TensorDictBase) -> None:
        """Copy a frame if the running episode is recorded."""
        self.frame = None
        if self._recorder is None or not self.is_on:
            return
        # After the last turn of an episode the board is already that of the next episode.
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[0, 0]:
            self.close()
            return
        self._recorder.add(batch, step=self._logger.step, episode=self._logger.episode)
        count = len(self._recorder)
        self.frame = self._logger.frames + count - 1
        waited_s = time.perf_counter() - self._last_sent
        if count >= _MOST_FRAMES or (waited_s > _SEND_PERIOD_S and count >= _FEWEST_FRAMES):
            self.close()

    def on_episode(self, episode: Episode) -> None:
        if episode.world == 0:
            self._ended += 1
            self.was_on = self.is_on
            self._is_requested = False
            self.is_on = self.is_shown(self._ended)

    def close(self) -> None:
        """Log the frames that have not been sent."""
        self._last_sent = time.perf_counter()
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self._logger.log_frames(frames)


WALL_BYTES: Final = 4_000_000
"""About the size of the wall in a file."""
_LIVE_PERIOD_S: Final = 2.0
"""The shortest time between two rows for viewers, in seconds."""
_LIVE_ROWS: Final = 10_000
"""About the largest number of rows for viewers, because they stay in a server's memory. Later in a long run
the time between two rows is the time since the start, divided by this number."""
_FEWEST_STEPS: Final = 10
"""The smallest number of steps between two rows of the file."""
_LABELLED: Final = 8
"""The largest number of boards whose labels say "turn" before its number; more labels would overlap."""


class _WallRow(NamedTuple):
    """All boards at one time."""

    step: int
    episode: int
    frame: int
    image: UInt8
    """uint8 [rows, columns], the boards side by side, as classes."""
    labels: list[str]
    """The text above each board."""
    colours: UInt8
    """uint8 [boards, 3], the colour of each text."""


class Wall(View):
    """Logs the boards of all replicas side by side, or those of the first worlds of a single replica.

    Viewers get them every two seconds, and less often after some hours. The file gets every k-th step of the
    episodes whose frames are recorded. The text above a board says its turn; it is orange if the world's
    previous episode ended early because no apple was left.

    Args:
        recorded_steps: about how many steps of the run have a frame; k is chosen so that the size of the wall
            stays near `WALL_BYTES`.
    """

    def __init__(
        self,
        env: CommonsEnv,
        logger: RerunLogger,
        schedule: FrameSchedule,
        *,
        recorded_steps: int,
    ) -> None:
        scene = logger.scene
        assert scene is not None
        self._env = env
        self._logger = logger
        self._schedule = schedule
        self._scene = scene
        self._panels = boards_of(scene, scene.boards)
        rows, columns = self._panels.shape
        row_bytes = 100 + 20 * scene.boards + 0.35 * rows * columns
        self._step_period = max(_FEWEST_STEPS, ceil(recorded_steps * row_bytes / WALL_BYTES))
        self._died = np.zeros(scene.boards, np.bool_)
        self._rows: list[_WallRow] = []
        self._began = self._live_due = time.perf_counter()
        wall_image = rr.SegmentationImage.from_fields(format=image_format(self._panels.shape), opacity=1.0)
        logger.log_static("wall/boards", wall_image)
        logger.log_static("wall/labels", self._panels.labels(colours=None))

    def on_board(self, env: CommonsEnv, scene: Scene) -> None:
        self.close()
        self._env = env
        self._scene = scene

    def on_step(self, batch: TensorDictBase) -> None:
        frame = self._schedule.frame
        if frame is not None and self._logger.turn % self._step_period == 0:
            self._rows.append(self._row(frame))
        elif (now := time.perf_counter()) > self._live_due:
            self._live_due = now + max(_LIVE_PERIOD_S, (now - self._began) / _LIVE_ROWS)
            if self._logger.is_live:
                self._log([self._row(self._logger.frames)], live_only=True)

    def on_episode(self, episode: Episode) -> None:
        """Remember whether the board has died; log the rows of the first world's episode."""
        if episode.world < len(self._died):
            self._died[episode.world] = bool(has_died(episode))
        if episode.world == 0:
            self.close()

    def close(self) -> None:
        if self._rows:
            self._log(self._rows)
            self._rows = []

    def _row(self, frame: int) -> _WallRow:
        worlds = self._env.worlds.now
        read = self._env.worlds.driver.read
        count = len(self._died)
        state = {name: read(getattr(worlds, name)[:count]) for name in ("stock", "in_play", "row", "col")}
        image = self._panels.join(boards(self._scene, state), UNSEEN)
        turns = read(worlds.step[:count])[:, 0].tolist()
        word = "turn " if count <= _LABELLED else ""
        labels = [f"{board}: {word}{turn}" for board, turn in enumerate(turns)]
        colours = np.where(self._died[:, None], DIED, TEXT).astype(np.uint8)
        return _WallRow(self._logger.step, self._logger.episode, frame, image, labels, colours)

    def _log(self, rows: Sequence[_WallRow], *, live_only: bool = False) -> None:
        steps, episodes, frames, images, labels, colours = zip(*rows, strict=True)
        texts = rr.Points2D.columns(labels=list(chain(*labels)), colors=np.concatenate(colours))
        columns_by_entity = {
            "wall/boards": rr.SegmentationImage.columns(buffer=np.stack(images).reshape(len(rows), -1)),
            "wall/labels": texts.partition([len(self._died)] * len(rows)),
        }
        for entity, columns in columns_by_entity.items():
            self._logger.log_columns(entity, (steps, episodes, frames), columns, live_only=live_only)
