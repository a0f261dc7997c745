"""Boards as JSON for the renderer, `static/board.js`: what stays, and what changes from turn to turn.

A cell is an index, counted row by row.
"""

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from cprl.commons.cells import APPLE, BEAM, CLEANING, GROUND, MARK, OTHER, SELF, WALL, WASTE, WATER
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.world import WorldView
from cprl.pictures.colours import GREY, PALETTE, agent_colour, agent_mark, picture_colour
from cprl.pictures.image import EMPTY_SITE_COLOUR, region_colour, regions_of
from cprl.values.array_types import Bool

_COLOURS: Final = {
    "ground": PALETTE[GROUND],
    "wall": PALETTE[WALL],
    "apple": PALETTE[APPLE],
    "beam": PALETTE[BEAM],
    "water": PALETTE[WATER],
    "waste": PALETTE[WASTE],
    "cleaning": PALETTE[CLEANING],
    "empty": EMPTY_SITE_COLOUR,
}
_IN_PLAY: Final = 4
"""The bit of an agent's pose that says that it is in play. The two lowest bits are its heading, 0 to 3."""
_VIOLATED: Final = 8
"""The bit of an agent's pose that says that it broke a rule in the turn."""


def scene_json(game: Game) -> dict[str, Any]:
    """Return what stays of a game's board: its cells, its agents' hues and marks, and all other colours."""
    board = game.map
    agents = range(game.agents)
    return {
        "width": board.width,
        "height": board.height,
        "walls": _indices(board, board.walls),
        "river": _indices(board, board.river),
        "sites": _indices(board, board.sites),
        "regions": [
            {"colour": region_colour(owners), "cells": np.flatnonzero(inside).tolist()}
            for owners, inside in regions_of(game)
        ],
        "colours": [agent_colour(agent) for agent in agents],
        "marks": [agent_mark(agent) for agent in agents],
        "palette": _COLOURS,
    }


def moment_json(board: Map, world: WorldView, violated: Bool) -> dict[str, Any]:
    """Return what changes from turn to turn of one world, `violated`: bool [N], who broke a rule in the turn.

    Bits are hexadecimal texts, the first of each byte the highest. A cell that is being cleaned is in `beams`
    with the number of the board's cells added to its index.
    """
    cells = world.board.reshape(-1)
    is_waste = cells[_indices(board, board.river)] == WASTE
    poses = world.heading + _IN_PLAY * world.in_play + _VIOLATED * violated
    return {
        "apples": np.packbits(world.stock).tobytes().hex(),
        "waste": np.packbits(is_waste).tobytes().hex(),
        "cells": (world.row * board.width + world.col).tolist(),
        "poses": poses.tolist(),
        "beams": np.flatnonzero(np.concatenate([cells == BEAM, cells == CLEANING])).tolist(),
    }


def window_colours(game: Game) -> dict[int, tuple[int, int, int]]:
    """Return the colour of each class of cells in what a person sees of an agent's window.

    Self and other are blue and orange, which the colour-blind can tell apart, and apples from both.
    """
    apart = {SELF: agent_colour(0), OTHER: agent_colour(1), MARK: GREY}
    return {kind: apart.get(kind, picture_colour(kind)) for kind in game.cell_classes}


def compact_json(value: Any) -> str:
    """Return a value as JSON without spaces."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _indices(board: Map, positions: Sequence[Sequence[int]]) -> list[int]:
    """Return the indices of cells from positions that begin with (row, col)."""
    return [row * board.width + col for row, col, *_ in positions]
