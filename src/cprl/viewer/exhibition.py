"""Exhibition: a world of its own that the present policy of a training plays, for viewers alone."""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from threading import Event
from typing import Any, Final, Protocol

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from cprl.commons.colours import (
    APPLE,
    BEAM,
    FIRST_AGENT,
    GROUND,
    MARK,
    PALETTE,
    Colour,
    agent_colour,
    class_name,
    picture_colour,
)
from cprl.commons.game import Game
from cprl.commons.picture import INK_COLOUR, MARK_COLOUR
from cprl.commons.world import Bytes
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.stepping import begin_states
from cprl.envs.unwrap import commons_of
from cprl.system.compat import rows_made, send_chunk, send_made
from cprl.viewer.frames import FrameRecorder
from cprl.viewer.logger import components
from cprl.viewer.scenery import BACKGROUND, Scene, packed
from cprl.viewer.stage import (
    BEAM_OPACITY,
    OUT_STROKE_CELLS,
    RADIUS_CELLS,
    RIM_CELLS,
    Frames,
    Strokes,
    alone_of,
    boards,
    centres_of,
    image_form,
    marks,
    numbers,
    numbers_and_headings,
    squares,
)
from cprl.viewer.streams import Live


def ragged(form: Any, counts: NDArray[np.integer[Any]], values: NDArray[Any]) -> Any:
    """Rows of numbers, lines or bytes, as `cprl.system.compat.send_chunk` takes them.

    Args:
        form: the `pyarrow` type of the column: lists of numbers, of lists of numbers, or of lists of points.
        counts: how many entries each row has, [T].
        values: the entries of all rows one after the other, in C order: [entries], [entries, length] or
            [entries, length, 2], with the dtype that the type says.
    """
    ends = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=ends[1:])
    return _listed(form, ends, _entries(form.value_type, values))


def _entries(form: Any, values: NDArray[Any]) -> Any:

    if values.ndim == 1:
        return pa.Array.from_buffers(form, len(values), [None, pa.py_buffer(values)])
    count, length = values.shape[:2]
    if pa.types.is_fixed_size_list(form):
        inner = _entries(form.value_type, values.reshape(-1))
        return pa.Array.from_buffers(form, count, [None], children=[inner])
    ends = np.arange(count + 1, dtype=np.int32) * np.int32(length)
    return _listed(form, ends, _entries(form.value_type, values.reshape(count * length, *values.shape[2:])))


def _listed(form: Any, ends: NDArray[np.int32], entries: Any) -> Any:

    return pa.Array.from_buffers(form, len(ends) - 1, [None, pa.py_buffer(ends)], children=[entries])


_BOARD: Final = "exhibition/board"
_LIT_APPLE: Final = MARK
"""The class of an apple under a beam; boards have no other use for it."""

_CAPTION_CELLS, _ROOM_CELLS = 0.4, 2.4
"""The distances from the board to the caption and to the line that gives it room, in cells."""
_THIN: Final = 0.01


def send_fixed(recording: Any, *, scene: Scene) -> None:
    """Sends what never changes, to the server that keeps it for viewers that come later.

    The format of the image is not among it, but in each frame: a viewer that gets it after a frame, for the
    first time or again, shows no board until the next frame.
    """
    picture = rr.SegmentationImage.from_fields(opacity=1.0, draw_order=-10.0)
    recording.log(_BOARD, _classes(len(scene.agents)), picture, static=True)
    low = scene.height + 2 * RIM_CELLS + _ROOM_CELLS
    line = [(0.0, low), (scene.width + 2 * RIM_CELLS, low)]  # hidden; the view makes room for what it shows
    room = rr.LineStrips2D([line], radii=_THIN, colors=[BACKGROUND])
    recording.log("exhibition/room", room, static=True)
    place = (scene.width / 2 + RIM_CELLS, scene.height + 2 * RIM_CELLS + _CAPTION_CELLS)
    caption = rr.Points2D([place], show_labels=True, radii=_THIN, colors=[(255, 255, 255)])
    recording.log("exhibition/caption", caption, static=True)


def _classes(agents: int) -> Any:
    """Names and colours of the classes on the exhibited board."""
    known = {kind: (class_name(kind), picture_colour(kind)) for kind in range(FIRST_AGENT + agents)}
    known[BEAM] = "beam", _lit(GROUND)
    known[_LIT_APPLE] = "apple under a beam", _lit(APPLE)
    return rr.AnnotationContext(
        [rr.AnnotationInfo(id=kind, label=label, color=colour) for kind, (label, colour) in known.items()]
    )


def _lit(kind: int) -> Colour:
    """The colour of a class under a beam."""
    pairs = zip(PALETTE[BEAM], PALETTE[kind], strict=True)
    red, green, blue = (round(BEAM_OPACITY * over + (1 - BEAM_OPACITY) * under) for over, under in pairs)
    return red, green, blue


