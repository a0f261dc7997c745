"""The frames of a training: which episodes are recorded, and the first world step by step."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import ceil
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.colours import BEAM
from cprl.commons.decoding import classes_seen
from cprl.commons.world import Bools, Bytes, Ints
from cprl.envs.commons_env import CommonsEnv
from cprl.viewer.logger import RerunLogger
from cprl.viewer.panels import mosaic_size
from cprl.viewer.scenery import Curves, Scene


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One world after one step."""

    beams: Bools
    """bool [H, W], the cells that a beam covers."""
    stock: Bytes
    """uint8 [K], 1 for a site with an apple."""
    windows: Bytes
    """uint8 [N, C, X, Y], what each agent observes."""
    row: Ints
    """int32 [N]."""
    col: Ints
    """int32 [N]."""
    heading: Ints
    """int32 [N], 0 up, 1 right, 2 down, 3 left."""
    in_play: Bools
    """bool [N]."""
    tagged_by: Ints
    """int32 [N], the agent that tagged this one last; -1 if unknown."""
    harvested: Ints
    """int32 [N], apples harvested in this episode."""


class FrameBuffer:
    """A buffer of frames, allocated once: `add` copies a frame, `take` returns all frames.

    Args:
        board: (H, W).
        windows: (N, C, X, Y).
    """

    def __init__(
        self, capacity: int, *, board: tuple[int, int], sites: int, windows: tuple[int, int, int, int]
    ) -> None:
        agents = windows[0]
        self.capacity, self.size = capacity, 0
        self._arrays: dict[str, NDArray[Any]] = {
            "step": np.zeros(capacity, np.int64),
            "episode": np.zeros(capacity, np.int64),
            "beams": np.zeros((capacity, *board), np.bool_),
            "stock": np.zeros((capacity, sites), np.uint8),
            "windows": np.zeros((capacity, *windows), np.uint8),
            "in_play": np.zeros((capacity, agents), np.bool_),
            **{
                name: np.zeros((capacity, agents), np.int32)
                for name in ("row", "col", "heading", "tagged_by", "harvested")
            },
        }

    @property
    def is_full(self) -> bool:
        """Whether the buffer is full."""
        return self.size == self.capacity

    def add(self, step: int, episode: int, frame: Frame) -> None:
        """Copies a frame; `step` counts environment steps of the whole run."""
        if self.is_full:
            raise ValueError(f"the buffer already has {self.capacity} frames; call take() before add()")
        arrays, at = self._arrays, self.size
        arrays["step"][at], arrays["episode"][at] = step, episode
        for field in fields(Frame):
            arrays[field.name][at] = getattr(frame, field.name)
        self.size += 1

    def take(self) -> dict[str, NDArray[Any]]:
        """Copies of all frames as columns, [T, ...] each; the buffer is empty afterwards."""
        taken = {name: array[: self.size].copy() for name, array in self._arrays.items()}
        self.size = 0
        return taken


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
        episodes: the number of episodes of the run; determines how often frames are recorded.
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


def frame_bytes(scene: Scene) -> float:
    """The largest size of one frame in a file, about; with a trained population on `commons` it is 500."""
    rows, columns = mosaic_size(len(scene.agents), scene.window)
    return 80 + 45 * len(scene.agents) + 0.35 * (rows * columns + scene.height * scene.width)


class Filming:
    """Logs the frames of the first world in every k-th episode, including the first and the last, and in the
    episode after each new best.

    Args:
        env: the environment without its transforms; None for no frames.
        scene: the contents of the board; None for no frames.
        episodes: the number of episodes of the run; determines how often frames are recorded.
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
        """Records from now on if the frames of this episode are recorded."""
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
        """Sends the frames that wait."""
        frames = None if self._recorder is None else self._recorder.take()
        if frames is not None:
            self._logger.log_frames(frames)

    def state_dict(self) -> dict[str, Any]:
        self.send()
        return {"shows_next": self.shows_next, "frames": self._logger.frames}

    def load_state_dict(self, state: Mapping[str, Any], *, episode: int) -> None:
        self.shows_next, self._logger.frames = bool(state["shows_next"]), int(state["frames"])
        self.choose(episode)
