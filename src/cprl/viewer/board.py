"""Turns frames of a board into Rerun's columns: cells, agents, beams, stock, and the agents' windows."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cprl.commons.cells import APPLE, BEAM, FIRST_AGENT, GROUND, WALL
from cprl.pictures.colours import PALETTE, agent_colour, agent_mark
from cprl.pictures.decoding import UNSEEN
from cprl.pictures.image import DIGIT_HIGH, INK_COLOUR, MARK_COLOUR, POINTS, number_paths
from cprl.values.array_types import Bool, Float32, UInt8
from cprl.viewer.names import EMPTY_SITE, TEXT
from cprl.viewer.scene import Scene, windows_of

Frames = Mapping[str, NDArray[Any]]
"""T frames as columns [T, ...] by name, as `FrameRecorder.take` returns them. Windows hold the classes of
`cprl.pictures.decoding.classes_seen`."""
Columns = dict[str, tuple[NDArray[np.intp], Any]]
"""By the path of an entity: the frames that show it, and its columns there."""

_LINE_RADIUS_CELLS: Final = 0.045
"""Half the width of a line, in cells."""
_OUT_HALF_CELLS: Final = 0.4
"""Half the side of the square of an agent out of play, in cells."""
OUT_LINE_RADIUS_CELLS: Final = 0.07
"""Half the width of the line of that square, in cells."""

_TIP_CELLS: Final = 0.44
"""The distance of the tip of an agent's triangle from the middle of its cell, in cells."""
_TRIANGLE_DEPTH_CELLS: Final = 0.15
_TRIANGLE_HALF_WIDTH_CELLS: Final = 0.16
_MARK_WIDTH_CELLS: Final = 0.09
"""The width of the ring or the stripe that distinguishes agents of the same hue, in cells."""
_DIGIT_POINT_CELLS: Final = 0.09
"""The largest distance between two points of a digit, in cells."""
_TURNS: Final = np.array([[1], [1j], [-1], [-1j]])
"""For each heading the factor that turns a point x + 1j * y of an agent that faces up; y grows downwards."""


class Glyphs(NamedTuple):
    """S lines that are drawn on the cells of agents, such as their numbers, for each of the four headings."""

    agent_of_line: NDArray[np.intp]
    """int [S], the agent on whose cell each line is drawn."""
    corners: Float32
    """float32 [4, S, P, 2], the corners (x, y) of each line, in cells from the middle of the agent's cell."""

    def place(
        self, centres: Float32, heading: NDArray[np.integer], drawn: Bool
    ) -> tuple[Float32, NDArray[np.intp], NDArray[np.intp]]:
        """Place the lines on the board in every frame.

        Args:
            centres: float32 [T, N, 2], the middle of each agent's cell, (x, y).
            heading: int [T, N].
            drawn: bool [T, N], the agents whose lines are drawn.

        Returns:
            The drawn lines of all frames one after the other, float32 [lines, P, 2]; the agent of each line;
            and the number of lines in each frame, [T].
        """
        is_line_drawn = drawn[:, self.agent_of_line]
        frame, line = np.nonzero(is_line_drawn)
        agent = self.agent_of_line[line]
        lines = self.corners[heading[frame, agent], line] + centres[frame, agent][:, None]
        return lines, agent, is_line_drawn.sum(1)


@cache
def glyphs(agents: int, lines_of: Callable[[int], list[Float32]]) -> Glyphs:
    """Return the lines of all agents.

    Args:
        agents: the number of agents.
        lines_of: a function that returns the lines of one agent, float32 [4, P, 2] each.
    """
    lines = [(agent, line) for agent in range(agents) for line in lines_of(agent)]
    corners = np.zeros((4, len(lines), POINTS, 2), np.float32)
    for index, (_, line) in enumerate(lines):
        corners[:, index] = line[:, -1:]  # a shorter line repeats its last corner
        corners[:, index, : line.shape[1]] = line
    return Glyphs(np.array([agent for agent, _ in lines], np.intp), corners)


