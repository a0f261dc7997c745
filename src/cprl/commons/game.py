"""Game = Map + Rules, and the same written out as the tables that the compiled rules look things up in."""

from dataclasses import dataclass
from functools import cached_property
from math import hypot
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import REST_BITS, threshold
from cprl.commons.maps import Map
from cprl.commons.rules import Norm, Rules
from cprl.commons.world import COL_STEP, DOWN, LEFT, RIGHT, ROW_STEP, UP, Bools, Indices, Ints

GROUND, WALL, APPLE, MARK, BEAM, OTHER, SELF = range(7)
"""Colour classes: what a cell of a picture shows."""

CLASS_NAMES: Final = ("ground", "wall", "apple", "heading", "beam", "other", "self")

COLOURS: Final = (
    (10, 10, 10),
    (125, 125, 125),
    (0, 255, 0),
    (50, 50, 50),
    (255, 204, 51),
    (255, 0, 0),
    (0, 0, 255),
)
"""Red, green and blue of each class [W, run]."""

CLASS_SHIFT: Final = 24
"""A paint is a colour and, from this bit on, its class."""


class Tables(NamedTuple):
    """A Game as arrays. A cell is an index into the board with its rim, row by row, `stride` cells a row."""

    background: Ints
    """[cells], the paint of ground or wall; the rim is wall."""
    site_cell: Indices
    """uint32 [K], the cell of each site."""
    site_at: Ints
    """[cells], the site on each cell, or -1."""
    near_first: Ints
    """[K + 1], where a site's neighbours begin in `near_sites`, and end."""
    near_sites: Indices
    """uint32 [pairs], the sites within reach of each site, itself left out."""
    regrow_below: NDArray[np.int64]
    """int64 [most neighbours + 1], an apple grows where a uniform 32-bit word falls below this."""
    regrow_first_byte: Ints
    """[most neighbours + 1], the largest first byte that such a word can have; -1 where none grows."""
    start_row: Ints
    """[N]."""
    start_col: Ints
    """[N]."""
    start_heading: Ints
    """[N]."""
    beam_length: Ints
    """[4], cells by heading."""
    freeze: Ints
    """[N, offences], turns missed by shooter and offence."""
    may_fire: Bools
    """bool [N]."""
    may_bite: Bools
    """bool [N, K]."""
    paints: Ints
    """[classes], what a picture's cell holds: red + 2**8 green + 2**16 blue + 2**24 class."""
    window_cells: Ints
    """[4, X * Y], from an agent's cell to each cell of its window, by heading."""
    rim: int
    """Cells of wall around the board, enough for any window and beam."""
    stride: int
    """Cells from one row to the next."""
    beam_half_width: int
    hits_to_tag: int
    episode_steps: int
    has_beam: bool
    never_from_nothing: bool
    """Whether an empty board stays empty."""
    pairwise_clashes: bool
    regrow_before_bites: bool
    freeze_counts_tag_turn: bool
    ends_one_turn_late: bool
    picture_shows_old_stock: bool
    paint_over: bool
    mark_behind_if_vertical: bool
    self_paint_stays: bool


@dataclass(frozen=True, kw_only=True)
class Game:
    """A Map and the Rules it is played by.

    Raises:
        ValueError: where a rule given per agent or per site does not fit the map.
    """

    map: Map
    rules: Rules

    def __post_init__(self) -> None:
        agents, sites = self.agents, len(self.map.sites)
        may_fire, may_bite, freeze = self.rules.may_fire, self.rules.may_bite, self.rules.freeze_steps
        if isinstance(may_fire, tuple) and len(may_fire) != agents:
            raise ValueError(f"Rules.may_fire has {len(may_fire)} entries; the map has {agents} agents")
        if isinstance(freeze, tuple) and len(freeze) != agents:
            raise ValueError(f"Rules.freeze_steps has {len(freeze)} rows; the map has {agents} agents")
        if may_bite is not None and (len(may_bite), len(may_bite[0])) != (agents, sites):
            raise ValueError(
                f"Rules.may_bite is {len(may_bite)} x {len(may_bite[0])}; "
                f"the map has {agents} agents and {sites} sites"
            )

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return self.map.agents

    @property
    def agent_names(self) -> tuple[str, ...]:
        """agent_0, agent_1 and so on."""
        return tuple(f"agent_{i}" for i in range(self.agents))

    @property
    def actions(self) -> tuple[str, ...]:
        """The names of the actions by index."""
        return self.rules.actions

    @property
    def window_shape(self) -> tuple[int, int, int]:
        """(3, X, Y) of an agent's window."""
        return 3, self.rules.window_rows, self.rules.window_columns

    @cached_property
    def tables(self) -> Tables:
        """The game as the compiled rules read it; computed once."""
        return _tables(self)

    def __getstate__(self) -> dict[str, object]:
        return {"map": self.map, "rules": self.rules}


