"""Draw the board for people: apples, walls, and agents in their hues with number, heading and mark.

The digits of the numbers are paths on a grid of three by five points. So an image can fill them as pixels and
the viewer can draw them as lines, both without a font.
"""

from base64 import b64encode
from collections.abc import Sequence
from functools import cache
from io import BytesIO
from itertools import pairwise
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cprl.commons.cells import APPLE, BEAM, CLEANING, GROUND, WALL, WASTE, WATER, Colour
from cprl.commons.maps import Cell, Map
from cprl.commons.world import WorldView
from cprl.institutions import Boundaries
from cprl.pictures.colours import GREY, PALETTE, agent_colour, agent_mark
from cprl.values import Range, checked
from cprl.values.array_types import Bool, Float32, UInt8

LARGEST_CELL_PIXELS: Final = 1000
GRID_COLOUR: Final = (28, 30, 36)
EMPTY_SITE_COLOUR: Final = (40, 43, 51)
"""The colour of a site without an apple; dim, so that one still sees where apples could grow."""


def world_image(board: Map, world: WorldView, *, cell_pixels: int = 24) -> UInt8:
    """Return an image of one world in RGB, uint8 [rows, columns, 3], without the agents out of play.

    Args:
        board: the map of the world.
        world: the state of the world, see `Batch.show`.
        cell_pixels: the width and height of a cell in pixels, 8..1000, of which one is a line between cells.
    """
    size = checked("cell_pixels", cell_pixels, Annotated[int, Range(8, LARGEST_CELL_PIXELS)])
    shape = (board.height * size + 1, board.width * size + 1, 3)
    image = np.empty(shape, np.uint8)
    image[:] = PALETTE[GROUND]
    image[::size] = GRID_COLOUR
    image[:, ::size] = GRID_COLOUR
    for cell in board.walls:
        _inside(image, cell, size)[:] = PALETTE[WALL]
    for cell in board.river:
        _inside(image, cell, size)[:] = PALETTE[WASTE if world.board[cell] == WASTE else WATER]
    for cell, apple in zip(board.sites, world.stock, strict=True):
        _inside(image, cell, size, inset=size // 6)[:] = PALETTE[APPLE] if apple else EMPTY_SITE_COLOUR
    for kind in (BEAM, CLEANING):
        for row, col in np.argwhere(world.board == kind):
            _inside(image, (row, col), size, inset=2 * size // 5)[:] = PALETTE[kind]
    for agent in np.flatnonzero(world.in_play).tolist():
        inside = _inside(image, (world.row[agent], world.col[agent]), size)
        sprite = agent_sprite(agent, int(world.heading[agent]), size - 1)
        inside[sprite == BODY] = agent_colour(agent)
        inside[sprite == INK] = INK_COLOUR
        inside[sprite == MARKED] = MARK_COLOUR
    return image


_START_CELL_PIXELS: Final = 20
"""The width and height of a cell in a picture of a map."""


def board_html(board: Map) -> str:
    """Return a picture of a board as an episode begins on it, with an apple on every site, as HTML."""
    cells = np.zeros((board.height, board.width), np.uint8)
    for index in board.waste:
        cells[board.river[index]] = WASTE
    row, col, heading = np.array(board.starts, np.int32).reshape(-1, 3).T
    start = WorldView(
        observation=np.empty(0, np.uint8),
        board=cells,
        stock=np.ones(len(board.sites), np.uint8),
        row=row,
        col=col,
        heading=heading,
        in_play=np.ones(len(row), np.bool_),
        harvested=np.zeros(len(row), np.int32),
    )
    png = BytesIO()
    Image.fromarray(world_image(board, start, cell_pixels=_START_CELL_PIXELS)).save(png, "PNG")
    source = f"data:image/png;base64,{b64encode(png.getvalue()).decode('ascii')}"
    return f'<img src="{source}" alt="{board!r}" style="max-width:100%">'


def _inside(image: UInt8, cell: Cell, size: int, *, inset: int = 0) -> UInt8:
    """Return a view of the pixels of a cell between its lines, less `inset` pixels on each side."""
    row, col = cell
    rows = slice(row * size + 1 + inset, (row + 1) * size - inset)
    columns = slice(col * size + 1 + inset, (col + 1) * size - inset)
    return image[rows, columns]


NOTHING, BODY, INK, MARKED = range(4)
"""The values of a sprite's pixels: around the agent, in its hue, of number and triangle, of the mark."""

INK_COLOUR: Final[Colour] = (16, 18, 22)
MARK_COLOUR: Final[Colour] = (255, 255, 255)

DIGIT_HIGH: Final = 5
"""The height of a digit in points."""
_DIGIT_STRIDE: Final = 4
"""The points from the first column of a digit to that of the next one: a digit's three columns and a gap."""
_DIGIT_PATHS: Final = (
    "13971",
    "12879",
    "136479",
    "1365697",
    "14639",
    "314697",
    "317964",
    "139",
    "4139746",
    "641397",
)
"""The path of each digit, 0 first, as the keys of a telephone that it passes: 1 2 3 in the top row, 7 8 9 in
the bottom row. Columns of keys are one point apart, rows two points. Each step is upright or level."""
POINTS: Final = max(map(len, _DIGIT_PATHS))
"""The number of corners of the longest path."""


def number_paths(number: int) -> list[Float32]:
    """Return the paths of the digits of a number, so that the number is centred at (0, 0).

    Each path is float32 [corners, 2]: column and row of each corner, in points of the grid.
    """
    width = _DIGIT_STRIDE * len(str(number)) - 1
    middle = np.array([(width - 1) / 2, (DIGIT_HIGH - 1) / 2], np.float32)
    return [path.astype(np.float32) - middle for path in _paths(number)]


def number_pixels(number: int) -> Bool:
    """Return the pixels that draw a number: bool [5, 4 * digits - 1]."""
    pixels = np.zeros((DIGIT_HIGH, _DIGIT_STRIDE * len(str(number)) - 1), np.bool_)
    for path in _paths(number):
        for line in pairwise(path):
            (left, top), (right, bottom) = np.sort(line, axis=0)
            pixels[top : bottom + 1, left : right + 1] = True
    return pixels


def _paths(number: int) -> list[NDArray[np.intp]]:
    """Return the paths of the digits of a number, [corners, 2] each: column and row, both from 0 on."""
    paths = []
    for position, digit in enumerate(str(number)):
        keys = np.array([int(key) - 1 for key in _DIGIT_PATHS[int(digit)]])
        columns = keys % 3 + position * _DIGIT_STRIDE
        rows = keys // 3 * 2
        paths.append(np.stack([columns, rows], axis=1))
    return paths


@cache
def agent_sprite(agent: int, heading: int, size: int) -> UInt8:
    """Return the picture of an agent in a cell: uint8 [size, size], `NOTHING`, `BODY`, `INK` or `MARKED`.

    A number that is too large for the cell is left out; numbers below 100 fit from eleven pixels on.
    """
    mark = agent_mark(agent)
    edge = 1 if size > 14 else 0
    body_size = size - 2 * edge
    mark_width = max(1, body_size // 10)
    ring_width = mark_width if mark == "ring" else 0
    triangle_top = ring_width + edge
    triangle_height = max(1, body_size // 5)
    body = np.full((body_size, body_size), BODY, np.uint8)
    _draw_mark(body, mark, mark_width)
    for row in range(triangle_height):
        body[triangle_top + row, body_size // 2 - row : (body_size + 1) // 2 + row] = INK
    body = np.rot90(body, -heading).copy()
    front = triangle_top + triangle_height
    back = mark_width if mark in ("ring", "stripe") else edge
    _draw_number(body, agent, heading, front=front, back=back, side=ring_width)
    sprite = np.pad(body, edge, constant_values=NOTHING)
    sprite.flags.writeable = False  # the cache gives the same array to all callers
    return sprite


def _draw_mark(body: UInt8, mark: str, width: int) -> None:
    """Draw the mark of an agent that heads up."""
    if mark == "ring":
        body[:] = MARKED
        body[width:-width, width:-width] = BODY
    elif mark == "stripe":
        body[-width:] = MARKED
    elif mark == "corners":
        for rows in (slice(2 * width), slice(-2 * width, None)):
            body[rows, : 2 * width] = MARKED
            body[rows, -2 * width :] = MARKED


_BACKWARD_STEPS: Final = ((1, 0), (0, -1), (-1, 0), (0, 1))
"""The step (row, column) to the back of an agent, by heading."""


def _draw_number(body: UInt8, agent: int, heading: int, *, front: int, back: int, side: int) -> None:
    """Draw the number behind the triangle, as large as possible and upright for every heading.

    `front`, `back`, `side`: the pixels that are taken at the front, at the back and at each side.
    """
    pixels = number_pixels(agent)
    body_size = len(body)
    free_length = body_size - front - back
    free_width = body_size - 2 * side
    is_upright_digit = len(pixels) == max(pixels.shape)
    scale = min(free_length - is_upright_digit, free_width) // max(pixels.shape)
    if scale < 1:
        return
    pixels = pixels.repeat(scale, 0).repeat(scale, 1)
    height, width = pixels.shape
    shift = (front + 1 - back) // 2
    down, right = _BACKWARD_STEPS[heading]
    top = min(max((body_size - height) // 2 + shift * down, 0), body_size - height)
    left = min(max((body_size - width) // 2 + shift * right, 0), body_size - width)
    body[top : top + height, left : left + width][pixels] = INK


OwnedRegions: TypeAlias = list[tuple[list[int], Bool]]
"""The owners of each region, and its cells, bool [H, W]."""


def region_colour(owners: Sequence[int]) -> Colour:
    """Return the colour of a region: that of its owner, or grey for several owners."""
    return agent_colour(owners[0]) if len(owners) == 1 else GREY


def regions_of(game: Any) -> OwnedRegions:
    """Return the regions of all `Boundaries` of a game that have owners."""
    regions: OwnedRegions = []
    for institution in game.institutions:
        if isinstance(institution, Boundaries):
            signs = np.array([list(line) for line in institution.regions])
            agent_signs = [institution.signs_of(agent) for agent in range(game.agents)]
            for sign in sorted(set("".join(agent_signs))):
                owners = [agent for agent, signs_of_agent in enumerate(agent_signs) if sign in signs_of_agent]
                regions.append((owners, signs == sign))
    return regions