def number_and_heading(agent: int) -> list[Float32]:
    """Draw the triangle that shows an agent's heading, and behind it the agent's number, always upright."""
    kind = agent_mark(agent)
    tip = _TIP_CELLS
    if kind == "ring":
        tip -= _MARK_WIDTH_CELLS
    base = tip - _TRIANGLE_DEPTH_CELLS
    left = (-_TRIANGLE_HALF_WIDTH_CELLS, -base)
    right = (_TRIANGLE_HALF_WIDTH_CELLS, -base)
    inside = (0.0, -base - 0.4 * _TRIANGLE_DEPTH_CELLS)
    triangle = _rotated(left, (0, -tip), right, left, inside)
    front = base - 2 * _LINE_RADIUS_CELLS
    back = 0.48
    if kind in ("ring", "stripe"):
        back = 0.5 - _MARK_WIDTH_CELLS
    number_centre = _rotated((0, (back - front) / 2))
    scale = np.float32(_digit_scale(agent, room=back + front))
    return [triangle, *(number_centre + digit * scale for digit in number_paths(agent))]


def number(agent: int) -> list[Float32]:
    """Draw an agent's number in the middle of its cell."""
    scale = _digit_scale(agent, room=0.7)
    return [np.broadcast_to(digit * scale, (4, *digit.shape)) for digit in number_paths(agent)]


def _rotated(*corners: tuple[float, float]) -> Float32:
    """Rotate a line of an agent that faces up to each of the four headings: float32 [4, corners, 2]."""
    turned = _TURNS * (np.array(corners) @ (1, 1j))
    return np.stack([turned.real, turned.imag], -1).astype(np.float32)


def _digit_scale(agent: int, *, room: float) -> float:
    """Return the distance between two points of a digit at which an agent's number fits, in cells."""
    points = max(DIGIT_HIGH - 1, 4 * len(str(agent)) - 2)
    return min(_DIGIT_POINT_CELLS, (room - 2 * _LINE_RADIUS_CELLS) / points)


