"""The frames of a training: which episodes are recorded, and the first world step by step."""

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
from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.viewer.logger import RerunLogger
from cprl.viewer.panels import mosaic_size
from cprl.viewer.scenery import Curves, Scene

FRAMES_BYTES: Final = 45_000_000
"""The target size of a file's regular frames, about; the frames after new bests come on top."""

_PERIOD_S: Final = 1.0
_FEWEST_FRAMES: Final = 50
"""Frames are sent when an episode ends, or after a second if there are this many: each chunk has overhead."""


class FrameRecorder:
    """Copies the state of the first world after each step, and returns the frames when they are due.

    Windows show the observations of the `CommonsEnv` itself, without transforms.

    Args:
        capacity: the largest number of frames to keep; by default an episode, at most 5,000.
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
        self._capacity = capacity or min(steps + 1, 5000)
        self._arrays: dict[str, NDArray[Any]] = {
            name: np.zeros((self._capacity, *shape), dtype)
            for name, (shape, dtype) in _columns(game, has_windows=has_windows).items()
        }
        self.pending = 0
        """Frames that wait to be sent."""
        self._has_windows = has_windows
        self._has_tags = scene.has_tags
        self._tagged_by = np.full(game.agents, -1, np.int32)
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether there are frames to be sent now."""
        waited = time.perf_counter() - self._sent
        return self.pending == self._capacity or (waited > _PERIOD_S and self.pending >= _FEWEST_FRAMES)

    def add(self, batch: TensorDictBase, *, step: int, episode: int) -> None:
        """Copy a frame; `batch` is the latest step, and `step` counts those of the whole run."""
        if self._has_tags:
            self._remember_tags(batch)
        self.add_board(step=step, episode=episode)

    def add_board(self, *, step: int = 0, episode: int = 0) -> None:
        """Copy a frame of the board as it is, e.g. when an episode begins."""
        board = self.env.worlds.show(self.env.output)
        frame = {"step": step, "episode": episode, "beams": board.board == BEAM, "tagged_by": self._tagged_by}
        if self._has_windows:
            frame["windows"] = board.observation
        for name in ("stock", "row", "col", "heading", "in_play", "harvested"):
            frame[name] = getattr(board, name)
        for name, value in frame.items():
            self._arrays[name][self.pending] = value
        self.pending += 1

    def take(self) -> Mapping[str, NDArray[Any]] | None:
        """Return copies of all frames as columns, [T, ...] each, for `RerunLogger.log_frames`;
        None if there are none."""
        self._sent = time.perf_counter()
        if not self.pending:
            return None
        frames = {name: array[: self.pending].copy() for name, array in self._arrays.items()}
        self.pending = 0
        if self._has_windows:
            frames["windows"] = classes_seen(self.env.game, frames["windows"])
        return frames

    def _remember_tags(self, batch: TensorDictBase) -> None:
        """Notes who was tagged in the first world this turn, and by whom; of several shooters the first."""
        tagged_by = batch["next"][keys.TAGGED_BY][0].cpu().numpy()
        tagged = tagged_by.any(1)
        self._tagged_by[tagged] = tagged_by.argmax(1)[tagged]


def _columns(game: Game, *, has_windows: bool) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Return the shape and dtype of each part of a frame."""
    return {
        "step": ((), np.int64),
        "episode": ((), np.int64),
        "beams": ((game.map.height, game.map.width), np.bool_),  # the cells that a beam covers
        "stock": ((len(game.map.sites),), np.uint8),  # 1 for a site with an apple
        "windows": ((game.agents, *(game.observation_shape if has_windows else (0, 0, 0))), np.uint8),
        "in_play": ((game.agents,), np.bool_),
        "tagged_by": ((game.agents,), np.int32),  # who tagged the agent last; -1 if unknown
        **dict.fromkeys(("row", "col", "heading", "harvested"), ((game.agents,), np.int32)),
    }


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


def frame_bytes(scene: Scene) -> float:
    """The largest size of one frame in a file, about; with a trained population on `commons` it is 500."""
    rows, columns = mosaic_size(len(scene.agents), scene.window)
    return 80 + 45 * len(scene.agents) + 0.35 * (rows * columns + scene.height * scene.width)


class Filming:
    """Logs the frames of the first world in every k-th episode, including the first and the last, and in the
    episode after each new best.
    """

    def __init__(
        self, env: CommonsEnv | None, logger: RerunLogger, scene: Scene | None, *, episodes: int
    ) -> None:
        self._logger, self._last = logger, episodes - 1
        self._recorder: FrameRecorder | None = None
        if env is not None and scene is not None:
            self._recorder = FrameRecorder(env, episodes=episodes, scene=scene)
        self.every = 0 if self._recorder is None else self._recorder.every
        """Episodes from one with frames to the next; 0 for no frames."""
        self.shows_next = False
        """Whether the running episode is recorded in any case."""
        self.is_on = False
        """Whether frames are recorded now; `choose` decides it."""

    def is_shown(self, episode: int) -> bool:
        """Whether the frames of an episode that runs now are recorded."""
        is_chosen = self.every > 0 and (episode % self.every == 0 or self.shows_next or episode == self._last)
        return is_chosen and episode <= self._last

    def choose(self, episode: int) -> None:
        self.is_on = self.is_shown(episode)

    def add(self, batch: TensorDictBase, *, step: int, episode: int) -> int | None:
        """Copies a frame if this episode's are recorded; returns its number, None if there is none."""
        if self._recorder is None or not self.is_on:
            return None
        # Where an episode ends, the board is already that of the next one.
        if keys.entry(keys.entry(batch, "next"), keys.DONE)[0, 0]:
            self.send()
            return None
        self._recorder.add(batch, step=step, episode=episode)
        frame = self._logger.frames + self._recorder.pending - 1
        if self._recorder.is_due:
            self.send()
        return frame

    def send(self) -> None:
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self._logger.log_frames(frames)

    def state_dict(self) -> dict[str, Any]:
        self.send()
        return {"shows_next": self.shows_next, "frames": self._logger.frames}

    def load_state_dict(self, state: Mapping[str, Any], *, episode: int) -> None:
        self.shows_next, self._logger.frames = bool(state["shows_next"]), int(state["frames"])
        self.choose(episode)
