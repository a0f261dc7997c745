"""What an agent does with its action: walk, turn, fire, clean, signal, on one world."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cprl.commons.beam import note_shot
from cprl.commons.moves import (
    FIRE,
    IN_TURN,
    TURN_LEFT,
    TURN_RIGHT,
    WALK_TURN,
    draw_order,
    go_back,
    shares_a_cell,
    walk,
    without_signal,
)
from cprl.commons.river import aim_to_clean, is_cleaning
from cprl.values.arrays import Int64

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds
    from cprl.institutions import Law


def act(world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch) -> None:
    """Let each agent in play turn, fire or move; clashing moves are cancelled later, under "in_turn" at once.
    `actions`: int64 [N].

    No agent moves onto a wall or off the board. An agent that may not fire does not, and has to wait as if it
    had.
    """
    if tables.clashes == IN_TURN:
        draw_order(world, scratch)
    for n in range(world.row.shape[0]):
        i = scratch.order[n] if tables.clashes == IN_TURN else n
        act_one(world, tables, actions, scratch, i)
        if tables.clashes == IN_TURN and world.in_play[i] and shares_a_cell(world, i):
            go_back(world, scratch, i)
    for i in range(world.row.shape[0]):
        if law is not None:
            world.fired[i] = world.fired[i] and law.sanctioner.may_fire[i]
        if world.fired[i] or is_cleaning(world.groups.river, i):
            note_shot(world, i)


def act_one(world: Worlds, tables: Tables, actions: Int64, scratch: Scratch, i: int) -> None:
    """Let agent i act, if it is in play."""
    scratch.start_row[i] = world.row[i]
    scratch.start_col[i] = world.col[i]
    world.fired[i] = False
    action = without_signal(tables, actions[i])
    if tables.signals > 0:
        world.signal[i] = actions[i] // tables.silent_actions if world.in_play[i] else 0
    aim_to_clean(world.groups.river, i, world.in_play[i], action)
    if not world.in_play[i]:
        return
    is_hot = tables.cooldown_steps > 0 and world.cooldown[i] > 0
    if is_hot:
        world.cooldown[i] -= 1
    if action < TURN_LEFT:
        walk(world, tables, i, (world.heading[i] + WALK_TURN[action]) % 4)
    elif action == TURN_LEFT:
        world.heading[i] = (world.heading[i] + 3) % 4
    elif action == TURN_RIGHT:
        world.heading[i] = (world.heading[i] + 1) % 4
    elif action == FIRE and tables.has_beam and not is_hot:
        world.fired[i] = True
        if tables.cooldown_steps > 0:
            world.cooldown[i] = tables.cooldown_steps
