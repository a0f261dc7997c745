"""River: a group of rules about waste in a river, which keeps apples from growing until agents clean it.

The rules work on one world. [C] is the game cleanup of the program sequential_social_dilemma_games, see
`docs/games.md`. A game without a river is compiled without the code of this group.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import numpy as np

from cprl.commons.beam import beam_begin, beam_cell, beam_end
from cprl.commons.cells import WALL
from cprl.commons.chance import POLLUTION, Probability, draw
from cprl.commons.moves import cell_of, draw_order
from cprl.institutions.arrays import DERIVED, IN_STATE, InState
from cprl.institutions.institution import threshold
from cprl.values import Range, Value
from cprl.values.array_types import Bool, Float32, Int32, Int64, UInt8, UInt32

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds

CLEAN: Final = "clean"
"""The name of a further action, the last one, in games whose agents may clean."""


@dataclass(frozen=True, kw_only=True)
class River(Value):
    """The rules of a board with a river (`Map.river`): how waste appears, slows the growth of apples, and is
    cleaned."""

    may_clean: bool = False
    """Whether agents may clean the river [C], by a further action "clean".

    This fires a cleaning beam of the same size as the beam that tags. Each of its columns removes the waste
    of the first cell with waste, and ends there, at a wall or at an agent. The picture shows the whole beam
    up to walls, like the other beam: also beyond waste, and beyond agents unless
    `Rules.beam_stops_at_agents`."""

    pollution_prob: Probability = 0.0
    """The probability per turn with which a clean cell of the river gets waste [C]. The cells are tried one
    by one, in an order drawn by chance, until one gets waste; so at most one cell per turn does."""

    pollution_limit: Annotated[float, Range(0, 1)] = 0.4
    """The share of river cells with waste at and above which no apple grows and no more waste appears [C]."""

    pollution_free: Annotated[float, Range(0, 1)] = 0.0
    """The share of river cells with waste up to which apples grow with `Rules.regrow_prob` [C]. From there
    the probability of growth falls linearly, to 0 at `pollution_limit`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pollution_free >= self.pollution_limit:
            raise ValueError(
                f"River.pollution_free is {self.pollution_free} and River.pollution_limit is "
                f"{self.pollution_limit}; allowed: a smaller share of waste than that"
            )


class RiverArrays(NamedTuple):
    """The river of a game, which has R cells, and its state in each world."""

    board_cell: Annotated[UInt32, "R"]
    """The index on the board of each cell of the river; cells as in `cprl.commons.tables.Tables`."""
    river_cell_at: Annotated[Int32, "cells"]
    """The index in the river of each cell of the board, or -1."""
    first_waste: Annotated[UInt8, "R"]
    """1 where a cell of the river has waste when an episode begins."""
    pollute_below: Annotated[Int64, "counts"]
    """Thresholds [R + 1], by the number of clean cells: one of them gets waste if a uniform 32-bit word is
    below the threshold."""
    pollution_limit: float
    pollution_free: float
    clean_number: int
    """The index of the action "clean"; -1 if agents may not clean."""
    waste: Annotated[UInt8, "B R", InState(high=1, cleared=False)]
    """1 where a cell of the river has waste."""
    waste_left: Annotated[Int32, "B 1", DERIVED]
    """The sum of `waste`."""
    cleans: Annotated[Bool, "B N", IN_STATE]
    """True for agents that cleaned in the last turn."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `RiverArrays` by name."""
    river = game.rules.river
    cells = [cell_of(row, col, game.tables) for row, col in game.map.river]
    river_index = np.full(game.tables.background.size, -1)
    river_index[cells] = range(len(cells))
    stays_clean_prob = 1 - river.pollution_prob
    return {
        "board_cell": cells,
        "river_cell_at": river_index,
        "first_waste": np.isin(np.arange(len(cells)), game.map.waste),
        "pollute_below": [threshold(1 - stays_clean_prob**count) for count in range(len(cells) + 1)],
        "pollution_limit": river.pollution_limit,
        "pollution_free": river.pollution_free,
        "clean_number": game.rules.actions.index(CLEAN) if river.may_clean else -1,
    }


