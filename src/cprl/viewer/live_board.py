"""The exhibited board, as viewers get it: static entities, so that they keep the newest frame alone."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

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
from cprl.commons.sprites import INK_COLOUR, MARK_COLOUR
from cprl.commons.world import Bytes
from cprl.compat import rows_made, send_chunk, send_made
from cprl.viewer.arrows import ragged
from cprl.viewer.batches import components
from cprl.viewer.scenery import BACKGROUND, Scene
from cprl.viewer.stage import BEAM_OPACITY, RIM_CELLS, Frames, alone_of, boards, centres_of, image_form
from cprl.viewer.strokes import (
    OUT_STROKE_CELLS,
    RADIUS_CELLS,
    Strokes,
    marks,
    numbers,
    numbers_and_headings,
    squares,
)

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
    import rerun as rr

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
    import rerun as rr

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

    Args:
        scene: the contents of the board.
    """

    def __init__(self, scene: Scene) -> None:
        import rerun as rr

        self._scene, agents = scene, len(scene.agents)
        hues = np.array([_packed(agent_colour(agent)) for agent in range(agents)], np.uint32)
        ink, mark = (np.full(agents, _packed(colour), np.uint32) for colour in (INK_COLOUR, MARK_COLOUR))
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
        self,
        recording: Any,
        *,
        frames: Frames,
        caption: str,
        wait: Callable[[float], bool],
        lasting_s: float,
    ) -> None:
        """Sends frames one by one.

        Args:
            recording: the stream.
            frames: of `FrameRecorder.take`, [T, ...].
            caption: the text below the board.
            wait: waits so many seconds; returns whether to leave out the rest.
            lasting_s: seconds over which they are spread.
        """
        import rerun as rr

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


def _packed(colour: Colour) -> int:
    """An opaque colour as Rerun's 0xRRGGBBAA."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 255
