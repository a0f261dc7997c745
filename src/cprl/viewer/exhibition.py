"""Exhibition: a world of its own that the present policy of a training plays, for viewers alone."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from threading import Event
from typing import Any, Final, Protocol

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from cprl.commons.game import Game
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.stepping import begin_states
from cprl.envs.unwrap import commons_of
from cprl.system.compat import send_chunk
from cprl.viewer.frames import FrameRecorder
from cprl.viewer.logger import components
from cprl.viewer.scenery import BACKGROUND, Scene
from cprl.viewer.stage import IMAGES, RIM_CELLS, Frames, board_columns, board_styles, image_form
from cprl.viewer.streams import Live

_CAPTION_CELLS, _ROOM_CELLS = 0.4, 2.4
"""The distances from the board to the caption and to the line that gives it room, in cells."""
_THIN: Final = 0.01


def send_fixed(recording: Any, *, scene: Scene) -> None:
    """Sends what never changes, to the server that keeps it for viewers that come later.

    The formats of images are not among it, but in each frame: a viewer that gets one after a frame, for the
    first time or again, shows no board until the next frame.
    """
    for entity, parts in board_styles().items():
        recording.log(f"exhibition/{entity}", *parts, static=True)
    low = scene.height + 2 * RIM_CELLS + _ROOM_CELLS
    line = [(0.0, low), (scene.width + 2 * RIM_CELLS, low)]  # hidden; the view makes room for what it shows
    room = rr.LineStrips2D([line], radii=_THIN, colors=[BACKGROUND])
    recording.log("exhibition/room", room, static=True)
    place = (scene.width / 2 + RIM_CELLS, scene.height + 2 * RIM_CELLS + _CAPTION_CELLS)
    caption = rr.Points2D([place], show_labels=True, radii=_THIN, colors=[(255, 255, 255)])
    recording.log("exhibition/caption", caption, static=True)


def send_frames(
    recording: Any,
    *,
    scene: Scene,
    frames: Frames,
    caption: str,
    wait: Callable[[float], bool],
    lasting_s: float,
) -> None:
    """Sends frames one by one.

    Args:
        frames: of `FrameRecorder.take`, [T, ...].
        wait: waits so many seconds; returns whether to leave out the rest.
        lasting_s: seconds over which they are spread.
    """
    text = rr.Points2D.columns(labels=np.array([caption]))
    send_chunk(recording, "exhibition/caption", {}, components(text))
    rows = _rows(scene, frames)
    for sent, row in enumerate(rows, 1):
        for entity, parts in row:
            send_chunk(recording, f"exhibition/{entity}", {}, parts)
        if sent < len(rows) and wait(lasting_s / len(rows)):
            return


def _rows(scene: Scene, frames: Frames) -> list[list[tuple[str, dict[Any, Any]]]]:
    """What each frame changes: entities, and their `pyarrow` arrays by component descriptor."""
    rows: list[list[tuple[str, dict[Any, Any]]]] = [[] for _ in frames["step"]]
    form = image_form((scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS))
    for entity, (numbers, columns) in board_columns(scene, frames).items():
        arrays = components(columns)
        if entity in IMAGES:
            arrays |= components(rr.SegmentationImage.columns(format=[form] * len(numbers)))
        for place, number in enumerate(numbers):
            rows[number].append((entity, {kind: array.slice(place, 1) for kind, array in arrays.items()}))
    return rows


BATCH_S: Final = 2.0
"""Seconds whose steps are played at once, because many steps in a row take a quarter of the time of as many
between steps of the training; they are sent one by one."""

BATCH_STEPS: Final = 21
"""Steps of the exhibited world in this time: 10.5 in a second of wall time."""

MOST_SHARE: Final = 0.01
"""The share of the training's wall time that its thread may spend on the exhibition: where a step of it takes
longer than 0.95 ms, it plays fewer."""

LONGEST_S: Final = 10.0
"""The longest time that a viewer sees the same board, if a step took exceptionally long."""


class Exhibited(Protocol):
    """All agents of one world; `cprl.policies.present.PresentPolicy` is one."""

    is_trained: bool
    """Whether the training is over."""

    @property
    def epsilons(self) -> Sequence[float]:
        """The probabilities with which agents act at random, ascending; empty for agents without any."""

    def explore_as_now(self) -> None:
        """Sets each agent's exploration to what it is now."""

    def apart(self) -> AbstractContextManager[Any]:
        """A context to play steps in: agents explore as they do when it begins, and nothing changes torch's
        generators for the rest of the process."""

    def __call__(self, carried: TensorDictBase) -> TensorDictBase:
        """Writes ("agents", "action"), int64 [1, N]; called within `apart`."""