def begin_river(river: RiverArrays | None) -> None:
    """Begin an episode: put waste on the cells that the map gives waste, and clear what agents cleaned."""
    if river is not None:
        for river_cell in range(river.waste.shape[0]):
            river.waste[river_cell] = river.first_waste[river_cell]
        for agent in range(river.cleans.shape[0]):
            river.cleans[agent] = False
        count_waste(river)


def count_waste(river: RiverArrays | None) -> None:
    """Count the cells with waste."""
    if river is not None:
        river.waste_left[0] = 0
        for river_cell in range(river.waste.shape[0]):
            river.waste_left[0] += river.waste[river_cell]


def aim_to_clean(river: RiverArrays | None, agent: int, is_in_play: bool, action: int) -> None:
    """Note whether an agent cleans in this turn by its action."""
    if river is not None:
        river.cleans[agent] = is_in_play and action == river.clean_number


def is_cleaning(river: RiverArrays | None, agent: int) -> bool:
    """Return whether an agent cleaned by its latest action."""
    return river is not None and river.cleans[agent]


def clean(
    world: "Worlds", tables: "Tables", river: RiverArrays | None, scratch: "Scratch", cleaned: Float32
) -> None:
    """Let the agents that clean fire their beams one after another, in an order drawn by chance.

    Write the number of cells that each agent cleaned to `cleaned`, float32 [N].
    """
    if river is not None:
        draw_order(world, scratch)
        for position in range(world.row.shape[0]):
            agent = scratch.order[position]
            cleaned[agent] = 0.0
            if river.cleans[agent]:
                for side in range(-tables.beam_half_width, tables.beam_half_width + 1):
                    cleaned[agent] += clean_column(world, tables, river, agent, side)


def clean_column(world: "Worlds", tables: "Tables", river: RiverArrays, cleaner: int, side: int) -> int:
    """Clean the first cell with waste in a column of an agent's beam; return the number of cells cleaned.

    The column ends at this cell, at a wall or at an agent, so the number is 0 or 1.
    """
    for ahead in range(beam_begin(tables, side), beam_end(world, tables, cleaner, side) + 1):
        cell = beam_cell(world, tables, cleaner, ahead, side)
        if tables.background[cell] == tables.paints[WALL]:
            return 0
        river_cell = river.river_cell_at[cell]
        if river_cell >= 0 and river.waste[river_cell] == 1:
            river.waste[river_cell] = 0
            river.waste_left[0] -= 1
            return 1
        for agent in range(world.row.shape[0]):
            if world.in_play[agent] and cell_of(world.row[agent], world.col[agent], tables) == cell:
                return 0
    return 0


def write_waste(river: RiverArrays | None, waste: Int64) -> None:
    """Write the number of cells with waste; `waste`: int64 [1]."""
    if river is not None:
        waste[0] = river.waste_left[0]


def growth_share(river: RiverArrays | None) -> float:
    """Return the factor, 0..1, by which the waste in the river reduces the growth of apples."""
    if river is None:
        return 1.0
    share = river.waste_left[0] / max(1, river.waste.shape[0])
    if share >= river.pollution_limit:
        return 0.0
    return min(1.0, (river.pollution_limit - share) / (river.pollution_limit - river.pollution_free))


def reduced_threshold(below: int, river: RiverArrays | None) -> int:
    """Return the threshold `below` of a site's growth, reduced by the waste in the river."""
    if river is None:
        return below
    return int(below * growth_share(river))


def pollute(world: "Worlds", river: RiverArrays | None) -> None:
    """Put waste on one clean cell of the river or on none, by chance; all clean cells are equally likely."""
    if river is None:
        return
    cells = river.waste.shape[0]
    clean_cells = cells - river.waste_left[0]
    words = draw(world, POLLUTION)
    if growth_share(river) == 0.0 or np.int64(words[0]) >= river.pollute_below[clean_cells]:
        return
    cells_to_skip = np.int64(words[1] % np.uint64(clean_cells))
    for river_cell in range(cells):
        if river.waste[river_cell] == 0:
            if cells_to_skip == 0:
                river.waste[river_cell] = 1
                river.waste_left[0] += 1
            cells_to_skip -= 1