class LiveBoard:
    """Sends the board with its agents as one entity, each frame as one row.

    Whatever is done here in Python keeps the training from going on. So a frame is an image, with classes of
    their own for cells under a beam, and lines in one column; rows are made once for all frames, and Rerun's
    native part sends them. Squares of agents out of play have no labels, unlike in a recording.
    """

    def __init__(self, scene: Scene) -> None:

        self._scene, agents = scene, len(scene.agents)
        hues = np.array([packed(agent_colour(agent)) for agent in range(agents)], np.uint32)
        ink, mark = (np.full(agents, packed(colour), np.uint32) for colour in (INK_COLOUR, MARK_COLOUR))
        kinds = (
            (numbers_and_headings(agents), 0, ink, RADIUS_CELLS),
            (marks(agents), 0, mark, RADIUS_CELLS),
            (squares(agents), 1, hues, OUT_STROKE_CELLS),
            (numbers(agents), 2, hues, RADIUS_CELLS),
        )
        self._strokes = Strokes(
            np.concatenate([strokes.owner for strokes, *_ in kinds]),
            np.concatenate([strokes.shape for strokes, *_ in kinds], 1),
        )
        lines = [len(strokes.owner) for strokes, *_ in kinds]
        self._when = np.repeat([when for _, when, _, _ in kinds], lines)
        """When each line is drawn: its agent is in play 0, out 1, or out with its cell to itself 2."""
        self._colours = np.concatenate([colours[strokes.owner] for strokes, _, colours, _ in kinds])
        self._radii = np.repeat(np.array([radius for *_, radius in kinds], np.float32), lines)
        size = scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS
        picture = rr.SegmentationImage.columns(buffer=np.zeros((1, 1), np.uint8))
        self._form = components(rr.SegmentationImage.columns(format=[image_form(size)]))
        """The format of the image, as one row."""
        drawn = rr.LineStrips2D.columns(strips=np.zeros((1, 2, 2), np.float32), colors=[0], radii=[0.0])
        kept = {own.component_descriptor(): own.as_arrow_array().type for own in (*picture, *drawn)}
        self._forms = {kind.component.partition(":")[2]: (kind, form) for kind, form in kept.items()}

    def send(
        self, recording: Any, *, frames: Frames, caption: str, wait: Callable[[float], bool], lasting_s: float
    ) -> None:
        """Sends frames one by one.

        Args:
            frames: of `FrameRecorder.take`, [T, ...].
            wait: waits so many seconds; returns whether to leave out the rest.
            lasting_s: seconds over which they are spread.
        """
        text = rr.Points2D.columns(labels=np.array([caption]))
        send_chunk(recording, "exhibition/caption", {}, components(text))
        rows = rows_made(_BOARD, self.columns(frames))
        for at, row in enumerate(rows, 1):
            send_made(recording, row)
            if at < len(rows) and wait(lasting_s / len(rows)):
                return

    def columns(self, frames: Frames) -> Mapping[Any, Any]:
        """The rows of T frames as `pyarrow` arrays, by component descriptor."""
        pictures, (lines, line, counts) = self._pictures(frames), self._lines(frames)
        parts: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {
            "buffer": (np.ones(len(pictures), np.int32), pictures.reshape(len(pictures), -1)),
            "strips": (counts, lines),
            "colors": (counts, self._colours[line]),
            "radii": (counts, self._radii[line]),
        }
        made = {kind: row.take([0] * len(pictures)) for kind, row in self._form.items()}
        for name, (of_row, values) in parts.items():
            kind, form = self._forms[name]
            made[kind] = ragged(form, of_row, values)
        return made

    def _pictures(self, frames: Frames) -> Bytes:
        """Images of classes, uint8 [T, H + 2, W + 2]; a beam that covers an agent is behind it."""
        pictures = boards(self._scene, frames)
        inner = pictures[:, RIM_CELLS:-RIM_CELLS, RIM_CELLS:-RIM_CELLS]
        covered = frames["beams"]
        if covered.any():
            inner[covered & (inner == GROUND)] = BEAM
            inner[covered & (inner == APPLE)] = _LIT_APPLE
        return pictures

    def _lines(self, frames: Frames) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
        """The lines of all frames one after the other, float32 [lines, P, 2], which line each is, and how
        many each frame has."""
        in_play, owner = frames["in_play"], self._strokes.owner
        alone = in_play if in_play.all() else alone_of(frames)  # nobody is out, so neither is read
        drawn = np.stack([in_play, ~in_play, alone & ~in_play])[self._when, :, owner].T
        lines, counts = self._strokes.placed_lines(centres_of(frames), frames["heading"], drawn)
        return lines, np.nonzero(drawn)[1], counts


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
        self._policy, self._env, self._trained, self._board = policy, env, trained, LiveBoard(scene)
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
            shown = partial(self._board.send, frames=frames, caption=caption)
            self._live.exhibition.do(partial(shown, wait=self._wait, lasting_s=BATCH_S))


def caption_of(policy: Exhibited, episode: int) -> str:
    """What is shown: "present policy, episode 1,234, epsilon 0.31", without the last for agents that have no
    epsilon."""
    policy.explore_as_now()
    shown = list(dict.fromkeys(f"{epsilon:.2f}" for epsilon in policy.epsilons))
    chance = f", epsilon {' to '.join(dict.fromkeys((shown[0], shown[-1])))}" if shown else ""
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
    }
    return {name: array[None] for name, array in one.items()}
