"""Turning, walking, and clashes between agents that want the same cell, on one world."""

import numpy as np

from cprl.commons.chance import ORDER, SPAWNS, draw
from cprl.commons.colours import WALL
from cprl.commons.tables import FURTHER, Tables
from cprl.commons.world import COL_STEP, ROW_STEP, Actions, Scratch, Worlds

WALK_TURN = (0, 2, 3, 1)
"""Right turns by 90 degrees from the heading to the direction of a walk: forward, backward, left, right."""

WALK_RIGHT, TURN_LEFT, TURN_RIGHT, FIRE = 3, 4, 5, 6


def cell_of(row: int, col: int, tables: Tables) -> int:
    """The index of a cell (row, col) in the tables and in the picture."""
    return (row + tables.rim) * tables.stride + col + tables.rim


def is_wall(row: int, col: int, tables: Tables) -> bool:
    """Whether a cell is a wall; every cell outside the board is one."""
    return tables.background[cell_of(row, col, tables)] == tables.paints[WALL]


def act(world: Worlds, tables: Tables, actions: Actions, scratch: Scratch) -> None:
    """Each agent in play turns, fires or moves; clashing moves are cancelled later, under "in_turn" at once.
    `actions`: int64 [N].

    No agent moves onto a wall or off the board.
    """
    if FURTHER and tables.moves_in_turn:
        act_in_turn(world, tables, actions, scratch)
        return
    for i in range(world.row.shape[0]):
        act_one(world, tables, actions, scratch, i)


def act_in_turn(world: Worlds, tables: Tables, actions: Actions, scratch: Scratch) -> None:
    """Agents act one after another; who came onto a cell where an agent is goes back."""
    draw_order(world, scratch)
    for n in range(world.row.shape[0]):
        i = scratch.order[n]
        act_one(world, tables, actions, scratch, i)
        if world.in_play[i] and shares_a_cell(world, i):
            go_back(world, scratch, i)


def act_one(world: Worlds, tables: Tables, actions: Actions, scratch: Scratch, i: int) -> None:
    """Agent i acts, if it is in play."""
    scratch.start_row[i] = world.row[i]
    scratch.start_col[i] = world.col[i]
    world.fired[i] = False
    action = without_signal(tables, actions[i])
    if FURTHER:
        world.signal[i] = actions[i] // tables.silent_actions if world.in_play[i] else 0
        world.cleans[i] = world.in_play[i] and action == tables.clean_number
    if not world.in_play[i]:
        return
    is_hot = FURTHER and world.cooldown[i] > 0
    if is_hot:
        world.cooldown[i] -= 1
    if action < TURN_LEFT:
        mover = moved_by(tables, i, action)
        walk(world, tables, mover, (world.heading[mover] + WALK_TURN[action]) % 4)
    elif action == TURN_LEFT:
        world.heading[i] = (world.heading[i] + 3) % 4
    elif action == TURN_RIGHT:
        world.heading[i] = (world.heading[i] + 1) % 4
    elif action == FIRE and tables.has_beam and not is_hot:
        world.fired[i] = True
        if FURTHER:
            world.cooldown[i] = tables.cooldown_steps


def without_signal(tables: Tables, action: int) -> int:
    """The action without the signal that is sent with it."""
    return action % tables.silent_actions if FURTHER else action


def draw_order(world: Worlds, scratch: Scratch) -> None:
    """Draws a permutation of the agents, all equally likely, into `scratch.order`; see `shuffle_starts`."""
    for i in range(world.row.shape[0]):
        scratch.order[i] = i
    for i in range(world.row.shape[0] - 1, 0, -1):
        j = int(draw(world, ORDER | i)[0] % np.uint64(i + 1))
        scratch.order[i], scratch.order[j] = scratch.order[j], scratch.order[i]


def moved_by(tables: Tables, i: int, action: int) -> int:
    """The agent that a walk of agent i moves: itself, or under `agent_1_right_moves_agent_0` another."""
    return 0 if tables.agent_1_right_moves_agent_0 and i == 1 and action == WALK_RIGHT else i


