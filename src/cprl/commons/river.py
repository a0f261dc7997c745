"""The river: the group of rules `River`, waste that keeps apples from growing and beams that clean it, on one
world.

[C] is cleanup of the program sequential_social_dilemma_games; see `docs/games.md`. A game without a river is
compiled without it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import numpy as np

from cprl.commons.beam import beam_begin, beam_cell, beam_end
from cprl.commons.cells import WALL
from cprl.commons.chance import POLLUTION, Probability, draw
from cprl.commons.moves import cell_of, draw_order
from cprl.institutions.arrays import DERIVED, STATE, Kept
from cprl.institutions.base import threshold
from cprl.values import Range, Value
from cprl.values.arrays import Bool, Float32, Int32, Int64, UInt8, UInt32

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds

CLEAN: Final = "clean"
"""A further action, the last one, of agents that may clean."""


@dataclass(frozen=True, kw_only=True)
class River(Value):
    """The rules of a board with a river, `Map.river`: waste comes, keeps apples from growing, and is
    cleaned."""

    may_clean: bool = False
    """[C] Whether agents may clean the river: a further action "clean", a beam of the size of the other one
    that removes the waste of the first cell of each column that has some, and ends there, at a wall or at an
    agent. The picture shows it up to walls, as the other one: also beyond waste, and beyond agents without
    `Rules.beam_stops_at_agents`."""

    pollution_prob: Probability = 0.0
    """[C] The probability per turn with which a clean cell of the river gets waste, tried cell by cell in an
    order drawn by chance until one gets some; so it is one cell a turn at most."""

    pollution_limit: Annotated[float, Range(0, 1)] = 0.4
    """[C] The share of the river's cells with waste from which on no apple grows, and no waste comes."""

    pollution_free: Annotated[float, Range(0, 1)] = 0.0
    """[C] The share up to which apples grow with `Rules.regrow_prob`; between the two it falls linearly to
    0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pollution_free >= self.pollution_limit:
            raise ValueError(
                f"River.pollution_free is {self.pollution_free} and River.pollution_limit is "
                f"{self.pollution_limit}; allowed: a smaller share of waste than that"
            )


class Arrays(NamedTuple):
    """The river of a game, of R cells, and what is remembered of it in its worlds."""

    cell: Annotated[UInt32, "R"]
    """The cell of each cell of the river; cells as in `cprl.commons.tables.Tables`."""
    at: Annotated[Int32, "cells"]
    """The index of each cell in the river, or -1."""
    first_waste: Annotated[UInt8, "R"]
    """1 where a cell of the river has waste when an episode begins."""
    pollute_below: Annotated[Int64, "counts"]
    """[R + 1], by the number of clean cells: one of them gets waste if a uniform 32-bit word is below this
    threshold."""
    limit: float
    free: float
    clean_number: int
    """The action that cleans; -1 where there is none."""
    waste: Annotated[UInt8, "B R", Kept(high=1, cleared=False)]
    """1 where a cell has waste."""
    waste_left: Annotated[Int32, "B 1", DERIVED]
    """The sum of `waste`."""
    cleans: Annotated[Bool, "B N", STATE]
    """Whether the agent cleaned in the last turn."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters among `Arrays`."""
    board, rules, tables = game.map, game.rules, game.tables
    cells = [cell_of(row, col, tables) for row, col in board.river]
    at = np.full(tables.background.size, -1)
    at[cells] = range(len(cells))
    prob = rules.river.pollution_prob
    return {
        "cell": cells,
        "at": at,
        "first_waste": np.isin(np.arange(len(cells)), board.waste),
        "pollute_below": [threshold(1 - (1 - prob) ** clean) for clean in range(len(cells) + 1)],
        "limit": rules.river.pollution_limit,
        "free": rules.river.pollution_free,
        "clean_number": rules.actions.index(CLEAN) if rules.river.may_clean else -1,
    }


def begin_river(river: Arrays | None) -> None:
    """Put waste on the cells that have some when an episode begins."""
    if river is not None:
        for r in range(river.waste.shape[0]):
            river.waste[r] = river.first_waste[r]
        for i in range(river.cleans.shape[0]):
            river.cleans[i] = False
        count_waste(river)


def count_waste(river: Arrays | None) -> None:
    """Recompute the number of cells with waste."""
    if river is not None:
        river.waste_left[0] = 0
        for r in range(river.waste.shape[0]):
            river.waste_left[0] += river.waste[r]


def aim_to_clean(river: Arrays | None, i: int, is_in_play: bool, action: int) -> None:
    """Note whether agent i cleans in this turn."""
    if river is not None:
        river.cleans[i] = is_in_play and action == river.clean_number


def is_cleaning(river: Arrays | None, i: int) -> bool:
    """Return whether agent i cleaned in the last turn."""
    return river is not None and river.cleans[i]


def clean(
    world: "Worlds", tables: "Tables", river: Arrays | None, scratch: "Scratch", cleaned: Float32
) -> None:
    """Let the agents that clean do so one after another, in an order drawn by chance; `cleaned`: float32 [N],
    cells cleaned."""
    if river is not None:
        draw_order(world, scratch)
        for n in range(world.row.shape[0]):
            i = scratch.order[n]
            cleaned[i] = 0.0
            if river.cleans[i]:
                for side in range(-tables.beam_half_width, tables.beam_half_width + 1):
                    cleaned[i] += clean_column(world, tables, river, i, side)


def clean_column(world: "Worlds", tables: "Tables", river: Arrays, i: int, side: int) -> int:
    """Clean the first cell with waste in a column of agent i's beam, which ends there, at a wall or at an
    agent; return the cells cleaned."""
    for ahead in range(beam_begin(tables, side), beam_end(world, tables, i, side) + 1):
        cell = beam_cell(world, tables, i, ahead, side)
        if tables.background[cell] == tables.paints[WALL]:
            return 0
        r = river.at[cell]
        if r >= 0 and river.waste[r] == 1:
            river.waste[r] = 0
            river.waste_left[0] -= 1
            return 1
        for j in range(world.row.shape[0]):
            if world.in_play[j] and cell_of(world.row[j], world.col[j], tables) == cell:
                return 0
    return 0


def write_waste(river: Arrays | None, waste: Int64) -> None:
    """Write the number of cells with waste; `waste`: int64 [1]."""
    if river is not None:
        waste[0] = river.waste_left[0]


def growth_share(river: Arrays | None) -> float:
    """Return what is left of the growth of apples at this share of waste, 0..1."""
    if river is None:
        return 1.0
    share = river.waste_left[0] / max(1, river.waste.shape[0])
    if share >= river.limit:
        return 0.0
    return min(1.0, (river.limit - share) / (river.limit - river.free))


def slowed(below: int, river: Arrays | None) -> int:
    """Return the threshold of a site's growth where waste slows it."""
    if river is None:
        return below
    return int(below * growth_share(river))


def pollute(world: "Worlds", river: Arrays | None) -> None:
    """Put waste on a clean cell of the river, or on none; all clean cells are equally likely."""
    if river is None:
        return
    cells = river.waste.shape[0]
    left = cells - river.waste_left[0]
    words = draw(world, POLLUTION)
    if growth_share(river) == 0.0 or np.int64(words[0]) >= river.pollute_below[left]:
        return
    place = np.int64(words[1] % np.uint64(left))
    for r in range(cells):
        if river.waste[r] == 0:
            if place == 0:
                river.waste[r] = 1
                river.waste_left[0] += 1
            place -= 1
