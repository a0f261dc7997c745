"""A game as lookup tables for the compiled rules."""

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import REST_BITS
from cprl.commons.colours import GROUND, WALL, WATER
from cprl.commons.maps import Map
from cprl.commons.near import growth, neighbours
from cprl.commons.rules import CLEAN, HARVEST, Rules
from cprl.commons.world import COL_STEP, ROW_STEP, Bools, Bytes, Indices, Ints
from cprl.institutions.base import threshold

if TYPE_CHECKING:
    from cprl.commons.game import Game

FURTHER: Final = True
"""Whether rules are compiled with what only `FURTHER_RULES` need; see `cprl.commons.compiled`."""
FURTHER_RULES: Final = (
    *("regrow_by", "regrow_under_agents", "regrow_after_bites", "first_stock_share", "harvest_action"),
    *("beam_tapers", "beam_from_beside", "beam_stops_at_agents", "cooldown_steps", "end_prob"),
    *("random_headings", "respawn_at_spawns", "clashes", "signals", "may_clean", "pollution_prob"),
)
"""Rules that the study does not have: a game in which all of them are off, on a map without spawn places or
a river, and without planes of `Observation`, is played as fast as if there were none."""
CLASS_SHIFT: Final = 24
"""A paint is a colour in 24 bits, and its class from this bit on."""
LARGEST_CLASS: Final = 255

LARGEST_TABLE: Final = 2**27
"""The largest number of pairs of near sites, or of lines of sight; takes some seconds to build."""


class Tables(NamedTuple):
    """A game as arrays, int32 unless stated otherwise.

    A cell is an index into the board with a rim of wall around it, row by row, `stride` cells per row.
    """

    background: Ints
    """[cells], the paint of each cell without agents and apples: ground or wall."""
    site_cell: Indices
    """uint32 [K], the cell of each site."""
    site_at: Ints
    """[cells], the site on each cell, or -1."""
    near_first: Ints
    """[K + 1], the sites near site k are `near_sites[near_first[k]:near_first[k + 1]]`."""
    near_sites: Indices
    """uint32 [pairs], the sites near each site, without the site itself."""
    regrow_below: NDArray[np.int64]
    """int64 [rows of (largest number of near sites + 1)]: with this many apples near it, an empty site grows
    an apple if a uniform 32-bit word is below this threshold."""
    regrow_first_byte: Ints
    """Likewise, the largest first byte of a word below that threshold; -1 where no apple can grow."""
    regrow_row: Indices
    """uint32 [K], where the row of a site begins, by the number of sites near it; under "count" there is one
    row, and [0]."""
    start: Ints
    """[N, 3], row, column and heading of each agent at the start of an episode."""
    spawns: Ints
    """[S, 2], row and column of each spawn place."""
    river_cell: Indices
    """uint32 [R], the cell of each cell of the river."""
    river_at: Ints
    """[cells], the index of each cell in the river, or -1."""
    first_waste: Bytes
    """uint8 [R], 1 where a cell of the river has waste when an episode begins."""
    pollute_below: NDArray[np.int64]
    """int64 [R + 1], by the number of clean cells: one of them gets waste if a uniform 32-bit word is below
    this threshold."""
    beam_length: Ints
    """[4], in cells, by heading."""
    paints: Ints
    """[classes], the value of a picture's cell: red + 2**8 green + 2**16 blue + 2**24 class."""
    channel_of: Ints
    """[classes], the channel of each class under "one_hot"; -1 for classes that cannot occur."""
    window_cells: Ints
    """[4, X * Y], by heading: the offset from an agent's cell to each cell of its window; under "full", the
    cells of the board."""
    in_sight: Bools
    """bool [cells, 4, X * Y], by the agent's cell and heading: whether no wall lies between the agent and
    each cell of its window; [1, 1, 1] if walls do not block sight."""
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
    walls_block_sight: bool
    further: bool
    """Whether the game has any of `FURTHER_RULES`, spawn places, a river or planes of `Observation`."""
    shuffle_starts: bool
    never_from_nothing: bool
    """Whether an empty board stays empty, which ends an episode."""
    regrow_by_share: bool
    regrow_under_agents: bool
    regrow_after_bites: bool
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
    pollution_limit: float
    pollution_free: float
    clean_number: int
    """The action that cleans; -1 where there is none."""
    moves_in_turn: bool
    one_moves: bool
    pairwise_clashes: bool
    regrow_before_bites: bool
    freeze_counts_tag_turn: bool
    ends_one_turn_late: bool
    picture_shows_old_stock: bool
    paint_over: bool
    mark_behind_if_vertical: bool
    self_paint_stays: bool
    agent_1_right_moves_agent_0: bool


def check_sizes(board: Map, rules: Rules) -> None:
    """Checks the sizes of the two largest tables, before they are built."""
    reach, sites = int(rules.regrow_radius_cells), len(board.sites)
    around = (2 * min(reach, board.height) + 1) * (2 * min(reach, board.width) + 1) - 1
    pairs = sites * min(sites - 1, around)
    if pairs > LARGEST_TABLE:
        raise ValueError(
            f"Rules.regrow_radius_cells is {rules.regrow_radius_cells:g} and the map has {sites:,} sites, up "
            f"to {pairs:,} pairs of near sites; allowed: {LARGEST_TABLE:,} pairs, so a smaller radius or map"
        )
    rim = _rim(board, rules)
    cells = (board.height + 2 * rim) * (board.width + 2 * rim)
    entries = 4 * cells * len(_window_places(rules))
    if rules.walls_block_sight and entries > LARGEST_TABLE:
        raise ValueError(
            f"Rules.walls_block_sight is True with windows of {rules.window_rows} x {rules.window_columns} "
            f"cells on a board of {board.height} x {board.width}, {entries:,} lines of sight; allowed: "
            f"{LARGEST_TABLE:,}, so a smaller window or map"
        )


