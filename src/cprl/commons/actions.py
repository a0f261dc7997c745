"""Apply the actions of agents: walk, turn, fire, clean, signal. The rules work on one world."""

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
    has_company,
    walk,
)
from cprl.commons.river import aim_to_clean, is_cleaning
from cprl.commons.signals import send_signal, without_signal
from cprl.values.array_types import Int64

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds
    from cprl.institutions import Law


def act(world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch) -> None:
    """Apply each agent's action to its position, heading and beam; `actions`: int64 [N].

    Under the clash rule "in_turn" agents act one after another, in an order drawn by chance, and a clashing
    move is undone immediately. Under the other rules `settle_clashes` undoes clashing moves afterwards. No
    agent moves onto a wall or off the board. An agent that an institution forbids to fire still starts its
    cooldown.
    """
    if tables.clashes == IN_TURN:
        draw_order(world, scratch)
    for turn_place in range(world.row.shape[0]):
        i = scratch.order[turn_place] if tables.clashes == IN_TURN else turn_place
        act_one(world, tables, law, actions, scratch, i)
        if world.fired[i] or is_cleaning(world.groups.river, i):
            note_shot(world, i)
        if tables.clashes == IN_TURN and world.in_play[i] and has_company(world, i):
            go_back(world, scratch, i)


def act_one(world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch, i: int) -> None:
    """Apply the action of agent i if it is in play, and note where it begins the turn."""
    scratch.start_row[i] = world.row[i]
    scratch.start_col[i] = world.col[i]
    world.fired[i] = False
    action = without_signal(actions[i], world.groups.signals)
    send_signal(world, world.groups.signals, i, actions[i])
    aim_to_clean(world.groups.river, i, world.in_play[i], action)
    if not world.in_play[i]:
        return
    in_cooldown = tables.cooldown_steps > 0 and world.cooldown[i] > 0
    if in_cooldown:
        world.cooldown[i] -= 1
    if action < TURN_LEFT:  # actions 0 to 3 walk, in the order of `WALK_TURN`
        walk(world, tables, i, (world.heading[i] + WALK_TURN[action]) % 4)
    elif action == TURN_LEFT:
        world.heading[i] = (world.heading[i] + 3) % 4  # three turns to the right
    elif action == TURN_RIGHT:
        world.heading[i] = (world.heading[i] + 1) % 4
    elif action == FIRE and tables.has_beam and not in_cooldown:
        world.fired[i] = law is None or law.sanctioner.may_fire[i]
        if tables.cooldown_steps > 0:
            world.cooldown[i] = tables.cooldown_steps
