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
    for agent in range(world.row.shape[0]):
        scratch.order[agent] = agent
    for last in range(world.row.shape[0] - 1, 0, -1):
        drawn = int(draw(world, ORDER | last)[0] % np.uint64(last + 1))
        scratch.order[last], scratch.order[drawn] = scratch.order[drawn], scratch.order[last]


def walk(world: Worlds, tables: Tables, agent: int, direction: int) -> None:
    """Move an agent by one cell in a direction, given as a heading, unless a wall is there."""
    row = world.row[agent] + ROW_STEP[direction]
    col = world.col[agent] + COL_STEP[direction]
    if not is_wall(row, col, tables):
        world.row[agent] = row
        world.col[agent] = col


def go_back(world: Worlds, scratch: Scratch, agent: int) -> None:
    """Move an agent back to the cell where it began the turn."""
    world.row[agent] = scratch.start_row[agent]
    world.col[agent] = scratch.start_col[agent]


def has_moved(world: Worlds, scratch: Scratch, agent: int) -> bool:
    """Return whether an agent has left the cell where it began the turn."""
    return world.row[agent] != scratch.start_row[agent] or world.col[agent] != scratch.start_col[agent]


def share_a_cell(world: Worlds, agent: int, other: int) -> bool:
    """Return whether two agents are on one cell."""
    return world.row[agent] == world.row[other] and world.col[agent] == world.col[other]


def have_swapped(world: Worlds, scratch: Scratch, agent: int, other: int) -> bool:
    """Return whether each of two agents is on the cell where the other began the turn."""
    return (
        world.row[agent] == scratch.start_row[other]
        and world.col[agent] == scratch.start_col[other]
        and world.row[other] == scratch.start_row[agent]
        and world.col[other] == scratch.start_col[agent]
    )


def clash(world: Worlds, scratch: Scratch, agent: int, other: int) -> bool:
    """Return whether the moves of two agents in play clash: they share a cell or have swapped."""
    return share_a_cell(world, agent, other) or have_swapped(world, scratch, agent, other)


def has_company(world: Worlds, agent: int) -> bool:
    """Return whether an agent shares its cell with another agent in play."""
    for other in range(world.row.shape[0]):
        if other != agent and world.in_play[other] and share_a_cell(world, agent, other):
            return True
    return False


