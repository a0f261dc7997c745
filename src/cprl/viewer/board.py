"""How the board of one world looks in Rerun, frame by frame."""

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
from cprl.values.arrays import Bool, Float32, UInt8
from cprl.viewer.names import EMPTY_SITE, TEXT
from cprl.viewer.scene import Scene, windows_of

Frames = Mapping[str, NDArray[Any]]
"""Columns of `FrameRecorder.take`, [T, ...] each, with windows as classes of `classes_seen`."""

RADIUS_CELLS: Final = 0.045
"""Half the width of a line, in cells."""

OUT_HALF_CELLS: Final = 0.4
OUT_STROKE_CELLS: Final = 0.07
"""Half the side of the square of an agent out of play, and half the width of its line, in cells."""

_EDGE, _RIM, _DEEP, _HALF_WIDE, _GRID = 0.44, 0.09, 0.15, 0.16, 0.09
"""In cells: the distance of the triangle's tip from the middle; the width of a ring or stripe; the triangle's
depth and half its width; the largest distance between points of a digit."""
_TURNS: Final = np.array([[(1, 0), (0, 1)], [(0, 1), (-1, 0)], [(-1, 0), (0, -1)], [(0, -1), (1, 0)]])
"""What a heading makes of right and down, as seen by somebody headed up."""


class Strokes(NamedTuple):
    """Lines of some agents, for each heading."""

    owner: NDArray[np.intp]
    """The agent of each line [S]."""
    shape: Float32
    """float32 [4, S, P, 2], the corners (x, y) of each line, in cells from the middle of the agent's cell."""

    def placed(
        self, centres: Float32, heading: NDArray[np.integer], drawn: Bool
    ) -> tuple[Float32, NDArray[np.intp], NDArray[np.intp]]:
        """Return the lines of all frames.

        Args:
            centres: float32 [T, N, 2], the middle of each agent's cell, (x, y).
            heading: int [T, N].
            drawn: bool [T, N], the agents whose lines are drawn.

        Returns:
            The lines one after the other, float32 [lines, P, 2], the agent of each, and how many each frame
            has, [T].
        """
        drawn = drawn[:, self.owner]
        frame, line = np.nonzero(drawn)
        agent = self.owner[line]
        lines = self.shape[heading[frame, agent], line] + centres[frame, agent][:, None]
        return lines, agent, drawn.sum(1)


@cache
def strokes(agents: int, lines_of: Callable[[int], list[Float32]]) -> Strokes:
    """Return the lines of so many agents, by a function that draws one: [4, P, 2] each."""
    lines = [(agent, line) for agent in range(agents) for line in lines_of(agent)]
    shape = np.zeros((4, len(lines), POINTS, 2), np.float32)
    for index, (_, line) in enumerate(lines):
        shape[:, index] = line[:, -1:]
        shape[:, index, : line.shape[1]] = line
    return Strokes(np.array([agent for agent, _ in lines], np.intp), shape)


def number_and_heading(agent: int) -> list[Float32]:
    """Return the triangle, and behind it the digits: a number is upright whatever the heading."""
    front = _front(agent) - _DEEP - 2 * RADIUS_CELLS
    back = 0.5 - (_RIM if agent_mark(agent) in ("ring", "stripe") else 0.02)
    behind = _turned((0, (back - front) / 2))
    scale = np.float32(_scale(agent, room=back + front))
    return [_triangle(agent), *(behind + digit * scale for digit in number_paths(agent))]


def number(agent: int) -> list[Float32]:
    """Return the digits in the middle."""
    scale = _scale(agent, room=0.7)
    return [np.broadcast_to(digit * scale, (4, *digit.shape)) for digit in number_paths(agent)]


def _turned(*corners: tuple[float, float]) -> Float32:
    """Return a line of an agent that is headed up, for each heading: [4, corners, 2]."""
    turned: Float32 = np.einsum("pk,hkd->hpd", np.array(corners), _TURNS).astype(np.float32)
    return turned


def _front(agent: int) -> float:
    """Return how far the tip of the triangle is from the middle, in cells."""
    return _EDGE - (_RIM if agent_mark(agent) == "ring" else 0)


def _triangle(agent: int) -> Float32:
    tip = _front(agent)
    base = tip - _DEEP
    inside = (0.0, -base - 0.4 * _DEEP)
    return _turned((-_HALF_WIDE, -base), (0, -tip), (_HALF_WIDE, -base), (-_HALF_WIDE, -base), inside)


def _scale(agent: int, *, room: float) -> float:
    """Return the distance between points of a digit with which a number fits, in cells."""
    points = max(DIGIT_HIGH - 1, 4 * len(str(agent)) - 2)
    return min(_GRID, (room - 2 * RADIUS_CELLS) / points)


