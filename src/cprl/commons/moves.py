"""Walking, clashes between agents that want the same cell, and the return to play, on one world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cprl.commons.cells import WALL
from cprl.commons.chance import ORDER, SPAWNS, STARTS, draw
from cprl.commons.headings import COL_STEP, ROW_STEP

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds

ALL_BACK, ONE_MOVES, IN_TURN, PAIRWISE = range(4)
"""The values of `Tables.clashes`, in the order of the words that `Rules.clashes` allows."""

WALK_TURN = (0, 2, 3, 1)
"""For each walk (forward, backward, left, right) the right turns by 90 degrees from the heading to its
direction."""

TURN_LEFT, TURN_RIGHT, FIRE = range(4, 7)
"""The actions after the four walks, by index."""


def cell_of(row: int, col: int, tables: Tables) -> int:
    """Return the index of a cell in tables and picture, which have a rim of wall around the board."""
    return (row + tables.rim) * tables.stride + col + tables.rim


def is_wall(row: int, col: int, tables: Tables) -> bool:
    """Return whether a cell is a wall; every cell outside the board is one."""
    return tables.background[cell_of(row, col, tables)] == tables.paints[WALL]


def draw_order(world: Worlds, scratch: Scratch) -> None:
    """Draw a permutation of the agents into `scratch.order`, all equally likely, as `shuffle_starts` does."""
    for i in range(world.row.shape[0]):
        scratch.order[i] = i
    for i in range(world.row.shape[0] - 1, 0, -1):
        j = int(draw(world, ORDER | i)[0] % np.uint64(i + 1))
        scratch.order[i], scratch.order[j] = scratch.order[j], scratch.order[i]


def walk(world: Worlds, tables: Tables, i: int, direction: int) -> None:
    """Move agent i by one cell in a direction, given as a heading, unless a wall is there."""
    row = world.row[i] + ROW_STEP[direction]
    col = world.col[i] + COL_STEP[direction]
    if not is_wall(row, col, tables):
        world.row[i] = row
        world.col[i] = col


def go_back(world: Worlds, scratch: Scratch, i: int) -> None:
    """Move agent i back to the cell where it began the turn."""
    world.row[i] = scratch.start_row[i]
    world.col[i] = scratch.start_col[i]


def has_moved(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Return whether agent i has left the cell where it began the turn."""
    return world.row[i] != scratch.start_row[i] or world.col[i] != scratch.start_col[i]


def share_a_cell(world: Worlds, i: int, j: int) -> bool:
    """Return whether two agents are on one cell."""
    return world.row[i] == world.row[j] and world.col[i] == world.col[j]


def have_swapped(world: Worlds, scratch: Scratch, i: int, j: int) -> bool:
    """Return whether each of two agents is on the cell where the other began the turn."""
    return (
        world.row[i] == scratch.start_row[j]
        and world.col[i] == scratch.start_col[j]
        and world.row[j] == scratch.start_row[i]
        and world.col[j] == scratch.start_col[i]
    )


def clash(world: Worlds, scratch: Scratch, i: int, j: int) -> bool:
    """Return whether the moves of two agents in play clash: they share a cell or have swapped."""
    return share_a_cell(world, i, j) or have_swapped(world, scratch, i, j)


def has_company(world: Worlds, i: int) -> bool:
    """Return whether agent i shares its cell with another agent in play."""
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j] and share_a_cell(world, i, j):
            return True
    return False


