"""An image of the board for people: apples, walls, and agents in their hues with number, heading and mark.

Digits are paths on a grid of three by five points, so that a picture can fill them as pixels and the viewer
can draw them as lines, neither with a font.
"""

from functools import cache
from itertools import pairwise
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.cells import APPLE, BEAM, CLEANING, GROUND, WALL, WASTE, WATER, Colour
from cprl.commons.maps import Cell, Map
from cprl.commons.world import Shown
from cprl.pictures.colours import PALETTE, agent_colour, agent_mark
from cprl.values import Range, checked
from cprl.values.arrays import Bool, Float32, UInt8

LARGEST_CELL_PIXELS: Final = 1000
GRID_COLOUR: Final = (28, 30, 36)
EMPTY_SITE_COLOUR: Final = (40, 43, 51)
"""The colour of a site without an apple: dim, so that a field picked bare still looks like a field."""


def world_image(board: Map, world: Shown, *, cell_pixels: int = 24) -> UInt8:
    """Return an image of one world without the agents out of play, uint8 [rows, columns, 3] in RGB.

    A cell is `cell_pixels` high and wide, 8..1000, a line between two cells one of these.
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


def _inside(image: UInt8, cell: Cell, size: int, *, inset: int = 0) -> UInt8:
    """Return the pixels of a cell between its lines, without so many on each side."""
    row, col = cell
    rows = slice(row * size + 1 + inset, (row + 1) * size - inset)
    columns = slice(col * size + 1 + inset, (col + 1) * size - inset)
    return image[rows, columns]


NOTHING, BODY, INK, MARKED = range(4)
"""The parts of a sprite: around the agent, its hue, the number and triangle, the second mark."""

INK_COLOUR: Final[Colour] = (16, 18, 22)
MARK_COLOUR: Final[Colour] = (255, 255, 255)

DIGIT_HIGH: Final = 5
_DIGIT_APART: Final = 4
"""The points from a digit's first column to that of the next one: three of its own and a gap."""
_PATHS: Final = (
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
"""The path of each digit over the keys 1 to 9 of a telephone, upright or level from key to key; columns
are one point apart, rows two."""
POINTS: Final = max(map(len, _PATHS))
"""The corners of the longest path."""


def number_paths(number: int) -> list[Float32]:
    """Return the path of each digit of a number around (0, 0): float32 [corners, 2], column and row of each
    corner, in points of the grid."""
    pixels_wide = _DIGIT_APART * len(str(number)) - 1
    middle = np.array([(pixels_wide - 1) / 2, (DIGIT_HIGH - 1) / 2], np.float32)
    return [path.astype(np.float32) - middle for path in _paths(number)]


def number_pixels(number: int) -> Bool:
    """Return a number as pixels: bool [5, 4 * digits - 1]."""
    pixels = np.zeros((DIGIT_HIGH, _DIGIT_APART * len(str(number)) - 1), np.bool_)
    for path in _paths(number):
        for line in pairwise(path):
            (left, top), (right, bottom) = np.sort(line, axis=0)
            pixels[top : bottom + 1, left : right + 1] = True
    return pixels


def _paths(number: int) -> list[NDArray[np.intp]]:
    """Return the path of each digit of a number, [corners, 2], column and row, the first from column 0 on."""
    paths = []
    for place, digit in enumerate(str(number)):
        keys = np.array([int(key) - 1 for key in _PATHS[int(digit)]])
        columns = keys % 3 + place * _DIGIT_APART
        rows = keys // 3 * 2
        paths.append(np.stack([columns, rows], axis=1))
    return paths


@cache
def agent_sprite(agent: int, heading: int, size: int) -> UInt8:
    """Return an agent in a cell: uint8 [size, size], `NOTHING`, `BODY`, `INK` or `MARKED`.

    A number too large for the cell is left out; from eleven pixels on, numbers below 100 fit.
    """
    mark = agent_mark(agent)
    edge = 1 if size > 14 else 0
    body = size - 2 * edge
    mark_wide = max(1, body // 10)
    rim = mark_wide if mark == "ring" else 0
    tip = rim + edge
    deep = max(1, body // 5)
    sprite = np.full((body, body), BODY, np.uint8)
    _draw_mark(sprite, mark, mark_wide)
    for row in range(deep):
        sprite[tip + row, body // 2 - row : (body + 1) // 2 + row] = INK
    sprite = np.rot90(sprite, -heading).copy()
    back = mark_wide if mark in ("ring", "stripe") else edge
    _draw_number(sprite, agent, heading, front=tip + deep, back=back, side=rim)
    whole = np.pad(sprite, edge, constant_values=NOTHING)
    whole.flags.writeable = False
    return whole


def _draw_mark(sprite: UInt8, mark: str, wide: int) -> None:
    """Draw the mark of an agent that is headed up."""
    if mark == "ring":
        sprite[:] = MARKED
        sprite[wide:-wide, wide:-wide] = BODY
    elif mark == "stripe":
        sprite[-wide:] = MARKED
    elif mark == "corners":
        for rows in (slice(2 * wide), slice(-2 * wide, None)):
            sprite[rows, : 2 * wide] = MARKED
            sprite[rows, -2 * wide :] = MARKED


def _draw_number(sprite: UInt8, agent: int, heading: int, *, front: int, back: int, side: int) -> None:
    """Draw the number as large as it fits behind the triangle, whatever the heading."""
    pixels = number_pixels(agent)
    body = len(sprite)
    deep = body - front - back
    broad = body - 2 * side
    scale = min(deep - (len(pixels) == max(pixels.shape)), broad) // max(pixels.shape)
    if scale < 1:
        return
    pixels = pixels.repeat(scale, 0).repeat(scale, 1)
    high, wide = pixels.shape
    behind = (front + 1 - back) // 2
    down, right = ((1, 0), (0, -1), (-1, 0), (0, 1))[heading]
    top = min(max((body - high) // 2 + behind * down, 0), body - high)
    left = min(max((body - wide) // 2 + behind * right, 0), body - wide)
    sprite[top : top + high, left : left + wide][pixels] = INK