def mark(agent: int) -> list[Float32]:
    """Draw the mark that distinguishes an agent from others of the same hue."""
    edge = 0.5 - _LINE_RADIUS_CELLS
    corner = 0.25
    kind = agent_mark(agent)
    if kind == "ring":
        return [_rotated((-edge, -edge), (edge, -edge), (edge, edge), (-edge, edge), (-edge, -edge))]
    if kind == "stripe":
        return [_rotated((-edge, edge), (edge, edge))]
    if kind == "corners":
        return [
            _rotated((x * corner, y * edge), (x * edge, y * edge), (x * edge, y * corner))
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    return []


RIM_CELLS: Final = 1
"""The width of the wall shown around the board, in cells."""
_STOCK_BAR_RADIUS_CELLS: Final = 0.3
"""Half the height of the bar below the board that shows how many apples are left, in cells."""
_STOCK_LABEL_CELLS: Final = 0.5
"""The distance from the bar to the point below which its text hangs, in cells."""
_SHOT_RADIUS_CELLS: Final = 0.1
"""The radius of the dot in each cell that a shot passes, in cells."""


def image_format(size: tuple[int, int], datatype: rr.ChannelDatatype = rr.ChannelDatatype.U8) -> Any:
    """Return the format of an image of classes, by its rows and columns."""
    return rr.components.ImageFormat(width=size[1], height=size[0], channel_datatype=datatype)


def board_format(scene: Scene) -> Any:
    """Return the format of the image of a board with its rim."""
    return image_format((scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS))


def board_styles() -> dict[str, list[Any]]:
    """Return the static archetypes of a board's parts, by the names that `board_columns` uses.

    The format of its image, which depends on the board's size, is not among them, see `board_format`.
    """
    lines = rr.LineStrips2D.from_fields
    beams = rr.Points2D.from_fields(colors=[PALETTE[BEAM]], radii=[_SHOT_RADIUS_CELLS], draw_order=-5.0)
    stock_radii = [_STOCK_BAR_RADIUS_CELLS, _STOCK_BAR_RADIUS_CELLS, 0.0]
    return {
        "board": [rr.SegmentationImage.from_fields(opacity=1.0, draw_order=-10.0)],
        "beams": [beams],
        "agents": [lines(colors=[INK_COLOUR], radii=[_LINE_RADIUS_CELLS])],
        "marks": [lines(colors=[MARK_COLOUR], radii=[_LINE_RADIUS_CELLS])],
        "out": [rr.Boxes2D.from_fields(radii=[OUT_LINE_RADIUS_CELLS], show_labels=False)],
        "out/numbers": [lines(radii=[_LINE_RADIUS_CELLS])],
        "stock": [lines(colors=[PALETTE[WALL], PALETTE[APPLE], TEXT], radii=stock_radii, show_labels=True)],
    }


def frame_columns(scene: Scene, frames: Frames) -> Columns:
    """Return the contents of T frames by entity: the indices of the frames that have a row, and the columns.

    Beams, the stock, and the squares of agents out of play have a row for the first frame and for each frame
    in which they change; all else has a row for each frame.
    """
    all_frames = np.arange(len(frames["step"]))
    contents = {f"world/{name}": rows for name, rows in board_columns(scene, frames).items()}
    contents["windows"] = all_frames, _image_columns(mosaic(frames["windows"]))
    if scene.is_replay:
        stock = frames["stock"].sum(1, dtype=np.float64)
        contents["turn/stock"] = all_frames, rr.Scalars.columns(scalars=stock)
        if "rule" in frames:
            contents["turn/rule"] = all_frames, rr.Scalars.columns(scalars=frames["rule"])
        for agent, name in enumerate(scene.agents):
            harvested = frames["harvested"][:, agent].astype(np.float64)
            contents[f"{name}/harvested"] = all_frames, rr.Scalars.columns(scalars=harvested)
    return contents


def board_columns(scene: Scene, frames: Frames) -> Columns:
    """Return the frames and the columns of the board's parts, as `frame_columns` does, by the part's name."""
    count, agents = frames["in_play"].shape
    all_frames = np.arange(count)
    contents = {
        "board": (all_frames, _image_columns(boards(scene, frames))),
        "agents": (all_frames, _line_columns(glyphs(agents, number_and_heading), frames)),
    }
    marks = glyphs(agents, mark)
    if len(marks.agent_of_line):
        contents["marks"] = all_frames, _line_columns(marks, frames)
    changed = _changes(frames["beams"])
    frame, row, col = np.nonzero(frames["beams"][changed])
    dots = np.stack([col, row], -1).astype(np.float32) + RIM_CELLS + 0.5
    shots = np.bincount(frame, minlength=len(changed))
    contents["beams"] = changed, rr.Points2D.columns(positions=dots).partition(shots)
    return contents | {"stock": _stock_columns(scene, frames)} | _out_of_play_columns(frames)


def _stock_columns(scene: Scene, frames: Frames) -> tuple[NDArray[np.intp], Any]:
    """Return the frames and the columns of the bar below the board, whose length shows the apples left.

    It has three lines: the full width of the board; the share of it that the apples have; and a point with
    the text.
    """
    apples = (frames["stock"] > 0).sum(1)
    changed = _changes(apples)
    apples = apples[changed]
    sites = len(scene.sites)
    bar_y = scene.height + 2 * RIM_CELLS + 2 * _STOCK_BAR_RADIUS_CELLS
    bars = np.full((len(apples), 3, 2, 2), (RIM_CELLS, bar_y), np.float32)
    bars[:, 0, 1, 0] += scene.width
    bars[:, 1, 1, 0] += scene.width * apples / max(1, sites)
    bars[:, 2] += scene.width / 2, _STOCK_LABEL_CELLS
    labels = [text for count in apples for text in ("", "", f"{count} of {sites} apples")]
    strips = rr.LineStrips2D.columns(strips=bars.reshape(-1, 2, 2), labels=labels)
    return changed, strips.partition([3] * len(apples))


def _image_columns(images: UInt8) -> Any:
    return rr.SegmentationImage.columns(buffer=images.reshape(len(images), -1))


def boards(scene: Scene, frames: Frames) -> UInt8:
    """Return the class of each cell in T frames, with a rim of wall around the board.

    Returns:
        uint8 [T, H + 2, W + 2].
    """
    size = len(frames["in_play"]), scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS
    with_rim = np.full(size, WALL, np.uint8)
    cells = with_rim[:, RIM_CELLS:-RIM_CELLS, RIM_CELLS:-RIM_CELLS]
    cells[:] = GROUND
    if scene.walls:
        cells[:, *np.array(scene.walls).T] = WALL
    if scene.sites:
        cells[:, *np.array(scene.sites).T] = np.where(frames["stock"] > 0, APPLE, EMPTY_SITE)
    for agent in range(len(scene.agents)):
        frame = np.flatnonzero(frames["in_play"][:, agent])
        cells[frame, frames["row"][frame, agent], frames["col"][frame, agent]] = FIRST_AGENT + agent
    return with_rim


def _line_columns(lines: Glyphs, frames: Frames) -> Any:
    """Return the columns of lines that are drawn on the agents in play."""
    strips, _, counts = lines.place(centres_of(frames), frames["heading"], frames["in_play"])
    return rr.LineStrips2D.columns(strips=strips).partition(counts)


def _out_of_play_columns(frames: Frames) -> Columns:
    """Return the columns of a hollow square around each agent out of play, and of its number.

    A number is left out where an agent in play, or one of a lower index, has its number. A square's label
    names the agent that tagged this one; the viewer shows it when the mouse is on the square.
    """
    row = frames["row"]
    col = frames["col"]
    out = ~frames["in_play"]
    tagged_by = frames["tagged_by"]
    is_same_cell = (row[:, :, None] == row[:, None]) & (col[:, :, None] == col[:, None])
    is_drawn_first = np.tri(row.shape[1], k=-1, dtype=np.bool_) | ~out[:, None]
    has_number = out & ~(is_same_cell & is_drawn_first).any(2)
    changed = _changes(np.concatenate([out, out * tagged_by, has_number, out * row, out * col], 1))
    out = out[changed]
    centres = centres_of(frames)[changed]
    rgb = np.array([agent_colour(agent) for agent in range(out.shape[1])], np.uint8)
    squares = rr.Boxes2D.columns(
        centers=centres[out],
        half_sizes=np.full((int(out.sum()), 2), _OUT_HALF_CELLS),
        colors=rgb[np.nonzero(out)[1]],
        labels=["out" if tagger < 0 else f"by {tagger}" for tagger in tagged_by[changed][out]],
    ).partition(out.sum(1))
    numbers = glyphs(out.shape[1], number)
    lines, agent, counts = numbers.place(centres, frames["heading"][changed], has_number[changed])
    digits = rr.LineStrips2D.columns(strips=lines, colors=rgb[agent]).partition(counts)
    return {"out": (changed, squares), "out/numbers": (changed, digits)}


def centres_of(frames: Frames) -> Float32:
    """Return the middle of each agent's cell on the image, (x, y): float32 [T, N, 2]; of one frame [N, 2]."""
    return np.stack([frames["col"], frames["row"]], -1).astype(np.float32) + RIM_CELLS + 0.5


def _changes(rows: NDArray[Any]) -> NDArray[np.intp]:
    """Return the index of the first row, and of each row that differs from the row before it."""
    flat = rows.reshape(len(rows), -1)
    return np.flatnonzero(np.concatenate([[True], (flat[1:] != flat[:-1]).any(1)]))


def mosaic(windows: UInt8) -> UInt8:
    """Join the windows of all agents in one image, with UNSEEN between them.

    Args:
        windows: uint8 [T, N, X, Y], classes of `classes_seen`.

    Returns:
        uint8 [T, rows, columns], as `windows_of` places them.
    """
    _, agents, rows, columns = windows.shape
    joined = windows_of(agents, (rows, columns)).join(np.moveaxis(windows, 0, -1), UNSEEN)
    return np.ascontiguousarray(np.moveaxis(joined, -1, 0))
