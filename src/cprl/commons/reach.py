"""Whether any agent can walk to an apple site that it may harvest: a drawn wall may part them by mistake."""

from collections.abc import Sequence

import numpy as np

from cprl.commons.maps import Map
from cprl.institutions import Institution

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
    allowed = np.array(
        [
            [all(rule.may_harvest(agent, *site) for rule in institutions) for site in board.sites]
            for agent in range(board.agents)
        ]
    )
    if not board.walls and allowed.all():
        return None
    from scipy.ndimage import label

    is_open = np.ones((board.height, board.width), np.bool_)
    for wall in board.walls:
        is_open[wall] = False
    part = label(is_open)[0]  # the number of the part of the board around each cell that walls enclose
    starts = [(row, col) for row, col, _ in board.starts]
    begins = [board.spawns if start in board.spawns else (start,) for start in starts]
    of_sites = np.array([part[site] for site in board.sites])
    walks = np.array([np.isin(of_sites, [part[cell] for cell in cells]) for cells in begins])
    if shuffle_starts:
        walks[:] = walks.any(0)
    if (allowed & walks).any():
        return None
    named = "; ".join(f"row {row}, column {col}" for row, col in starts[:_STARTS_NAMED])
    more = "; ..." if len(starts) > _STARTS_NAMED else ""
    what = "walls keep" if allowed.all() else "walls and Boundaries keep"
    return (
        f"no agent can harvest any of the {len(board.sites)} sites of Game.map: {what} them out of reach of "
        f"all starts ({named}{more})"
    )