class Exhibition:
    """Plays steps when they are due, and sends viewers the board as static entities: they have no time.

    So a viewer shows the newest board wherever its cursor is and on every timeline, and keeps that one alone,
    however long the training takes. Nothing of it is written to the file. If it fails, it warns once, and the
    training continues without it.

    Args:
        env: one world that no training or evaluation plays, with the transforms of the training.
        trained: the environment of the training; what its transforms learn is taken over.
        clock: seconds of wall time.
        wait: waits so many seconds between two frames, in the thread that sends them; returns whether to
            leave out the rest. By default until `close`.
    """

    def __init__(
        self,
        policy: Exhibited,
        env: EnvBase,
        *,
        trained: EnvBase,
        scene: Scene,
        live: Live,
        clock: Callable[[], float] = time.perf_counter,
        wait: Callable[[float], bool] | None = None,
    ) -> None:
        commons = commons_of(env)
        if commons is None or tuple(env.batch_size) != (1,):
            raise ValueError(
                f"the exhibition has a {type(env).__name__} of batch size {list(env.batch_size)}; allowed: "
                "one world of a CommonsEnv, with transforms or without"
            )
        self._policy, self._env, self._trained, self._scene = policy, env, trained, scene
        self._live, self._clock, self._closing = live, clock, Event()
        self._wait = wait or self._slept
        self._recorder = FrameRecorder(
            commons, episodes=1, scene=scene, capacity=BATCH_STEPS, has_windows=False
        )
        self._carried: TensorDictBase | None = None
        self._due, self._count = clock(), BATCH_STEPS
        self.steps = 0
        """Steps played so far."""
        self.is_over = live.stream is None or live.exhibition is None
        """Whether it has ended, because it failed or has no viewers."""
        if live.stream is not None:
            live.stream.do(partial(send_fixed, scene=scene))
        # Compiling may take half a minute, and of a run that is resumed no policy is loaded yet.
        self._send(_before_the_first_step(commons.game), "the board as an episode begins")

    def on_step(self, *, episode: int) -> None:
        """Plays the steps of two seconds if they are due; `episode` is the training's, for the caption."""
        now = self._clock()
        if now >= self._due and not self.is_over:
            self._due = now + BATCH_S
            self._play(episode)

    def play_on(self, stop: Event, *, episode: int) -> None:
        """Plays the trained policy until the event is set; returns at once where it has ended."""
        self._policy.is_trained = True
        while not (self.is_over or stop.is_set()):
            self._play(episode)
            stop.wait(BATCH_S)

    def close(self) -> None:
        """Leaves out frames that have not been sent."""
        self._closing.set()

    def _slept(self, seconds: float) -> bool:
        """Whether `close` was called by the end of so many seconds; an event's own `wait` takes
        longer to end, and keeps the training from going on meanwhile."""
        time.sleep(seconds)
        return self._closing.is_set()

    def _play(self, episode: int) -> None:
        """Plays some steps, and has them sent; fewer the next time if they took long."""
        if self._live.exhibition is None or self._live.exhibition.is_behind:
            return
        began = self._clock()
        try:
            with self._policy.apart():
                for _ in range(self._count):
                    self._step()
        except Exception as error:
            self.is_over = True
            warnings.warn(
                f"the exhibition failed, the run continues without it: {type(error).__name__}: {error}",
                RuntimeWarning,
                stacklevel=4,
            )
            return
        spent = self._clock() - began
        is_first = self.steps == self._count  # much of it was compiling
        self._due = max(self._due, began + (0.0 if is_first else min(spent / MOST_SHARE, LONGEST_S)))
        affordable = int(MOST_SHARE * BATCH_S / max(spent / self._count, 1e-9))
        self._count = max(1, min(BATCH_STEPS, affordable))
        frames = self._recorder.take()
        if frames is not None:
            self._send(frames, caption_of(self._policy, episode))

    def _step(self) -> None:
        """One step of the world, of which the recorder then has a frame; the first only begins an episode."""
        self.steps += 1
        if self._carried is None:
            self._carried = self._env.reset()
            self._recorder.add_board()
            return
        batch, self._carried = self._env.step_and_maybe_reset(self._policy(self._carried))
        begin_states(self._carried, self._carried, batch)
        self._recorder.add(batch, step=0, episode=0)
        if isinstance(self._env, TransformedEnv) and self.steps % BATCH_STEPS == 0:
            load_transforms_state(self._env, transforms_state(self._trained))

    def _send(self, frames: Mapping[str, NDArray[Any]], caption: str) -> None:
        if self._live.exhibition is not None:
            self._live.exhibition.do(
                partial(
                    send_frames,
                    scene=self._scene,
                    frames=frames,
                    caption=caption,
                    wait=self._wait,
                    lasting_s=BATCH_S,
                )
            )


def caption_of(policy: Exhibited, episode: int) -> str:
    """What is shown: "present policy, episode 1,234, epsilon 0.31", without the last for agents that have no
    epsilon."""
    policy.explore_as_now()
    chances = list(dict.fromkeys(f"{epsilon:.2f}" for epsilon in policy.epsilons))
    chance = f", epsilon {' to '.join(dict.fromkeys((chances[0], chances[-1])))}" if chances else ""
    return f"{'trained' if policy.is_trained else 'present'} policy, episode {episode:,}{chance}"


def _before_the_first_step(game: Game) -> dict[str, NDArray[Any]]:
    """The frame of the board as an episode begins, drawn from the map."""
    board = game.map
    row, col, heading = np.array(board.starts, np.int32).T
    one = {
        "step": np.zeros((), np.int64),
        "beams": np.zeros((board.height, board.width), np.bool_),
        "stock": np.ones(len(board.sites), np.uint8),
        "row": row,
        "col": col,
        "heading": heading,
        "in_play": np.ones(game.agents, np.bool_),
        "tagged_by": np.full(game.agents, -1, np.int32),
    }
    return {name: array[None] for name, array in one.items()}