def settle_clashes(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Undo moves that clash, as `Rules.clashes` says; under "in_turn" `act` has undone them already."""
    if tables.clashes == PAIRWISE:
        settle_pairwise(world, scratch)
    elif tables.clashes != IN_TURN:
        settle_at_once(world, tables, scratch)


def settle_at_once(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Move all agents that moved into a clash back at once, and repeat this until no agents clash.

    Under "one_moves" one agent gets the cell and only the others go back. An agent that went back keeps its
    cell, which may cancel another move. So the result does not depend on the order of the agents, except for
    the order that "one_moves" draws by chance.
    """
    one_moves = tables.clashes == ONE_MOVES
    if one_moves:
        draw_order(world, scratch)
    unsettled = True
    while unsettled:
        unsettled = False
        for i in range(world.row.shape[0]):
            scratch.blocked[i] = (
                world.in_play[i]
                and has_moved(world, scratch, i)
                and (loses_its_cell(world, scratch, i) if one_moves else is_in_a_clash(world, scratch, i))
            )
            unsettled = unsettled or scratch.blocked[i]
        for i in range(world.row.shape[0]):
            if scratch.blocked[i]:
                go_back(world, scratch, i)


def loses_its_cell(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Return whether agent i, which has moved, has to go back.

    It has to if it swaps cells with another agent in play, if another agent stayed on its new cell, or if
    another one moved there and comes first in `scratch.order`.
    """
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j]:
            is_first = not has_moved(world, scratch, j) or scratch.order[j] < scratch.order[i]
            if have_swapped(world, scratch, i, j) or (is_first and share_a_cell(world, i, j)):
                return True
    return False


def is_in_a_clash(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Return whether agent i clashes with any agent in play."""
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j] and clash(world, scratch, i, j):
            return True
    return False


def settle_pairwise(world: Worlds, scratch: Scratch) -> None:
    """[run] Move both agents of a clash back, pair by pair by index, even onto a third agent."""
    for i in range(world.row.shape[0]):
        for j in range(i + 1, world.row.shape[0]):
            if world.in_play[i] and world.in_play[j] and clash(world, scratch, i, j):
                go_back(world, scratch, i)
                go_back(world, scratch, j)


def count_down(world: Worlds) -> None:
    """Count this turn as missed for every agent out of play."""
    for i in range(world.row.shape[0]):
        if world.out_steps[i] > 0:
            world.out_steps[i] -= 1


def return_to_play(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Bring the agents back into play that have missed all their turns.

    Each returns to its cell once that is free, or under `respawn_at_spawns` to a free spawn place. Agents
    that wait for the same cell return in the order in which they were tagged. Where clashes are settled
    "pairwise", no agent waits.
    """
    if tables.respawn_at_spawns:
        respawn(world, tables)
        return
    for i in range(world.row.shape[0]):
        is_not_due = world.in_play[i] or world.out_steps[i] > 0
        scratch.blocked[i] = is_not_due or (tables.clashes != PAIRWISE and has_to_wait(world, i))
    for i in range(world.row.shape[0]):
        if not scratch.blocked[i]:
            world.in_play[i] = True


def respawn(world: Worlds, tables: Tables) -> None:
    """Bring the agents that have missed all their turns back at spawn places, as long as places are free."""
    for i in range(world.row.shape[0]):
        if not world.in_play[i] and world.out_steps[i] == 0:
            world.in_play[i] = draw_place(world, tables, i)


def has_to_wait(world: Worlds, i: int) -> bool:
    """Return whether agent i, out of play, has to wait: its cell is taken, or another returns first."""
    for j in range(world.row.shape[0]):
        if j != i and share_a_cell(world, i, j):
            first_in_line = world.out_steps[j] == 0 and world.tagged_step[j] < world.tagged_step[i]
            if world.in_play[j] or first_in_line:
                return True
    return False


def place_at_starts(world: Worlds, tables: Tables) -> None:
    """Put every agent in play at its start, with the heading of the map, and clear what it did before."""
    for i in range(world.row.shape[0]):
        world.row[i] = tables.start[i, 0]
        world.col[i] = tables.start[i, 1]
        world.heading[i] = tables.start[i, 2]
        world.out_steps[i] = 0
        world.in_play[i] = True
        world.on_board[i] = True
        world.fired[i] = False
        world.shot_row[i] = 0
        world.shot_col[i] = 0
        world.shot_heading[i] = 0
        world.cooldown[i] = 0
        world.signal[i] = 0
        world.hits[i] = 0
        world.tagged_step[i] = 0
        world.offences[i] = 0
        world.harvested[i] = 0


def shuffle_starts(world: Worlds) -> None:
    """Permute the agents' starts, all permutations equally likely (Durstenfeld, "Algorithm 235: Random
    permutation", 1964)."""
    for i in range(world.row.shape[0] - 1, 0, -1):
        word, _, _, _ = draw(world, STARTS | i)
        j = int(word % np.uint64(i + 1))
        world.row[i], world.row[j] = world.row[j], world.row[i]
        world.col[i], world.col[j] = world.col[j], world.col[i]
        world.heading[i], world.heading[j] = world.heading[j], world.heading[i]


def draw_starts(world: Worlds, tables: Tables) -> None:
    """Move each agent that starts at a spawn place to a spawn place drawn by chance, no two to the same.

    Under `random_headings` also draw the heading of every agent.
    """
    if tables.spawns.shape[0] == 0 and not tables.random_headings:
        return
    # Agents that still need a place are out of play, so that they block none.
    for i in range(world.row.shape[0]):
        world.in_play[i] = True
        for s in range(tables.spawns.shape[0]):
            if is_at(world, tables, i, s):
                world.in_play[i] = False
    for i in range(world.row.shape[0]):
        if not world.in_play[i]:
            world.in_play[i] = draw_place(world, tables, i)
        elif tables.random_headings:
            world.heading[i] = draw(world, SPAWNS | i)[1] % np.uint64(4)


def draw_place(world: Worlds, tables: Tables, i: int) -> bool:
    """Put agent i, out of play, at a free spawn place, all equally likely; return whether one is free."""
    free_places = 0
    for s in range(tables.spawns.shape[0]):
        free_places += is_free(world, tables, s)
    if free_places == 0:
        return False
    words = draw(world, SPAWNS | i)
    places_to_skip = np.int64(words[0] % np.uint64(free_places))
    for s in range(tables.spawns.shape[0]):
        if is_free(world, tables, s):
            if places_to_skip == 0:
                world.row[i] = tables.spawns[s, 0]
                world.col[i] = tables.spawns[s, 1]
            places_to_skip -= 1
    if tables.random_headings:
        world.heading[i] = words[1] % np.uint64(4)
    return True


def is_free(world: Worlds, tables: Tables, s: int) -> bool:
    """Return whether no agent in play is at spawn place s."""
    for j in range(world.row.shape[0]):
        if world.in_play[j] and is_at(world, tables, j, s):
            return False
    return True


def is_at(world: Worlds, tables: Tables, i: int, s: int) -> bool:
    """Return whether agent i is at spawn place s."""
    return world.row[i] == tables.spawns[s, 0] and world.col[i] == tables.spawns[s, 1]
