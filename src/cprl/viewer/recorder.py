"""FrameRecorder: the frames of the first world of a CommonsEnv, step by step."""

import time
from collections.abc import Mapping
from math import ceil
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.colours import BEAM
from cprl.commons.decoding import classes_seen
from cprl.envs.commons_env import CommonsEnv
from cprl.viewer.frames import Frame, FrameBuffer
from cprl.viewer.scenery import Curves, Scene
from cprl.viewer.stage import frame_bytes

FRAMES_BYTES: Final = 45_000_000
"""The target size of a file's regular frames, about; the frames after new bests come on top."""

_PERIOD_S: Final = 1.0
_NO_WINDOWS: Final = np.zeros((0, 0, 0), np.uint8)
_FEWEST_FRAMES: Final = 50
"""Frames are sent when an episode ends, or after a second if there are this many: each chunk has overhead."""


class FrameRecorder:
    """Copies the state of the first world after each step, and returns the frames when they are due.

    Windows show the observations of the `CommonsEnv` itself, without transforms.

    Args:
        env: the environment without its transforms.
        episodes: the number of episodes of the run; determines how often frames are recorded.
        scene: the contents of the board.
        capacity: the largest number of frames to keep; by default an episode, at most 5,000.
        has_windows: whether frames have the agents' windows; else these are empty.
    """

    def __init__(
        self,
        env: CommonsEnv,
        *,
        episodes: int,
        scene: Scene,
        capacity: int | None = None,
        has_windows: bool = True,
    ) -> None:
        game = env.game
        steps = game.rules.episode_steps
        self.env = env
        self.every = max(1, ceil(episodes * steps * frame_bytes(scene) / FRAMES_BYTES))
        """Episodes from one with frames to the next."""
        self._buffer = FrameBuffer(
            capacity or min(steps + 1, 5000),
            board=(game.map.height, game.map.width),
            sites=len(game.map.sites),
            windows=(game.agents, *(game.observation_shape if has_windows else (0, 0, 0))),
        )
        self._has_windows = has_windows
        self._has_tags = scene.has_tags
        self._tagged_by = np.full(game.agents, -1, np.int32)
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether there are frames to be sent now."""
        waited = time.perf_counter() - self._sent
        return self._buffer.is_full or (waited > _PERIOD_S and self._buffer.size >= _FEWEST_FRAMES)

    @property
    def pending(self) -> int:
        """Frames that wait to be sent."""
        return self._buffer.size

    def add(self, batch: TensorDictBase, *, step: int, episode: int) -> None:
        """Copies a frame; `batch` is the latest step."""
        if self._has_tags:
            self._remember_tags(batch)
        self._buffer.add(step, episode, self._frame())

    def add_board(self, *, step: int = 0, episode: int = 0) -> None:
        """Copies a frame of the board as it is, e.g. when an episode begins."""
        self._buffer.add(step, episode, self._frame())

    def take(self) -> Mapping[str, NDArray[Any]] | None:
        """The buffered frames, for `RerunLogger.log_frames`; None if there are none."""
        self._sent = time.perf_counter()
        if not self._buffer.size:
            return None
        frames = self._buffer.take()
        if self._has_windows:
            frames["windows"] = classes_seen(self.env.game, frames["windows"])
        return frames

    def _remember_tags(self, batch: TensorDictBase) -> None:
        """Notes who was tagged in the first world this turn, and by whom; of several shooters the first."""
        tagged_by = batch["next"][keys.TAGGED_BY][0].cpu().numpy()
        tagged = tagged_by.any(1)
        self._tagged_by[tagged] = tagged_by.argmax(1)[tagged]

    def _frame(self) -> Frame:
        shown = self.env.worlds.show(self.env.output)
        return Frame(
            beams=shown.board == BEAM,
            stock=shown.stock,
            windows=shown.observation if self._has_windows else _NO_WINDOWS,
            row=shown.row,
            col=shown.col,
            heading=shown.heading,
            in_play=shown.in_play,
            tagged_by=self._tagged_by,
            harvested=shown.harvested,
        )


def scene_of(env: CommonsEnv, curves: Curves, *, is_replay: bool) -> Scene:
    """The scene of an environment's recording, and the numbers that are plotted beside it."""
    board = env.game.map
    return Scene(
        **vars(curves),
        height=board.height,
        width=board.width,
        walls=board.walls,
        sites=board.sites,
        window=env.game.observation_shape[1:],
        actions=len(env.game.actions),
        is_replay=is_replay,
    )
