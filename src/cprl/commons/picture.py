"""An image of the board for people: apples, walls, and each agent in its own colour with its heading."""

from typing import Final

import numpy as np

from cprl.commons.colours import APPLE, BEAM, COLOURS, GROUND, WALL, agent_colour
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.world import COL_STEP, ROW_STEP, Bools, Bytes, Ints, Shown

GRID_COLOUR: Final = (28, 30, 36)
CELL_COLOURS: Final = {GROUND: (16, 18, 22), WALL: (125, 125, 125), APPLE: (46, 184, 76)}


def board_image(
    board: Map,
    stock: Bytes,
    row: Ints,
    col: Ints,
    heading: Ints,
    *,
    in_play: Bools | None = None,
    beams: Bools | None = None,
    cell_pixels: int = 24,
) -> Bytes:
    """An image of one world.

    Args:
        board: The map, with walls and sites.
        stock: uint8 [K], 1 where a site holds an apple.
        row: int [N], the row of each agent.
        col: int [N], the column of each agent.
        heading: int [N], 0 up, 1 right, 2 down, 3 left.
        in_play: bool [N], the agents to draw; None for all.
        beams: bool [H, W], cells that a beam covers; None for no beam.
        cell_pixels: The size of a cell in pixels, at least 8.

    Returns:
        uint8 [H * cell_pixels + 1, W * cell_pixels + 1, 3], RGB.

    Raises:
        ValueError: If `cell_pixels` is below 8.
    """
    if cell_pixels < 8:
        raise ValueError(f"cell_pixels is {cell_pixels}; allowed: an integer >= 8")
    size = cell_pixels
    image = np.empty((board.height * size + 1, board.width * size + 1, 3), np.uint8)
    image[:] = GRID_COLOUR
    kinds = np.full((board.height, board.width), GROUND)
    for cell in board.walls:
        kinds[cell] = WALL
    for cell, apple in zip(board.sites, stock, strict=True):
        kinds[cell] = APPLE if apple else GROUND
    for r in range(board.height):
        for c in range(board.width):
            kind = int(kinds[r, c])
            inset = size // 6 if kind == APPLE else 0
            image[r * size + 1 : (r + 1) * size, c * size + 1 : (c + 1) * size] = CELL_COLOURS[GROUND]
            _fill(image, r, c, size, inset, CELL_COLOURS[kind])
            if beams is not None and beams[r, c]:
                _fill(image, r, c, size, 2 * size // 5, COLOURS[BEAM])
    for i, (r, c, h) in enumerate(zip(row, col, heading, strict=True)):
        if in_play is None or in_play[i]:
            _draw_agent(image, int(r), int(c), int(h), size, agent_colour(i))
    return image


def world_image(board: Map, shown: Shown, *, cell_pixels: int = 24) -> Bytes:
    """An image of the current state of one world, without agents out of play; see `board_image`."""
    return board_image(
        board,
        shown.stock,
        shown.row,
        shown.col,
        shown.heading,
        in_play=shown.in_play,
        beams=shown.board == BEAM,
        cell_pixels=cell_pixels,
    )


def first_image(game: Game, *, cell_pixels: int = 24) -> Bytes:
    """An image of the board at the start of an episode; see `board_image`."""
    starts = np.array(game.map.starts, np.int32)
    full = np.ones(len(game.map.sites), np.uint8)
    return board_image(game.map, full, *starts.T, cell_pixels=cell_pixels)


def _fill(image: Bytes, r: int, c: int, size: int, inset: int, colour: tuple[int, int, int]) -> None:
    top, left = r * size + 1 + inset, c * size + 1 + inset
    image[top : (r + 1) * size - inset, left : (c + 1) * size - inset] = colour


def _draw_agent(image: Bytes, r: int, c: int, heading: int, size: int, colour: tuple[int, int, int]) -> None:
    """Draws a square with a white triangle that points in the direction of the heading."""
    _fill(image, r, c, size, 1, colour)
    middle = size // 2
    for away in range(size // 2 - 2):
        half = (size // 2 - 2 - away) // 2
        row = r * size + middle + ROW_STEP[heading] * away
        col = c * size + middle + COL_STEP[heading] * away
        if ROW_STEP[heading]:
            image[row, col - half : col + half + 1] = 255
        else:
            image[row - half : row + half + 1, col] = 255
