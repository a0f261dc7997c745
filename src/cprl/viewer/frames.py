"""Frames: which episodes are recorded turn by turn, and how the boards of all replicas go on beside them."""

import time
from collections.abc import Mapping, Sequence
from itertools import chain
from math import ceil
from typing import Any, Final, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.cells import BEAM
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.pictures.decoding import UNSEEN, classes_seen
from cprl.values.arrays import UInt8
from cprl.viewer.board import Frames, boards, image_form
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import DIED, TEXT
from cprl.viewer.scene import Scene, boards_of, windows_of
from cprl.viewer.views import View, has_died

FRAMES_BYTES: Final = 45_000_000
"""The target size of a file's regular frames, about; the frames after new bests come on top."""
_PERIOD_S: Final = 1.0
_FEWEST_FRAMES, _MOST_FRAMES = 50, 5000
"""Frames are sent when an episode ends, when there are many, or after a second if there are some: each chunk
has overhead."""


class FrameRecorder:
    """Copies the state of the first world after each step, and returns the frames when they are due.

    Windows show the observations of the `CommonsEnv` itself, without transforms.
    """

    def __init__(self, env: CommonsEnv, scene: Scene, *, has_windows: bool = True) -> None:
        self._env = env
        self._has_tags = scene.has_tags
        self._has_windows = has_windows
        self._frames: list[dict[str, NDArray[Any]]] = []
        self._tagged_by = np.full(env.game.agents, -1, np.int32)
        """Who tagged each agent last; -1 if unknown."""

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, batch: TensorDictBase | None = None, *, step: int = 0, episode: int = 0) -> None:
        """Copy a frame; `batch` is the latest step, None before the first of an episode, and `step` counts
        those of the whole run."""
        if batch is not None and self._has_tags:  # of several shooters the first
            tagged_by = batch["next"][keys.TAGGED_BY][0].cpu().numpy()
            tagged = tagged_by.any(1)
            self._tagged_by[tagged] = tagged_by.argmax(1)[tagged]
        board = self._env.worlds.show(self._env.output)
        frame = {"step": step, "episode": episode, "beams": board.board == BEAM, "tagged_by": self._tagged_by}
        for name in ("stock", "row", "col", "heading", "in_play", "harvested"):
            frame[name] = getattr(board, name)
        if self._has_windows:
            frame["windows"] = board.observation
        self._frames.append({name: np.array(value) for name, value in frame.items()})

    def take(self) -> Frames | None:
        """Return all frames as columns, [T, ...] each, for `RerunLogger.log_frames`, or None."""
        taken = self._frames
        self._frames = []
        if not taken:
            return None
        frames = {name: np.stack([frame[name] for frame in taken]) for name in taken[0]}
        if self._has_windows:
            frames["windows"] = classes_seen(self._env.game, frames["windows"])
        return frames


class Filming(View):
    """Logs the frames of the first world in every k-th episode, including the first and the last, and in the
    episode after each new best.

    Args:
        env: the worlds; None for a game without a board, of which there are no frames.
        episodes: that the first world plays.
    """

    def __init__(self, env: CommonsEnv | None, logger: RerunLogger, *, episodes: int) -> None:
        self._logger = logger
        self._last = episodes - 1
        self._sent = time.perf_counter()
        self._recorder: FrameRecorder | None = None
        self._ended = 0
        self._shows = False
        self.was_on = False
        """Whether the last episode of the first world was recorded."""
        self.every = 0
        """Episodes from one with frames to the next; 0 for no frames."""
        self.frame: int | None = None
        """The number of the frame of this turn, if it has one."""
        if env is not None and (scene := logger.scene) is not None:
            self._recorder = FrameRecorder(env, scene)
            rows, columns = windows_of(len(scene.agents), scene.window).shape
            # The largest size of a frame, about; with a trained population on `commons` it is 500 bytes.
            size = 80 + 45 * len(scene.agents) + 0.35 * (rows * columns + scene.height * scene.width)
            self.every = max(1, ceil(episodes * env.game.rules.episode_steps * size / FRAMES_BYTES))
        self.is_on = self.is_shown(0)
        """Whether the running episode is recorded."""

    def is_shown(self, episode: int) -> bool:
        """Return whether the frames of an episode that runs now are recorded."""
        is_chosen = self.every > 0 and (episode % self.every == 0 or self._shows or episode == self._last)
        return is_chosen and episode <= self._last

    def show(self, *, shows: bool = True) -> None:
        """Record the running episode in any case."""
        self._shows = shows
        self.is_on = self.is_shown(self._ended)

    def on_step(self, batch: TensorDictBase) -> None:
        """Copy a frame if this episode's are recorded."""
        self.frame = None
        if self._recorder is None or not self.is_on:
            return
        # Where an episode ends, the board is already that of the next one.
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[0, 0]:
            self.close()
            return
        self._recorder.add(batch, step=self._logger.step, episode=self._logger.episode)
        count = len(self._recorder)
        self.frame = self._logger.frames + count - 1
        waited_s = time.perf_counter() - self._sent
        if count >= _MOST_FRAMES or (waited_s > _PERIOD_S and count >= _FEWEST_FRAMES):
            self.close()

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        if episode.world == 0:
            self._ended += 1
            self.was_on = self.is_on
            self.show(shows=False)

    def close(self) -> None:
        """Log the frames so far."""
        self._sent = time.perf_counter()
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self._logger.log_frames(frames)