def distance(norm: Norm, rows: int, cols: int) -> float:
    """How far apart two cells are that lie so many rows and columns from each other."""
    if norm == "euclidean":
        return hypot(rows, cols)
    if norm == "manhattan":
        return abs(rows) + abs(cols)
    return max(abs(rows), abs(cols))


def neighbours(board: Map, rules: Rules) -> list[list[int]]:
    """For each site the other sites within `regrow_radius_cells`, [K] lists of site indices."""
    reach = int(rules.regrow_radius_cells)
    site_on = {cell: site for site, cell in enumerate(board.sites)}
    offsets = [
        (rows, cols)
        for rows in range(-min(reach, board.height), min(reach, board.height) + 1)
        for cols in range(-min(reach, board.width), min(reach, board.width) + 1)
        if (rows, cols) != (0, 0) and distance(rules.regrow_norm, rows, cols) <= rules.regrow_radius_cells
    ]
    return [
        sorted(site_on[row + r, col + c] for r, c in offsets if (row + r, col + c) in site_on)
        for row, col in board.sites
    ]


def _window_cells(rules: Rules, stride: int) -> Ints:
    """[4, X * Y]: farthest row first, left column first, as seen by an agent with each heading."""
    ahead = np.arange(rules.window_rows - 1, -1, -1)[:, None]
    side = np.arange(rules.window_columns)[None, :] - rules.window_columns // 2
    by_heading = [
        ahead * (ROW_STEP[h] * stride + COL_STEP[h])
        + side * (ROW_STEP[(h + 1) % 4] * stride + COL_STEP[(h + 1) % 4])
        for h in (UP, RIGHT, DOWN, LEFT)
    ]
    return np.array(by_heading, np.int32).reshape(4, -1)


def _tables(game: Game) -> Tables:
    board, rules = game.map, game.rules
    half_width = rules.beam_width_cells // 2
    rim = max(1, rules.window_rows - 1, rules.window_columns // 2, half_width)
    stride = board.width + 2 * rim

    def cells(places: tuple[tuple[int, ...], ...]) -> list[int]:
        return [(place[0] + rim) * stride + place[1] + rim for place in places]

    paints = np.array(
        [r | g << 8 | b << 16 | k << CLASS_SHIFT for k, (r, g, b) in enumerate(COLOURS)], np.int32
    )
    background = np.full((board.height + 2 * rim, stride), paints[WALL], np.int32)
    background[rim:-rim, rim:-rim] = paints[GROUND]
    background.reshape(-1)[cells(board.walls)] = paints[WALL]
    site_at = np.full(background.size, -1, np.int32)
    site_at[cells(board.sites)] = range(len(board.sites))
    near = neighbours(board, rules)
    most_near = max(map(len, near))
    probs = [rules.regrow_prob[min(n, len(rules.regrow_prob) - 1)] for n in range(most_near + 1)]
    below = np.array([threshold(p) for p in probs], np.int64)
    freeze = rules.freeze_steps if isinstance(rules.freeze_steps, tuple) else ((rules.freeze_steps,),)
    sites = len(board.sites)
    starts = np.array(board.starts, np.int32).T.copy()
    return Tables(
        background=background.reshape(-1),
        site_cell=np.array(cells(board.sites), np.uint32),
        site_at=site_at,
        near_first=np.cumsum([0, *map(len, near)], dtype=np.int32),
        near_sites=np.array([site for sites in near for site in sites], np.uint32),
        regrow_below=below,
        regrow_first_byte=((below - 1) >> REST_BITS).astype(np.int32),
        start_row=starts[0],
        start_col=starts[1],
        start_heading=starts[2],
        beam_length=np.array(rules.beam_lengths_cells, np.int32),
        freeze=np.broadcast_to(np.array(freeze, np.int32), (game.agents, len(freeze[0]))).copy(),
        may_fire=np.broadcast_to(np.array(rules.may_fire), (game.agents,)).copy(),
        may_bite=np.broadcast_to(
            np.array(True if rules.may_bite is None else rules.may_bite), (game.agents, sites)
        ).copy(),
        paints=paints,
        window_cells=_window_cells(rules, stride),
        rim=rim,
        stride=stride,
        beam_half_width=half_width,
        hits_to_tag=int(rules.hits_to_tag),
        episode_steps=int(rules.episode_steps),
        has_beam=rules.has_beam,
        never_from_nothing=rules.regrow_prob[0] == 0,
        pairwise_clashes=rules.pairwise_clashes,
        regrow_before_bites=rules.regrow_before_bites,
        freeze_counts_tag_turn=rules.freeze_counts_tag_turn,
        ends_one_turn_late=rules.ends_one_turn_late,
        picture_shows_old_stock=rules.picture_shows_old_stock,
        paint_over=rules.paint_over,
        mark_behind_if_vertical=rules.mark_behind_if_vertical,
        self_paint_stays=rules.self_paint_stays,
    )
