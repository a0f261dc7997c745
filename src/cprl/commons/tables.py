"""Tables: a game as lookup tables and plain numbers, which is all that the compiled rules read of it."""

from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import numpy as np

from cprl.commons.cells import GROUND, WALL, WATER
from cprl.commons.chance import REST_BITS
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.maps import Map
from cprl.commons.near import growth_probs, neighbours
from cprl.commons.rules import HARVEST_ACTION, Clashes, Growth, RandomEnd, Rules
from cprl.commons.views import CLASS_SHIFT
from cprl.institutions.institution import threshold
from cprl.values.array_types import Int32, Int64, UInt32

if TYPE_CHECKING:
    from cprl.commons.game import Game

LARGEST_TABLE: Final = 2**27
"""The largest number of pairs of near sites. A table of this size takes some seconds to build."""


class Tables(NamedTuple):
    """A game as arrays and numbers for the compiled rules. Arrays are int32 unless stated otherwise.

    A cell is an index into the board with a rim of wall around it, counted row by row, with `stride` cells
    per row. Numbers and switches without a docstring have the meaning of the field of that name of `Rules`,
    or of `Game.observation`.
    """

    background: Int32
    """[cells], the paint of each cell without agents and apples: ground, wall or water."""
    site_cell: UInt32
    """uint32 [K], the cell of each site."""
    site_at: Int32
    """[cells], the site on each cell, or -1."""
    near_first: Int32
    """[K + 1], where the near sites of each site begin: those of site k are
    `near_sites[near_first[k]:near_first[k + 1]]`."""
    near_sites: UInt32
    """uint32 [pairs], the sites near site 0, near site 1, and so on, each without the site itself."""
    regrow_below: Int64
    """int64, thresholds in rows of (largest number of near sites + 1): an empty site grows an apple if a
    uniform 32-bit word is below entry m of its row, where m is the number of apples near it."""
    regrow_first_byte: Int32
    """The largest first byte of a word below each threshold in `regrow_below`; -1 where no apple can grow."""
    regrow_row: UInt32
    """uint32 [K], where the row of each site begins in `regrow_below`; uint32 [1] if all sites share one row,
    as under `Rules.regrow_by` "count"."""
    start: Int32
    """[N, 3], row, column and heading of each agent at the start of an episode."""
    spawns: Int32
    """[S, 2], row and column of each spawn place."""
    beam_length: Int32
    """[4], the length of a beam in cells, by heading."""
    paints: Int32
    """[classes], the paint of each class, which is the value of a cell in the picture:
    red + 2**8 green + 2**16 blue + 2**24 class."""
    channel_of: Int32
    """[classes], the channel of each class in "one_hot" observations; -1 for classes that cannot occur."""
    window_cells: Int32
    """[4, X * Y], by heading: the offsets from an agent's cell to the cells of its window. If agents observe
    the whole board, these are the cells of the board."""
    rim: int
    """The width of the rim in cells, enough for any window and beam."""
    stride: int
    """The number of cells per row, rim included."""
    beam_half_width: int
    """The cells to each side of a beam's middle."""
    hits_to_tag: int
    freeze_steps: int
    episode_steps: int
    has_beam: bool
    """Whether agents have the action "fire"."""
    agents_apart: bool
    one_hot: bool
    """Whether observations have a channel for each class of cell."""
    highest: int
    """The largest value in an observation, 1 or 255, see `Game.observation_highest`."""
    score_begin: int
    """The index of the first entry of the scoreboard and stock gauge in an agent's flattened observation."""
    scoreboard_cells: int
    """The number of entries of the scoreboard, which comes first; 0 without it."""
    stock_gauge_cells: int
    """The number of entries of the stock gauge, which comes next; 0 without it."""
    sees_all: bool
    """Whether agents observe the whole board."""
    shuffle_starts: bool
    never_from_nothing: bool
    """Whether an empty board stays empty for ever, which ends an episode."""
    regrow_by_share: bool
    """Whether growth goes by the share of near sites that hold an apple, not by their number."""
    regrow_under_agents: bool
    growth: int
    """The number of the word in `Rules.growth`, see `cprl.commons.apples`."""
    first_stock: int
    """The number of sites that hold an apple when an episode begins."""
    silent_actions: int
    """The number of actions that send no signal."""
    harvest_number: int
    """The index of the action "harvest"; -1 if agents harvest without one."""
    beam_tapers: bool
    beam_from_beside: bool
    beam_stops_at_agents: bool
    cooldown_steps: int
    end_below: int
    """An episode ends by chance after a turn if a uniform 32-bit word is below this threshold."""
    end_from_step: int
    """`RandomEnd.from_step`, the first turn after which chance may end an episode."""
    end_every_steps: int
    """`RandomEnd.every_steps`, the turns from one such chance to the next."""
    random_headings: bool
    respawn_at_spawns: bool
    clashes: int
    """The number of the word in `Rules.clashes`, see `cprl.commons.moves`."""