def mark(agent: int) -> list[Float32]:
    """Return what tells agents of the same hue apart."""
    edge = 0.5 - RADIUS_CELLS
    corner = 0.25
    kind = agent_mark(agent)
    if kind == "ring":
        return [_turned((-edge, -edge), (edge, -edge), (edge, edge), (-edge, edge), (-edge, -edge))]
    if kind == "stripe":
        return [_turned((-edge, edge), (edge, edge))]
    if kind == "corners":
        return [
            _turned((x * corner, y * edge), (x * edge, y * edge), (x * edge, y * corner))
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    return []


RIM_CELLS: Final = 1
"""The width of the wall shown around the board, in cells."""
BAR_CELLS: Final = 0.3
"""Half the height of the bar of apples below the board."""
LABEL_BELOW_CELLS: Final = 0.5
"""The distance from the bar to the point below which its text hangs."""
SHOT_CELLS: Final = 0.1
"""The radius of the dot in each cell that a shot passes, in cells."""


def image_form(size: tuple[int, int]) -> Any:
    """Return the format of an image of classes with so many rows and columns."""
    return rr.components.ImageFormat(width=size[1], height=size[0], channel_datatype=rr.ChannelDatatype.U8)


def board_form(scene: Scene) -> Any:
    return image_form((scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS))


def board_styles() -> dict[str, list[Any]]:
    """Return how the parts of a board look, by the names of `board_columns`; the form of the image is left
    out."""
    image = rr.SegmentationImage.from_fields
    lines = rr.LineStrips2D.from_fields
    return {
        "board": [image(opacity=1.0, draw_order=-10.0)],
        "beams": [
            rr.Points2D.from_fields(colors=[PALETTE[BEAM]], radii=[SHOT_CELLS], draw_order=-5.0),
        ],
        "agents": [lines(colors=[INK_COLOUR], radii=[RADIUS_CELLS])],
        "marks": [lines(colors=[MARK_COLOUR], radii=[RADIUS_CELLS])],
        "out": [rr.Boxes2D.from_fields(radii=[OUT_STROKE_CELLS], show_labels=False)],
        "out/numbers": [lines(radii=[RADIUS_CELLS])],
        "stock": [
            lines(
                colors=[PALETTE[WALL], PALETTE[APPLE], TEXT], radii=[BAR_CELLS] * 2 + [0.0], show_labels=True
            )
        ],
    }


def columns(scene: Scene, frames: Frames) -> dict[str, tuple[NDArray[np.intp], Any]]:
    """Return the contents of T frames, by entity: the frames that have a row there, and the columns of these
    rows.

    Beams and the marks of agents out of play have rows only for the first frame and where they change.
    """
    everywhere = np.arange(len(frames["step"]))
    contents = {f"world/{name}": rows for name, rows in board_columns(scene, frames).items()}
    contents["windows"] = everywhere, _pictures(mosaic(frames["windows"]))
    if scene.is_replay:
        stock = frames["stock"].sum(1, dtype=np.float64)
        contents["turn/stock"] = everywhere, rr.Scalars.columns(scalars=stock)
        for agent, name in enumerate(scene.agents):
            harvested = frames["harvested"][:, agent].astype(np.float64)
            contents[f"{name}/harvested"] = everywhere, rr.Scalars.columns(scalars=harvested)
    return contents


def board_columns(scene: Scene, frames: Frames) -> dict[str, tuple[NDArray[np.intp], Any]]:
    """`columns` of the parts of the board alone, by name."""
    count, agents = frames["in_play"].shape
    everywhere = np.arange(count)
    contents = {
        "board": (everywhere, _pictures(boards(scene, frames))),
        "agents": (everywhere, _lines(strokes(agents, number_and_heading), frames)),
    }
    marks = strokes(agents, mark)
    if len(marks.owner):
        contents["marks"] = everywhere, _lines(marks, frames)
    changed = _changes(frames["beams"])
    frame, row, col = np.nonzero(frames["beams"][changed])
    dots = np.stack([col, row], -1).astype(np.float32) + RIM_CELLS + 0.5
    shots = np.bincount(frame, minlength=len(changed))
    contents["beams"] = changed, rr.Points2D.columns(positions=dots).partition(shots)
    return contents | {"stock": _stock(scene, frames)} | _out(frames)


def _stock(scene: Scene, frames: Frames) -> tuple[NDArray[np.intp], Any]:
    """Return a bar below the board, as wide as it with all apples, filled as far as they are there."""
    apples = (frames["stock"] > 0).sum(1)
    changed = _changes(apples)
    apples = apples[changed]
    sites = max(1, len(scene.sites))
    left = RIM_CELLS
    low = scene.height + 2 * RIM_CELLS + 2 * BAR_CELLS
    bars = np.full((len(apples), 3, 2, 2), (left, low), np.float32)  # the last, a point, has the text
    bars[:, 0, 1, 0] += scene.width
    bars[:, 1, 1, 0] += scene.width * apples / sites
    bars[:, 2] += scene.width / 2, LABEL_BELOW_CELLS
    words = [text for count in apples for text in ("", "", f"{count} of {len(scene.sites)} apples")]
    columns = rr.LineStrips2D.columns(strips=bars.reshape(-1, 2, 2), labels=words)
    return changed, columns.partition([3] * len(apples))


def _pictures(images: UInt8) -> Any:
    return rr.SegmentationImage.columns(buffer=images.reshape(len(images), -1))


def boards(scene: Scene, frames: Frames) -> UInt8:
    """Boards with a border of wall: apples, sites without one and agents in play, in a class of their own.

    Returns:
        uint8 [T, H + 2, W + 2].
    """
    size = len(frames["in_play"]), scene.height + 2 * RIM_CELLS, scene.width + 2 * RIM_CELLS
    whole = np.full(size, WALL, np.uint8)
    drawn = whole[:, RIM_CELLS:-RIM_CELLS, RIM_CELLS:-RIM_CELLS]
    drawn[:] = GROUND
    if scene.walls:
        drawn[:, *np.array(scene.walls).T] = WALL
    if scene.sites:
        drawn[:, *np.array(scene.sites).T] = np.where(frames["stock"] > 0, APPLE, EMPTY_SITE)
    for agent in range(len(scene.agents)):
        at = np.flatnonzero(frames["in_play"][:, agent])
        drawn[at, frames["row"][at, agent], frames["col"][at, agent]] = FIRST_AGENT + agent
    return whole


def _lines(of_agents: Strokes, frames: Frames) -> Any:
    lines, _, counts = of_agents.placed(centres_of(frames), frames["heading"], frames["in_play"])
    return rr.LineStrips2D.columns(strips=lines).partition(counts)


def _out(frames: Frames) -> dict[str, tuple[NDArray[np.intp], Any]]:
    """Return a hollow square in the colour of each agent out of play, with its number where nobody else's
    stands.

    The squares have labels that name who tagged the agent; the viewer shows them on request.
    """
    row = frames["row"]
    col = frames["col"]
    out = ~frames["in_play"]
    by = frames["tagged_by"]
    same = (row[:, :, None] == row[:, None]) & (col[:, :, None] == col[:, None])
    first = np.tri(row.shape[1], k=-1, dtype=np.bool_) | ~out[:, None]
    alone = out & ~(same & first).any(2)  # nobody in play is in the cell, nor anyone out with a lower index
    places = [np.where(out, row, 0), np.where(out, col, 0)]
    changed = _changes(np.concatenate([out, np.where(out, by, 0), alone, *places], 1))
    out = out[changed]
    by = by[changed]
    alone = alone[changed]
    centres = centres_of(frames)[changed]
    rgb = np.array([agent_colour(agent) for agent in range(out.shape[1])], np.uint8)
    squares = rr.Boxes2D.columns(
        centers=centres[out],
        half_sizes=np.full((int(out.sum()), 2), OUT_HALF_CELLS),
        colors=rgb[np.nonzero(out)[1]],
        labels=["out" if tagger < 0 else f"by {tagger}" for tagger in by[out]],
    ).partition(out.sum(1))
    numbers = strokes(out.shape[1], number)
    lines, agent, counts = numbers.placed(centres, frames["heading"][changed], alone)
    digits = rr.LineStrips2D.columns(strips=lines, colors=rgb[agent]).partition(counts)
    return {"out": (changed, squares), "out/numbers": (changed, digits)}


def centres_of(frames: Frames) -> Float32:
    """Return the positions of agents on the image, (x, y): [(T), N, 2]."""
    return np.stack([frames["col"], frames["row"]], -1).astype(np.float32) + RIM_CELLS + 0.5


def _changes(rows: NDArray[Any]) -> NDArray[np.intp]:
    """Return the indices of the first row, and of all rows that differ from the previous one."""
    flat = rows.reshape(len(rows), -1)
    return np.flatnonzero(np.concatenate([[True], (flat[1:] != flat[:-1]).any(1)]))


def mosaic(windows: UInt8) -> UInt8:
    """Return the windows of all agents in one image, with UNSEEN between them.

    Args:
        windows: uint8 [T, N, X, Y], classes of `classes_seen`.

    Returns:
        uint8 [T, rows, columns], as `windows_of` places them.
    """
    _, agents, rows, columns = windows.shape
    joined = windows_of(agents, (rows, columns)).joined(np.moveaxis(windows, 0, -1), UNSEEN)
    return np.ascontiguousarray(np.moveaxis(joined, -1, 0))
