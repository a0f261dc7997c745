"""An image of the board for people: apples, walls, and agents in their hues with number and heading."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.arguments import floats, integer, object_of, refusal
from cprl.commons.colours import APPLE, BEAM, GROUND, PALETTE, WALL, agent_colour
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.sprites import BODY, INK, INK_COLOUR, MARK_COLOUR, MARKED, agent_sprite
from cprl.commons.world import ROW_STEP, Bools, Bytes, Ints, Shown
from cprl.system.memory import check_memory

LARGEST_CELL_PIXELS: Final = 1000
GRID_COLOUR: Final = (28, 30, 36)
EMPTY_SITE_COLOUR: Final = (40, 43, 51)
"""Of a site without an apple: dim, so that a field that is harvested bare still looks like a field."""


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
        cell_pixels: The size of a cell in pixels, 8..1000.

    Returns:
        uint8 [H * cell_pixels + 1, W * cell_pixels + 1, 3], RGB.

    Raises:
        ValueError: If `cell_pixels` is no integer or below 8, or an array does not fit the map.
        MemoryError: If the image does not fit into memory.
    """
    object_of("board", board, Map, "a cprl.Map")
    size = integer("cell_pixels", cell_pixels, 8, LARGEST_CELL_PIXELS)
    stock = _numbers("stock", stock, (len(board.sites),), 1)
    agents = floats("row", row).shape[:1]
    row = _numbers("row", row, agents, board.height - 1)
    col = _numbers("col", col, agents, board.width - 1)
    heading = _numbers("heading", heading, agents, len(ROW_STEP) - 1)
    in_play = None if in_play is None else _numbers("in_play", in_play, agents, 1)
    beams = None if beams is None else _numbers("beams", beams, (board.height, board.width), 1)
    pixels = (board.height * size + 1) * (board.width * size + 1)
    check_memory(f"cell_pixels is {size}: the pixels", 3 * pixels, "fewer pixels")
    image = np.empty((board.height * size + 1, board.width * size + 1, 3), np.uint8)
    image[:] = GRID_COLOUR
    for r in range(board.height):
        for c in range(board.width):
            _fill(image, r, c, size, 0, PALETTE[GROUND])
    for r, c in board.walls:
        _fill(image, r, c, size, 0, PALETTE[WALL])
    for (r, c), apple in zip(board.sites, stock, strict=True):
        _fill(image, r, c, size, size // 6, PALETTE[APPLE] if apple else EMPTY_SITE_COLOUR)
    for r, c in () if beams is None else np.argwhere(beams):
        _fill(image, r, c, size, 2 * size // 5, PALETTE[BEAM])
    for i, (r, c, h) in enumerate(zip(row, col, heading, strict=True)):
        if in_play is None or in_play[i]:
            _draw_agent(image, int(r), int(c), int(h), size, i)
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
    object_of("game", game, Game, "a cprl.Game")
    starts = np.array(game.map.starts, np.int32)
    full = np.ones(len(game.map.sites), np.uint8)
    return board_image(game.map, full, *starts.T, cell_pixels=cell_pixels)


def _numbers(name: str, values: Any, shape: tuple[int, ...], highest: int) -> NDArray[Any]:
    """An array of integers or bools of a shape, 0 to `highest`; raises a ValueError for anything else."""
    try:
        found = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):
        found = np.empty(0, object)
    fits = found.dtype.kind in "biu" and found.shape == shape and found.ndim > 0
    if not fits or (found.astype(np.int64) < 0).any() or (found > highest).any():
        raise refusal(name, values, f"integers {list(shape)} from 0 to {highest}")
    return found


def _fill(image: Bytes, r: int, c: int, size: int, inset: int, colour: tuple[int, int, int]) -> None:
    top, left = r * size + 1 + inset, c * size + 1 + inset
    image[top : (r + 1) * size - inset, left : (c + 1) * size - inset] = colour


def _draw_agent(image: Bytes, r: int, c: int, heading: int, size: int, agent: int) -> None:
    """Draws an agent's sprite in its hue."""
    sprite = agent_sprite(agent, heading, size - 1)
    cell = image[r * size + 1 : (r + 1) * size, c * size + 1 : (c + 1) * size]
    for part, colour in ((BODY, agent_colour(agent)), (INK, INK_COLOUR), (MARKED, MARK_COLOUR)):
        cell[sprite == part] = colour
