"""A game as lookup tables for the compiled rules."""

from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import numpy as np

from cprl.commons.cells import GROUND, WALL, WATER
from cprl.commons.chance import REST_BITS
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.maps import Map
from cprl.commons.near import growth, neighbours
from cprl.commons.rules import HARVEST, Clashes, Growth, Rules
from cprl.commons.views import CLASS_SHIFT
from cprl.institutions.base import threshold
from cprl.values.arrays import Int32, Int64, UInt32

if TYPE_CHECKING:
    from cprl.commons.game import Game

LARGEST_TABLE: Final = 2**27
"""The largest number of pairs of near sites; takes some seconds to build."""


class Tables(NamedTuple):
    """A game as arrays, int32 unless stated otherwise.

    A cell is an index into the board with a rim of wall around it, row by row, `stride` cells per row.
    """

    background: Int32
    """[cells], the paint of each cell without agents and apples: ground or wall."""
    site_cell: UInt32
    """uint32 [K], the cell of each site."""
    site_at: Int32
    """[cells], the site on each cell, or -1."""
    near_first: Int32
    """[K + 1], the sites near site k are `near_sites[near_first[k]:near_first[k + 1]]`."""
    near_sites: UInt32
    """uint32 [pairs], the sites near each site, without the site itself."""
    regrow_below: Int64
    """int64 [rows of (largest number of near sites + 1)]: with this many apples near it, an empty site grows
    an apple if a uniform 32-bit word is below this threshold."""
    regrow_first_byte: Int32
    """Likewise, the largest first byte of a word below that threshold; -1 where no apple can grow."""
    regrow_row: UInt32
    """uint32 [K], where the row of a site begins, by the number of sites near it; under "count" there is one
    row, and [0]."""
    start: Int32
    """[N, 3], row, column and heading of each agent at the start of an episode."""
    spawns: Int32
    """[S, 2], row and column of each spawn place."""
    beam_length: Int32
    """[4], in cells, by heading."""
    paints: Int32
    """[classes], the value of a picture's cell: red + 2**8 green + 2**16 blue + 2**24 class."""
    channel_of: Int32
    """[classes], the channel of each class under "one_hot"; -1 for classes that cannot occur."""
    window_cells: Int32
    """[4, X * Y], by heading: the offset from an agent's cell to each cell of its window; under "full", the
    cells of the board."""
    rim: int
    """The width of the rim in cells, enough for any window and beam."""
    stride: int
    """The number of cells per row, rim included."""
    beam_half_width: int
    hits_to_tag: int
    freeze_steps: int
    episode_steps: int
    has_beam: bool
    agents_apart: bool
    one_hot: bool
    highest: int
    """The largest value of an observation: 1 under "one_hot" where there are no planes of other kinds, else
    255."""
    score_begin: int
    """The first entry of the planes of `Observation` in an agent's observation, channel by channel."""
    scoreboard_cells: int
    """The entries of the planes of the scoreboard, which come first; 0 if it has none."""
    stock_gauge_cells: int
    """Likewise of the stock gauge, which follow."""
    sees_all: bool
    """Whether agents observe the whole board."""
    shuffle_starts: bool
    never_from_nothing: bool
    """Whether an empty board stays empty, which ends an episode."""
    regrow_by_share: bool
    regrow_under_agents: bool
    growth: int
    """`Rules.growth`, see `cprl.commons.apples`."""
    first_stock: int
    """Sites that hold an apple when an episode begins."""
    signals: int
    first_signal_plane: int
    """The channel of observations that shows the first signal."""
    silent_actions: int
    """The number of actions without a signal."""
    harvest_number: int
    """The action that harvests; -1 where none is needed."""
    beam_tapers: bool
    beam_from_beside: bool
    beam_stops_at_agents: bool
    cooldown_steps: int
    end_below: int
    """An episode ends by chance if a uniform 32-bit word is below this threshold."""
    end_from_step: int
    end_every_steps: int
    random_headings: bool
    respawn_at_spawns: bool
    clashes: int
    """`Rules.clashes`, see `cprl.commons.moves`."""


def check_sizes(board: Map, rules: Rules) -> None:
    """Check the size of the largest table, before it is built."""
    reach, sites = int(rules.regrow_radius_cells), len(board.sites)
    around = (2 * min(reach, board.height) + 1) * (2 * min(reach, board.width) + 1) - 1
    pairs = sites * min(sites - 1, around)
    if pairs > LARGEST_TABLE:
        raise ValueError(
            f"Rules.regrow_radius_cells is {rules.regrow_radius_cells:g} and the map has {sites:,} sites, up "
            f"to {pairs:,} pairs of near sites; allowed: {LARGEST_TABLE:,} pairs, so a smaller radius or map"
        )


