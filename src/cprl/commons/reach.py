"""Whether any agent can walk to an apple site that it may harvest: a drawn wall may part them by mistake."""

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet

from cprl.commons.maps import Cell, Map
from cprl.commons.world import COL_STEP, ROW_STEP
from cprl.institutions import Boundaries, Institution
from cprl.institutions.boundaries import OPEN

_STARTS_NAMED = 3
"""The starts that a message names at most."""


def why_out_of_reach(
    board: Map, institutions: Sequence[Institution] = (), *, shuffle_starts: bool = False
) -> str | None:
    """A sentence that says why no agent can harvest any site of a map; None if one can. With `shuffle_starts`
    any agent may start at any start.

    Agents walk over all cells but walls, also through each other's, since others may move away. `Boundaries`
    without a fine stop bites, not steps.
    """
    stops = [
        boundaries
        for boundaries in institutions
        if isinstance(boundaries, Boundaries) and boundaries.bite_fine is None
    ]
    if not board.walls and not stops:
        return None
    starts, walls = [(row, col) for row, col, _ in board.starts], set(board.walls)
    if not stops:
        is_reached = _reaches(board, walls, starts, set(board.sites))
    else:
        is_reached = any(
            _reaches(board, walls, starts if shuffle_starts else [starts[agent]], _own(board, stops, agent))
            for agent in range(board.agents)
        )
    if is_reached:
        return None
    named = "; ".join(f"row {row}, column {col}" for row, col in starts[:_STARTS_NAMED])
    more = "; ..." if len(starts) > _STARTS_NAMED else ""
    what = "walls and Boundaries keep" if stops else "walls keep"
    return (
        f"no agent can harvest any of the {len(board.sites)} sites of Game.map: {what} them out of reach of "
        f"all starts ({named}{more})"
    )


def _own(board: Map, stops: Sequence[Boundaries], agent: int) -> set[Cell]:
    """The sites that an agent can harvest once it stands there."""
    return {
        (row, col)
        for row, col in board.sites
        if all(boundaries.regions[row][col] in OPEN + boundaries.signs_of(agent) for boundaries in stops)
    }


def _reaches(board: Map, walls: AbstractSet[Cell], starts: Iterable[Cell], wanted: AbstractSet[Cell]) -> bool:
    """Whether a walk from any of the starts ends on a wanted cell."""
    waiting = list(starts)
    seen = set(waiting)
    while waiting and wanted:
        following = []
        for row, col in waiting:
            if (row, col) in wanted:
                return True
            for row_step, col_step in zip(ROW_STEP, COL_STEP, strict=True):
                cell = row + row_step, col + col_step
                inside = 0 <= cell[0] < board.height and 0 <= cell[1] < board.width
                if inside and cell not in seen and cell not in walls:
                    seen.add(cell)
                    following.append(cell)
        waiting = following
    return False