def check_sizes(board: Map, rules: Rules) -> None:
    """Raise a ValueError if the table of near sites could be too large, before it is built."""
    reach = int(rules.regrow_radius_cells)
    sites = len(board.sites)
    most_near_cells = (2 * min(reach, board.height) + 1) * (2 * min(reach, board.width) + 1) - 1
    pairs = sites * min(sites - 1, most_near_cells)
    if pairs > LARGEST_TABLE:
        raise ValueError(
            f"Rules.regrow_radius_cells is {rules.regrow_radius_cells:g} and the map has {sites:,} sites, up "
            f"to {pairs:,} pairs of near sites; allowed: {LARGEST_TABLE:,} pairs, so a smaller radius or map"
        )


def _beam_half_width(board: Map, rules: Rules) -> int:
    """Return the number of columns of a beam on each side of the middle one, as far as the board has them."""
    return min(rules.beam_width_cells // 2, max(board.height, board.width) - 1)


def _rim(board: Map, rules: Rules, *, sees_all: bool = False) -> int:
    """Return a width of the rim, in cells, so that no beam and no window leaves the table."""
    beam_rim = max(1, _beam_half_width(board, rules))
    if sees_all:
        return beam_rim
    return max(beam_rim, rules.window_rows - 1, rules.window_rows_behind, rules.window_columns // 2)


def _window_offsets(rules: Rules, stride: int) -> Int32:
    """Return the offsets from an agent's cell to the cells of its window, by heading: [4, X * Y].

    The farthest row comes first, and in each row the leftmost column.
    """
    middle = rules.window_columns // 2
    rows_ahead = range(rules.window_rows - 1, -1 - rules.window_rows_behind, -1)
    ahead, side = np.meshgrid(rows_ahead, range(-middle, middle + 1), indexing="ij")
    steps_ahead = stride * np.array(ROW_STEP) + COL_STEP
    steps_right = np.roll(steps_ahead, -1)
    offsets = np.multiply.outer(steps_ahead, ahead) + np.multiply.outer(steps_right, side)
    return offsets.reshape(4, -1).astype(np.int32)


def _board_cells(board: Map, rim: int, stride: int) -> Int32:
    """Return the cells of the whole board, row by row, the same for each heading: [4, H * W]."""
    rows, cols = np.mgrid[rim : rim + board.height, rim : rim + board.width]
    return np.tile((rows * stride + cols).reshape(1, -1), (4, 1)).astype(np.int32)


def build_tables(game: "Game") -> Tables:
    """Build the tables of a game."""
    rules = game.rules
    sees_all = game.observation.area == "full"
    rim = _rim(game.map, rules, sees_all=sees_all)
    tables: dict[str, Any] = {
        **_board_tables(game, rim),
        **_growth_tables(game.map, rules),
        **_observation_tables(game, rim),
        **_rule_numbers(rules),
    }
    return Tables(
        rim=rim,
        stride=_stride(game.map, rim),
        beam_length=np.array(rules.beam_lengths_cells, np.int32),
        beam_half_width=_beam_half_width(game.map, rules),
        first_stock=round(rules.first_stock_share * len(game.map.sites)),
        sees_all=sees_all,
        **tables,
    )


def _stride(board: Map, rim: int) -> int:
    """Return the number of cells per row, rim included."""
    return board.width + 2 * rim


def _cells(positions: tuple[tuple[int, ...], ...], rim: int, stride: int) -> list[int]:
    """Return the cells at positions (row, col) or (row, col, heading) on the board."""
    return [(position[0] + rim) * stride + position[1] + rim for position in positions]


def _board_tables(game: "Game", rim: int) -> dict[str, Any]:
    """Return the tables about the board: what is on its cells, and where agents start."""
    board = game.map
    stride = _stride(board, rim)
    paints = _paints(game)
    background = np.full((board.height + 2 * rim, stride), paints[WALL], np.int32)
    background[rim:-rim, rim:-rim] = paints[GROUND]
    background.reshape(-1)[_cells(board.walls, rim, stride)] = paints[WALL]
    background.reshape(-1)[_cells(board.river, rim, stride)] = paints[WATER]
    site_cell = np.array(_cells(board.sites, rim, stride), np.uint32)
    site_at = np.full(background.size, -1, np.int32)
    site_at[site_cell] = range(len(site_cell))
    return {
        "paints": paints,
        "background": background.reshape(-1),
        "site_cell": site_cell,
        "site_at": site_at,
        "start": np.array(board.starts, np.int32),
        "spawns": np.array(board.spawns, np.int32).reshape(-1, 2),
    }


def _paints(game: "Game") -> Int32:
    """Return the paint of each class of cell, see `Tables.paints`."""
    red, green, blue = game.palette.astype(np.uint32).T
    classes = np.arange(len(red), dtype=np.uint32)
    paints: Int32 = (red | green << 8 | blue << 16 | classes << CLASS_SHIFT).view(np.int32)
    return paints


def _growth_tables(board: Map, rules: Rules) -> dict[str, Any]:
    """Return the tables about the growth of apples."""
    near_first, near_sites = neighbours(board, rules)
    row_of_site, probs = growth_probs(rules, np.diff(near_first))
    thresholds = np.array([threshold(prob) for prob in probs.reshape(-1)], np.int64)
    return {
        "near_first": near_first,
        "near_sites": near_sites,
        "regrow_below": thresholds,
        "regrow_first_byte": ((thresholds - 1) >> REST_BITS).astype(np.int32),
        "regrow_row": (row_of_site * probs.shape[1]).astype(np.uint32),
        "regrow_by_share": rules.regrow_by != "count",
        "never_from_nothing": rules.regrow_prob[0] == 0 and not rules.plays_on_when_empty,
        "growth": get_args(Growth).index(rules.growth),
    }


def _observation_tables(game: "Game", rim: int) -> dict[str, Any]:
    """Return the tables and numbers about the observations of agents."""
    board = game.map
    rules = game.rules
    observation = game.observation
    stride = _stride(board, rim)
    is_full = observation.area == "full"
    window_cells = _board_cells(board, rim, stride) if is_full else _window_offsets(rules, stride)
    channel_of = np.full(len(game.palette), -1, np.int32)
    channel_of[list(game.cell_classes)] = range(len(game.cell_classes))
    plane_size = window_cells.shape[1]
    cell_channels = len(game.cell_channels)
    return {
        "window_cells": window_cells,
        "channel_of": channel_of,
        "agents_apart": observation.agents_apart,
        "one_hot": observation.encoding == "one_hot",
        "highest": game.observation_highest,
        "score_begin": plane_size * (cell_channels + rules.signals),
        "scoreboard_cells": plane_size * game.score_channels.count("scoreboard"),
        "stock_gauge_cells": plane_size * game.score_channels.count("stock_gauge"),
    }


def _rule_numbers(rules: Rules) -> dict[str, Any]:
    """Return the numbers and switches of rules: the fields of `Rules` that `Tables` has under the same name,
    and those that are computed from others."""
    end = rules.random_end or RandomEnd(prob=0.0)
    numbers: dict[str, Any] = {
        name: value
        for name, value in vars(rules).items()
        if name in Tables._fields and isinstance(value, int | float)
    }
    return numbers | {
        "has_beam": rules.may_fire,
        "silent_actions": len(rules.actions) // (1 + rules.signals),
        "harvest_number": rules.actions.index(HARVEST_ACTION) if rules.harvest_action else -1,
        "end_below": threshold(end.prob),
        "end_from_step": end.from_step,
        "end_every_steps": end.every_steps,
        "clashes": get_args(Clashes).index(rules.clashes),
    }