def walk(world: Worlds, tables: Tables, i: int, direction: int) -> None:
    """Moves agent i by one cell in a direction (a heading), unless a wall is there."""
    row = world.row[i] + ROW_STEP[direction]
    col = world.col[i] + COL_STEP[direction]
    if not is_wall(row, col, tables):
        world.row[i] = row
        world.col[i] = col


def go_back(world: Worlds, scratch: Scratch, i: int) -> None:
    """Moves agent i back to the cell where it began the turn."""
    world.row[i] = scratch.start_row[i]
    world.col[i] = scratch.start_col[i]


def has_moved(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Whether agent i is on another cell than at the start of the turn."""
    return world.row[i] != scratch.start_row[i] or world.col[i] != scratch.start_col[i]


def share_a_cell(world: Worlds, i: int, j: int) -> bool:
    """Whether two agents are on one cell."""
    return world.row[i] == world.row[j] and world.col[i] == world.col[j]


def have_swapped(world: Worlds, scratch: Scratch, i: int, j: int) -> bool:
    """Whether each of two agents is on the cell where the other began the turn."""
    return (
        world.row[i] == scratch.start_row[j]
        and world.col[i] == scratch.start_col[j]
        and world.row[j] == scratch.start_row[i]
        and world.col[j] == scratch.start_col[i]
    )


def clash(world: Worlds, scratch: Scratch, i: int, j: int) -> bool:
    """Whether the moves of two agents in play clash: they share a cell or have swapped."""
    return share_a_cell(world, i, j) or have_swapped(world, scratch, i, j)


def shares_a_cell(world: Worlds, i: int) -> bool:
    """Whether agent i is on one cell with another agent in play."""
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j] and share_a_cell(world, i, j):
            return True
    return False


def settle_clashes(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Moves all agents back, at once, that moved into a clash, or under "one_moves" those of them that lose
    their cell, and repeats this until no agents clash.

    An agent that went back keeps its cell, which may cancel another move. The result does not depend on the
    order of the agents, but for the order that "one_moves" draws by chance.
    """
    by_lot = FURTHER and tables.one_moves
    if by_lot:
        draw_order(world, scratch)
    unsettled = True
    while unsettled:
        unsettled = False
        for i in range(world.row.shape[0]):
            scratch.blocked[i] = (
                world.in_play[i]
                and has_moved(world, scratch, i)
                and (loses_its_cell(world, scratch, i) if by_lot else is_in_a_clash(world, scratch, i))
            )
            unsettled = unsettled or scratch.blocked[i]
        for i in range(world.row.shape[0]):
            if scratch.blocked[i]:
                go_back(world, scratch, i)


def loses_its_cell(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Whether agent i, which has moved, swaps cells with another agent in play, or loses its cell to one that
    stays there, or comes first in `scratch.order`."""
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j]:
            is_first = not has_moved(world, scratch, j) or scratch.order[j] < scratch.order[i]
            if have_swapped(world, scratch, i, j) or (is_first and share_a_cell(world, i, j)):
                return True
    return False


def is_in_a_clash(world: Worlds, scratch: Scratch, i: int) -> bool:
    """Whether agent i clashes with any agent in play."""
    for j in range(world.row.shape[0]):
        if j != i and world.in_play[j] and clash(world, scratch, i, j):
            return True
    return False


def settle_pairwise(world: Worlds, scratch: Scratch) -> None:
    """[run] Pair by pair in the order of indices, moves both clashing agents back, even onto a third one."""
    for i in range(world.row.shape[0]):
        for j in range(i + 1, world.row.shape[0]):
            if world.in_play[i] and world.in_play[j] and clash(world, scratch, i, j):
                go_back(world, scratch, i)
                go_back(world, scratch, j)


def note_moved_shooters(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Notes after all moves who no longer stands where it fired; no agent moves itself as it fires."""
    if tables.agent_1_right_moves_agent_0:
        for i in range(world.row.shape[0]):
            world.moved_after_firing[i] = world.fired[i] and has_moved(world, scratch, i)


def count_down(world: Worlds) -> None:
    """Counts this turn as missed for every agent out of play."""
    for i in range(world.row.shape[0]):
        if world.out_steps[i] > 0:
            world.out_steps[i] -= 1


def return_to_play(world: Worlds, tables: Tables, scratch: Scratch) -> None:
    """Returns agents to play that have no more turns to miss, if their cell is free; under
    `respawn_at_spawns` at a free spawn place.

    Agents that wait for the same cell return in the order in which they were tagged. Under `pairwise_clashes`
    no agent waits.
    """
    if FURTHER and tables.respawn_at_spawns:
        respawn(world, tables)
        return
    for i in range(world.row.shape[0]):
        is_not_due = world.in_play[i] or world.out_steps[i] > 0
        scratch.blocked[i] = is_not_due or (not tables.pairwise_clashes and has_to_wait(world, i))
    for i in range(world.row.shape[0]):
        if not scratch.blocked[i]:
            world.in_play[i] = True


def respawn(world: Worlds, tables: Tables) -> None:
    """Returns agents to play that have no more turns to miss, at free spawn places, as far as there are."""
    for i in range(world.row.shape[0]):
        if not world.in_play[i] and world.out_steps[i] == 0:
            world.in_play[i] = draw_place(world, tables, i)


def has_to_wait(world: Worlds, i: int) -> bool:
    """Whether agent i, out of play, has to wait: its cell is occupied, or another agent is first in line."""
    for j in range(world.row.shape[0]):
        if j != i and share_a_cell(world, i, j):
            first_in_line = world.out_steps[j] == 0 and world.tagged_step[j] < world.tagged_step[i]
            if world.in_play[j] or first_in_line:
                return True
    return False


def place_at_starts(world: Worlds, tables: Tables) -> None:
    """Puts every agent in play at its start, with the heading given by the map."""
    for i in range(world.row.shape[0]):
        world.row[i] = tables.start[i, 0]
        world.col[i] = tables.start[i, 1]
        world.heading[i] = tables.start[i, 2]
        world.out_steps[i] = 0
        world.in_play[i] = True
        world.on_board[i] = True
        world.fired[i] = False
        world.moved_after_firing[i] = False
        world.cooldown[i] = 0
        world.signal[i] = 0
        world.cleans[i] = False
        world.hits[i] = 0
        world.tagged_step[i] = 0
        world.offences[i] = 0
        world.harvested[i] = 0


def draw_starts(world: Worlds, tables: Tables) -> None:
    """Draws a spawn place for each agent whose start is one, no two the same, and under `random_headings` all
    headings."""
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
    """Puts agent i, out of play, at a spawn place where no agent in play is, all equally likely; returns
    whether there is one."""
    free = 0
    for s in range(tables.spawns.shape[0]):
        free += is_free(world, tables, s)
    if free == 0:
        return False
    words = draw(world, SPAWNS | i)
    place = np.int64(words[0] % np.uint64(free))
    for s in range(tables.spawns.shape[0]):
        if is_free(world, tables, s):
            if place == 0:
                world.row[i] = tables.spawns[s, 0]
                world.col[i] = tables.spawns[s, 1]
            place -= 1
    if tables.random_headings:
        world.heading[i] = words[1] % np.uint64(4)
    return True


def is_free(world: Worlds, tables: Tables, s: int) -> bool:
    """Whether no agent in play is at spawn place s."""
    for j in range(world.row.shape[0]):
        if world.in_play[j] and is_at(world, tables, j, s):
            return False
    return True


def is_at(world: Worlds, tables: Tables, i: int, s: int) -> bool:
    """Whether agent i is at spawn place s."""
    return world.row[i] == tables.spawns[s, 0] and world.col[i] == tables.spawns[s, 1]