def _beam_half_width(board: Map, rules: Rules) -> int:
    return min(rules.beam_width_cells // 2, max(board.height, board.width) - 1)


def _rim(board: Map, rules: Rules, *, sees_all: bool = False) -> int:
    window = (rules.window_rows - 1, rules.window_rows_behind, rules.window_columns // 2)
    return max(1, _beam_half_width(board, rules), *(() if sees_all else window))


def _window_places(rules: Rules) -> list[tuple[int, int]]:
    """Return the (ahead, side) of each cell of a window: farthest row first, leftmost column first."""
    middle = rules.window_columns // 2
    return [
        (ahead, side)
        for ahead in range(rules.window_rows - 1, -1 - rules.window_rows_behind, -1)
        for side in range(-middle, middle + 1)
    ]


def _offset(ahead: int, side: int, heading: int, stride: int) -> int:
    """Return the offset from an agent's cell to the one `ahead` cells ahead and `side` cells to the right."""
    right = (heading + 1) % 4
    rows = ahead * ROW_STEP[heading] + side * ROW_STEP[right]
    cols = ahead * COL_STEP[heading] + side * COL_STEP[right]
    return rows * stride + cols


def _board_cells(board: Map, rim: int, stride: int) -> Int32:
    """Every cell of the board, row by row, repeated for each heading: [4, H * W]."""
    rows, cols = np.mgrid[rim : rim + board.height, rim : rim + board.width]
    return np.tile((rows * stride + cols).reshape(1, -1), (4, 1)).astype(np.int32)


def build_tables(game: "Game") -> Tables:
    """Build the tables of a game."""
    board, rules, observation = game.map, game.rules, game.observation
    sees_all = observation.area == "full"
    rim = _rim(board, rules, sees_all=sees_all)
    stride = board.width + 2 * rim

    def cells(places: tuple[tuple[int, ...], ...]) -> list[int]:
        return [(place[0] + rim) * stride + place[1] + rim for place in places]

    def index_at(places: tuple[tuple[int, ...], ...]) -> Int32:
        index = np.full(background.size, -1, np.int32)
        index[cells(places)] = range(len(places))
        return index

    red, green, blue = game.palette.astype(np.uint32).T
    kinds = np.arange(len(red), dtype=np.uint32)
    paints = (red | green << 8 | blue << 16 | kinds << CLASS_SHIFT).view(np.int32)
    channel_of = np.full(len(paints), -1, np.int32)
    channel_of[list(game.cell_classes)] = range(len(game.cell_classes))
    background = np.full((board.height + 2 * rim, stride), paints[WALL], np.int32)
    background[rim:-rim, rim:-rim] = paints[GROUND]
    background.reshape(-1)[cells(board.walls)] = paints[WALL]
    background.reshape(-1)[cells(board.river)] = paints[WATER]
    near_first, near_sites = neighbours(board, rules)
    places = _window_places(rules)
    offsets = [[_offset(*place, heading, stride) for place in places] for heading in range(4)]
    window_cells = _board_cells(board, rim, stride) if sees_all else np.array(offsets, np.int32)
    seen, board_planes = window_cells.shape[1], len(game.cell_channels)
    of_site, probs = growth(rules, np.diff(near_first))
    below = np.array([threshold(p) for p in probs.reshape(-1)], np.int64)
    end = rules.random_end
    of_rules: dict[str, Any] = {
        name: value
        for name, value in vars(rules).items()
        if name in Tables._fields and isinstance(value, int | float)
    }
    return Tables(
        background=background.reshape(-1),
        site_cell=np.array(cells(board.sites), np.uint32),
        site_at=index_at(board.sites),
        near_first=near_first,
        near_sites=near_sites,
        regrow_below=below,
        regrow_first_byte=((below - 1) >> REST_BITS).astype(np.int32),
        regrow_row=(of_site * probs.shape[1]).astype(np.uint32),
        start=np.array(board.starts, np.int32),
        spawns=np.array(board.spawns, np.int32).reshape(-1, 2),
        beam_length=np.array(rules.beam_lengths_cells, np.int32),
        paints=paints,
        channel_of=channel_of,
        window_cells=window_cells,
        rim=rim,
        stride=stride,
        beam_half_width=_beam_half_width(board, rules),
        has_beam=rules.may_fire,
        agents_apart=observation.agents_apart,
        one_hot=observation.encoding == "one_hot",
        highest=game.observation_highest,
        first_signal_plane=board_planes,
        score_begin=seen * (board_planes + rules.signals),
        scoreboard_cells=seen * game.score_channels.count("scoreboard"),
        stock_gauge_cells=seen * game.score_channels.count("stock_gauge"),
        sees_all=sees_all,
        never_from_nothing=rules.regrow_prob[0] == 0 and not rules.plays_on_when_empty,
        regrow_by_share=rules.regrow_by != "count",
        first_stock=round(rules.first_stock_share * len(board.sites)),
        silent_actions=len(rules.actions) // (1 + rules.signals),
        harvest_number=rules.actions.index(HARVEST) if rules.harvest_action else -1,
        end_below=0 if end is None else threshold(end.prob),
        end_from_step=1 if end is None else end.from_step,
        end_every_steps=1 if end is None else end.every_steps,
        clashes=get_args(Clashes).index(rules.clashes),
        growth=get_args(Growth).index(rules.growth),
        **of_rules,
    )