WALL_BYTES: Final = 4_000_000
"""The target size of the wall in a file, about."""
_LIVE_PERIOD_S: Final = 2.0
_LIVE_ROWS: Final = 10_000
"""From then on rows for viewers get rarer, because a server's memory holds them: period = time / rows."""
_FEWEST_STEPS: Final = 10
"""Steps from one row of the file to the next, at least."""
_LABELLED: Final = 8
"""The largest number of boards whose labels say "turn" before its number."""
_Row: TypeAlias = tuple[int, int, int, UInt8, list[str], UInt8]
"""A step, episode and frame, the image, and the text of each board and its colour."""


class Wall(View):
    """Logs the boards of all replicas, or of the first worlds of one: same rules, as many fates.

    Viewers get them every two seconds, after hours more rarely; the file gets every so many steps of the
    episodes whose frames are recorded. The text of a board says its turn, in orange if the episode of its
    world before this one ended because no apple was left.

    Args:
        recorded_steps: the steps of the run whose frames are recorded, about; determines how many have a row.
    """

    def __init__(
        self, env: CommonsEnv, logger: RerunLogger, filming: Filming, scene: Scene, *, recorded_steps: int
    ) -> None:
        self._env = env
        self._logger = logger
        self._filming = filming
        self._scene = scene
        self._panels = boards_of(scene, scene.boards)
        rows, columns = self._panels.shape
        row_bytes = 100 + 20 * scene.boards + 0.35 * rows * columns
        self._apart = max(_FEWEST_STEPS, ceil(recorded_steps * row_bytes / WALL_BYTES))
        self._died = np.zeros(scene.boards, np.bool_)
        self._rows: list[_Row] = []
        self._began = self._due = time.perf_counter()
        form = rr.SegmentationImage.from_fields(format=image_form(self._panels.shape), opacity=1.0)
        logger.log_static("wall/boards", form)
        logger.log_static("wall/labels", self._panels.labels(colours=None))

    def on_step(self, batch: TensorDictBase) -> None:
        frame = self._filming.frame
        if frame is not None and self._logger.turn % self._apart == 0:
            self._rows.append(self._row(frame))
        elif (now := time.perf_counter()) > self._due:
            self._due = now + max(_LIVE_PERIOD_S, (now - self._began) / _LIVE_ROWS)
            if self._logger.is_live:
                self._log([self._row(self._logger.frames)], live_only=True)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Note whether the board has died, and log the rows of the episode."""
        if episode.world < len(self._died):
            self._died[episode.world] = bool(has_died(episode))
        if episode.world == 0:
            self.close()

    def close(self) -> None:
        if self._rows:
            self._log(self._rows)
            self._rows = []

    def _row(self, frame: int) -> _Row:
        now = self._env.worlds.now
        read = self._env.worlds.driver.read
        count = len(self._died)
        state = {name: read(getattr(now, name)[:count]) for name in ("stock", "in_play", "row", "col")}
        image = self._panels.joined(boards(self._scene, state), UNSEEN)
        turns = read(now.step[:count])[:, 0].tolist()
        word = "turn " if count <= _LABELLED else ""  # more labels would stand on each other
        labels = [f"{board}: {word}{turn}" for board, turn in enumerate(turns)]
        colours = np.where(self._died[:, None], DIED, TEXT).astype(np.uint8)
        return self._logger.step, self._logger.episode, frame, image, labels, colours

    def _log(self, rows: Sequence[_Row], *, live_only: bool = False) -> None:
        steps, episodes, frames, images, labels, colours = zip(*rows, strict=True)
        texts = rr.Points2D.columns(labels=list(chain(*labels)), colors=np.concatenate(colours))
        parts = {
            "wall/boards": rr.SegmentationImage.columns(buffer=np.stack(images).reshape(len(rows), -1)),
            "wall/labels": texts.partition([len(self._died)] * len(rows)),
        }
        for entity, columns in parts.items():
            self._logger.log_columns(entity, (steps, episodes, frames), columns, live_only=live_only)
