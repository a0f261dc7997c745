"""An image of the board for people: apples, walls, and agents in their hues with number, heading and mark.

Digits are paths on a grid of three by five points, so that a picture can fill them as pixels and the viewer
can draw them as lines, neither with a font.
"""

from functools import cache
from itertools import pairwise
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.colours import (
    APPLE,
    BEAM,
    CLEANING,
    GROUND,
    PALETTE,
    WALL,
    WASTE,
    WATER,
    Colour,
    agent_colour,
    agent_mark,
)
from cprl.commons.maps import Map
from cprl.commons.world import Bytes, Shown
from cprl.system.memory import check_memory
from cprl.values import Range, checked

LARGEST_CELL_PIXELS: Final = 1000
GRID_COLOUR: Final = (28, 30, 36)
EMPTY_SITE_COLOUR: Final = (40, 43, 51)
"""Of a site without an apple: dim, so that a field that is harvested bare still looks like a field."""


def world_image(board: Map, world: Shown, *, cell_pixels: int = 24) -> Bytes:
    """Return an image of one world without the agents out of play, uint8 [rows, columns, 3] in RGB.

    A cell is `cell_pixels` high and wide, 8..1000, a line between two cells one of these.
    """
    size = checked("cell_pixels", cell_pixels, Annotated[int, Range(8, LARGEST_CELL_PIXELS)])
    pixels = (board.height * size + 1) * (board.width * size + 1)
    check_memory(f"cell_pixels is {size}: the pixels", 3 * pixels, "fewer pixels")
    image = np.empty((board.height * size + 1, board.width * size + 1, 3), np.uint8)
    image[:] = GRID_COLOUR
    for r in range(board.height):
        for c in range(board.width):
            _fill(image, r, c, size, 0, PALETTE[GROUND])
    for r, c in board.walls:
        _fill(image, r, c, size, 0, PALETTE[WALL])
    for r, c in board.river:
        kind = int(world.board[r, c])
        _fill(image, r, c, size, 0, PALETTE[kind if kind in (WATER, WASTE) else WATER])
    for (r, c), apple in zip(board.sites, world.stock, strict=True):
        _fill(image, r, c, size, size // 6, PALETTE[APPLE] if apple else EMPTY_SITE_COLOUR)
    for kind in (BEAM, CLEANING):
        for r, c in np.argwhere(world.board == kind):
            _fill(image, r, c, size, 2 * size // 5, PALETTE[kind])
    for agent in np.flatnonzero(world.in_play).tolist():
        r, c = int(world.row[agent]), int(world.col[agent])
        sprite = agent_sprite(agent, int(world.heading[agent]), size - 1)
        cell = image[r * size + 1 : (r + 1) * size, c * size + 1 : (c + 1) * size]
        for part, colour in ((BODY, agent_colour(agent)), (INK, INK_COLOUR), (MARKED, MARK_COLOUR)):
            cell[sprite == part] = colour
    return image


def _fill(image: Bytes, r: int, c: int, size: int, inset: int, colour: tuple[int, int, int]) -> None:
    top, left = r * size + 1 + inset, c * size + 1 + inset
    image[top : (r + 1) * size - inset, left : (c + 1) * size - inset] = colour


NOTHING, BODY, INK, MARKED = range(4)
"""The parts of a sprite: around the agent, its hue, the number and triangle, the second mark."""

INK_COLOUR: Final[Colour] = (16, 18, 22)
MARK_COLOUR: Final[Colour] = (255, 255, 255)

DIGIT_HIGH, DIGIT_WIDE = 5, 3
_DIGIT_APART: Final = DIGIT_WIDE + 1
_PATHS: Final = (
    ((0, 0), (2, 0), (2, 4), (0, 4), (0, 0)),
    ((0, 0), (1, 0), (1, 4), (0, 4), (2, 4)),
    ((0, 0), (2, 0), (2, 2), (0, 2), (0, 4), (2, 4)),
    ((0, 0), (2, 0), (2, 2), (1, 2), (2, 2), (2, 4), (0, 4)),
    ((0, 0), (0, 2), (2, 2), (2, 0), (2, 4)),
    ((2, 0), (0, 0), (0, 2), (2, 2), (2, 4), (0, 4)),
    ((2, 0), (0, 0), (0, 4), (2, 4), (2, 2), (0, 2)),
    ((0, 0), (2, 0), (2, 4)),
    ((0, 2), (0, 0), (2, 0), (2, 4), (0, 4), (0, 2), (2, 2)),
    ((2, 2), (0, 2), (0, 0), (2, 0), (2, 4), (0, 4)),
)
"""The path of each digit: its corners (column, row), joined by upright and level lines."""
POINTS: Final = max(map(len, _PATHS))
"""The corners of the longest path; shorter paths repeat their last corner."""


def number_paths(number: int) -> NDArray[np.float32]:
    """Return the paths of a number's digits around (0, 0), in points of the grid: column and row of each
    corner, float32 [digits, POINTS, 2]."""
    digits = str(number)
    paths = np.empty((len(digits), POINTS, 2), np.float32)
    for place, digit in enumerate(digits):
        path = np.array(_PATHS[int(digit)])
        paths[place, : len(path)], paths[place, len(path) :] = path, path[-1]
        paths[place, :, 0] += place * _DIGIT_APART
    wide = _DIGIT_APART * len(digits) - 1
    return paths - np.array([(wide - 1) / 2, (DIGIT_HIGH - 1) / 2], np.float32)


def number_pixels(number: int) -> NDArray[np.bool_]:
    """A number as pixels: bool [5, 4 * digits - 1]."""
    digits = str(number)
    pixels = np.zeros((DIGIT_HIGH, _DIGIT_APART * len(digits) - 1), np.bool_)
    for place, digit in enumerate(digits):
        path, left = _PATHS[int(digit)], place * _DIGIT_APART
        for (col, row), (next_col, next_row) in pairwise(path):
            (top, bottom), (first, last) = sorted((row, next_row)), sorted((col, next_col))
            pixels[top : bottom + 1, left + first : left + last + 1] = True
    return pixels


@cache
def agent_sprite(agent: int, heading: int, size: int) -> NDArray[np.uint8]:
    """An agent in a cell: uint8 [size, size], `NOTHING`, `BODY`, `INK` or `MARKED`.

    A number too large for the cell is left out; from eleven pixels on, numbers below 100 fit.
    """
    mark = agent_mark(agent)
    edge = 1 if size > 14 else 0
    body = size - 2 * edge
    mark_wide, deep = max(1, body // 10), max(1, body // 5)
    rim = mark_wide if mark == "ring" else 0
    tip = rim + edge
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


def _draw_mark(sprite: NDArray[np.uint8], mark: str, wide: int) -> None:
    """Draws the mark of an agent that is headed up."""
    if mark == "ring":
        sprite[:wide] = sprite[-wide:] = sprite[:, :wide] = sprite[:, -wide:] = MARKED
    elif mark == "stripe":
        sprite[-wide:] = MARKED
    elif mark == "corners":
        for rows in (slice(2 * wide), slice(-2 * wide, None)):
            sprite[rows, : 2 * wide] = sprite[rows, -2 * wide :] = MARKED


def _draw_number(
    sprite: NDArray[np.uint8], agent: int, heading: int, *, front: int, back: int, side: int
) -> None:
    """Draws the number as large as it fits behind the triangle, whatever the heading."""
    pixels = number_pixels(agent)
    body = len(sprite)
    deep, broad = body - front - back, body - 2 * side
    scale = min(deep - (len(pixels) == max(pixels.shape)), broad) // max(pixels.shape)
    if scale < 1:
        return
    pixels = pixels.repeat(scale, 0).repeat(scale, 1)
    (high, wide), behind = pixels.shape, (front + 1 - back) // 2
    down, right = ((1, 0), (0, -1), (-1, 0), (0, 1))[heading]
    top = min(max((body - high) // 2 + behind * down, 0), body - high)
    left = min(max((body - wide) // 2 + behind * right, 0), body - wide)
    sprite[top : top + high, left : left + wide][pixels] = INK