def _beam_half_width(board: Map, rules: Rules) -> int:
    return min(rules.beam_width_cells // 2, max(board.height, board.width) - 1)


def _rim(board: Map, rules: Rules, *, sees_all: bool = False) -> int:
    window = (rules.window_rows - 1, rules.window_rows_behind, rules.window_columns // 2)
    return max(1, _beam_half_width(board, rules), *(() if sees_all else window))


def _window_places(rules: Rules) -> list[tuple[int, int]]:
    """The (ahead, side) of each cell of a window: farthest row first, leftmost column first."""
    middle = rules.window_columns // 2
    return [
        (ahead, side)
        for ahead in range(rules.window_rows - 1, -1 - rules.window_rows_behind, -1)
        for side in range(-middle, middle + 1)
    ]


def _offset(ahead: int, side: int, heading: int, stride: int) -> int:
    """The offset from an agent's cell to the one `ahead` cells ahead and `side` cells to the right."""
    right = (heading + 1) % 4
    rows = ahead * ROW_STEP[heading] + side * ROW_STEP[right]
    cols = ahead * COL_STEP[heading] + side * COL_STEP[right]
    return rows * stride + cols


def _board_cells(board: Map, rim: int, stride: int) -> Ints:
    """Every cell of the board, row by row, repeated for each heading: [4, H * W]."""
    rows, cols = np.mgrid[rim : rim + board.height, rim : rim + board.width]
    return np.tile((rows * stride + cols).reshape(1, -1), (4, 1)).astype(np.int32)


def cells_between(rows: int, cols: int) -> list[tuple[int, int]]:
    """The cells whose interior the straight line between two cell centres crosses, without the two ends; the
    second one lies so many rows and columns from the first.

    A line that only touches a corner of a cell does not cross the cell: agents see through the gap between
    two diagonal walls. The line crosses the interior of the unit square around (r, c) if
    abs(rows c - cols r) < (abs(rows) + abs(cols)) / 2.
    """
    down, right = (1 if rows >= 0 else -1), (1 if cols >= 0 else -1)
    return [
        (r, c)
        for r in range(0, rows + down, down)
        for c in range(0, cols + right, right)
        if (r, c) not in ((0, 0), (rows, cols)) and 2 * abs(rows * c - cols * r) < abs(rows) + abs(cols)
    ]


def _in_sight(board: Map, rules: Rules, walls: Bools, rim: int, stride: int) -> Bools:
    """`Tables.in_sight`; `walls`: bool [cells]."""
    if not rules.walls_block_sight:
        return np.ones((1, 1, 1), np.bool_)
    places = _window_places(rules)
    inside = _board_cells(board, rim, stride)[0]
    seen = np.zeros((walls.size, 4, len(places)), np.bool_)
    for n, place in enumerate(places):
        between = cells_between(*place)
        for heading in range(4):
            crossed = [_offset(*cell, heading, stride) for cell in between]
            seen[inside, heading, n] = ~walls[np.add.outer(inside, np.array(crossed, np.int64))].any(1)
    return seen


def build_tables(game: "Game") -> Tables:
    """Builds the tables of a game."""
    board, rules, observation = game.map, game.rules, game.observation
    sees_all = observation.area == "full"
    rim = _rim(board, rules, sees_all=sees_all)
    stride = board.width + 2 * rim

    def cells(places: tuple[tuple[int, ...], ...]) -> list[int]:
        return [(place[0] + rim) * stride + place[1] + rim for place in places]

    def index_at(places: tuple[tuple[int, ...], ...]) -> Ints:
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
    of_rules: dict[str, Any] = {name: getattr(rules, name) for name in Tables._fields if hasattr(rules, name)}
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
        river_cell=np.array(cells(board.river), np.uint32),
        river_at=index_at(board.river),
        first_waste=np.isin(np.arange(len(board.river)), board.waste).astype(np.uint8),
        pollute_below=np.array(
            [threshold(1 - (1 - rules.pollution_prob) ** n) for n in range(len(board.river) + 1)], np.int64
        ),
        spawns=np.array(board.spawns, np.int32).reshape(-1, 2),
        beam_length=np.array(rules.beam_lengths_cells, np.int32),
        paints=paints,
        channel_of=channel_of,
        window_cells=window_cells,
        in_sight=_in_sight(board, rules, background.reshape(-1) == paints[WALL], rim, stride),
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
        further=bool(board.spawns or board.river or game.score_channels)
        or any(name in rules.changed for name in FURTHER_RULES),
        regrow_by_share=rules.regrow_by != "count",
        first_stock=round(rules.first_stock_share * len(board.sites)),
        silent_actions=len(rules.actions) // (1 + rules.signals),
        harvest_number=rules.actions.index(HARVEST) if rules.harvest_action else -1,
        clean_number=rules.actions.index(CLEAN) if rules.may_clean else -1,
        end_below=threshold(rules.end_prob),
        moves_in_turn=rules.clashes == "in_turn",
        one_moves=rules.clashes == "one_moves",
        **of_rules,
    )