def settle_clashes(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Undo moves that clash, as `Rules.clashes` says; under "in_turn" `apply_actions` undid them already."""
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
        for agent in range(world.row.shape[0]):
            scratch.blocked[agent] = (
                world.in_play[agent]
                and has_moved(world, scratch, agent)
                and (
                    loses_its_cell(world, scratch, agent)
                    if one_moves
                    else is_in_a_clash(world, scratch, agent)
                )
            )
            unsettled = unsettled or scratch.blocked[agent]
        for agent in range(world.row.shape[0]):
            if scratch.blocked[agent]:
                go_back(world, scratch, agent)


def loses_its_cell(world: Worlds, scratch: Scratch, agent: int) -> bool:
    """Return whether an agent, which has moved, has to go back.

    It has to if it swaps cells with another agent in play, if another agent stayed on its new cell, or if
    another one moved there and comes first in `scratch.order`.
    """
    for other in range(world.row.shape[0]):
        if other != agent and world.in_play[other]:
            is_first = not has_moved(world, scratch, other) or scratch.order[other] < scratch.order[agent]
            if have_swapped(world, scratch, agent, other) or (is_first and share_a_cell(world, agent, other)):
                return True
    return False


def is_in_a_clash(world: Worlds, scratch: Scratch, agent: int) -> bool:
    """Return whether an agent clashes with any agent in play."""
    for other in range(world.row.shape[0]):
        if other != agent and world.in_play[other] and clash(world, scratch, agent, other):
            return True
    return False


def settle_pairwise(world: Worlds, scratch: Scratch) -> None:
    """[run] Move both agents of a clash back, pair by pair by index, even onto a third agent."""
    for agent in range(world.row.shape[0]):
        for other in range(agent + 1, world.row.shape[0]):
            if world.in_play[agent] and world.in_play[other] and clash(world, scratch, agent, other):
                go_back(world, scratch, agent)
                go_back(world, scratch, other)


def count_down(world: Worlds) -> None:
    """Count this turn as missed for every agent out of play."""
    for agent in range(world.row.shape[0]):
        if world.out_steps[agent] > 0:
            world.out_steps[agent] -= 1


def return_to_play(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Bring the agents back into play that have missed all their turns.

    Each returns to its cell once that is free, or under `respawn_at_spawns` to a free spawn place. Agents
    that wait for the same cell return in the order in which they were tagged. Where clashes are settled
    "pairwise", no agent waits.
    """
    if tables.respawn_at_spawns:
        respawn(world, tables)
        return
    for agent in range(world.row.shape[0]):
        is_not_due = world.in_play[agent] or world.out_steps[agent] > 0
        scratch.blocked[agent] = is_not_due or (tables.clashes != PAIRWISE and has_to_wait(world, agent))
    for agent in range(world.row.shape[0]):
        if not scratch.blocked[agent]:
            world.in_play[agent] = True


def respawn(world: Worlds, tables: Tables) -> None:
    """Bring the agents that have missed all their turns back at spawn places, as long as places are free."""
    for agent in range(world.row.shape[0]):
        if not world.in_play[agent] and world.out_steps[agent] == 0:
            world.in_play[agent] = draw_place(world, tables, agent)


def has_to_wait(world: Worlds, agent: int) -> bool:
    """Return whether an agent, out of play, has to wait: its cell is taken, or another returns first."""
    for other in range(world.row.shape[0]):
        if other != agent and share_a_cell(world, agent, other):
            first_in_line = (
                world.out_steps[other] == 0 and world.tagged_step[other] < world.tagged_step[agent]
            )
            if world.in_play[other] or first_in_line:
                return True
    return False


def place_at_starts(world: Worlds, tables: Tables) -> None:
    """Put every agent in play at its start, with the heading of the map, and clear what it did before."""
    for agent in range(world.row.shape[0]):
        world.row[agent] = tables.start[agent, 0]
        world.col[agent] = tables.start[agent, 1]
        world.heading[agent] = tables.start[agent, 2]
        world.out_steps[agent] = 0
        world.in_play[agent] = True
        world.on_board[agent] = True
        world.fired[agent] = False
        world.shot_row[agent] = 0
        world.shot_col[agent] = 0
        world.shot_heading[agent] = 0
        world.cooldown[agent] = 0
        world.signal[agent] = 0
        world.hits[agent] = 0
        world.tagged_step[agent] = 0
        world.offences[agent] = 0
        world.harvested[agent] = 0


def shuffle_starts(world: Worlds) -> None:
    """Permute the agents' starts, all permutations equally likely (Durstenfeld, "Algorithm 235: Random
    permutation", 1964)."""
    for last in range(world.row.shape[0] - 1, 0, -1):
        word, _, _, _ = draw(world, STARTS | last)
        drawn = int(word % np.uint64(last + 1))
        world.row[last], world.row[drawn] = world.row[drawn], world.row[last]
        world.col[last], world.col[drawn] = world.col[drawn], world.col[last]
        world.heading[last], world.heading[drawn] = world.heading[drawn], world.heading[last]


def draw_starts(world: Worlds, tables: Tables) -> None:
    """Move each agent that starts at a spawn place to a spawn place drawn by chance, no two to the same.

    Under `random_headings` also draw the heading of every agent.
    """
    if tables.spawns.shape[0] == 0 and not tables.random_headings:
        return
    # Agents that still need a place are out of play, so that they block none.
    for agent in range(world.row.shape[0]):
        world.in_play[agent] = True
        for place in range(tables.spawns.shape[0]):
            if is_at(world, tables, agent, place):
                world.in_play[agent] = False
    for agent in range(world.row.shape[0]):
        if not world.in_play[agent]:
            world.in_play[agent] = draw_place(world, tables, agent)
        elif tables.random_headings:
            world.heading[agent] = draw(world, SPAWNS | agent)[1] % np.uint64(4)


def draw_place(world: Worlds, tables: Tables, agent: int) -> bool:
    """Put an agent, out of play, at a free spawn place, all equally likely; return whether one is free."""
    free_places = 0
    for place in range(tables.spawns.shape[0]):
        free_places += is_free(world, tables, place)
    if free_places == 0:
        return False
    words = draw(world, SPAWNS | agent)
    places_to_skip = np.int64(words[0] % np.uint64(free_places))
    for place in range(tables.spawns.shape[0]):
        if is_free(world, tables, place):
            if places_to_skip == 0:
                world.row[agent] = tables.spawns[place, 0]
                world.col[agent] = tables.spawns[place, 1]
            places_to_skip -= 1
    if tables.random_headings:
        world.heading[agent] = words[1] % np.uint64(4)
    return True


def is_free(world: Worlds, tables: Tables, place: int) -> bool:
    """Return whether no agent in play is at a spawn place."""
    for other in range(world.row.shape[0]):
        if world.in_play[other] and is_at(world, tables, other, place):
            return False
    return True


def is_at(world: Worlds, tables: Tables, agent: int, place: int) -> bool:
    """Return whether an agent is at a spawn place."""
    return world.row[agent] == tables.spawns[place, 0] and world.col[agent] == tables.spawns[place, 1]
