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


def apply_actions(world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch) -> None:
    """Apply each agent's action to its position, heading and beam; `actions`: int64 [N].

    Under the clash rule "in_turn" agents act one after another, in an order drawn by chance, and a clashing
    move is undone immediately. Under the other rules `settle_clashes` undoes clashing moves afterwards. No
    agent moves onto a wall or off the board. An agent that an institution forbids to fire still starts its
    cooldown.
    """
    if tables.clashes == IN_TURN:
        draw_order(world, scratch)
    for turn_place in range(world.row.shape[0]):
        agent = scratch.order[turn_place] if tables.clashes == IN_TURN else turn_place
        apply_action(world, tables, law, actions, scratch, agent)
        if world.fired[agent] or is_cleaning(world.groups.river, agent):
            note_shot(world, agent)
        if tables.clashes == IN_TURN and world.in_play[agent] and has_company(world, agent):
            go_back(world, scratch, agent)


def apply_action(
    world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch, agent: int
) -> None:
    """Apply the action of an agent if it is in play, and note where it begins the turn."""
    scratch.start_row[agent] = world.row[agent]
    scratch.start_col[agent] = world.col[agent]
    world.fired[agent] = False
    action = without_signal(actions[agent], world.groups.signals)
    send_signal(world, world.groups.signals, agent, actions[agent])
    aim_to_clean(world.groups.river, agent, world.in_play[agent], action)
    if not world.in_play[agent]:
        return
    in_cooldown = tables.cooldown_steps > 0 and world.cooldown[agent] > 0
    if in_cooldown:
        world.cooldown[agent] -= 1
    if action < TURN_LEFT:  # actions 0 to 3 walk, in the order of `WALK_TURN`
        walk(world, tables, agent, (world.heading[agent] + WALK_TURN[action]) % 4)
    elif action == TURN_LEFT:
        world.heading[agent] = (world.heading[agent] + 3) % 4  # three turns to the right
    elif action == TURN_RIGHT:
        world.heading[agent] = (world.heading[agent] + 1) % 4
    elif action == FIRE and tables.has_beam and not in_cooldown:
        world.fired[agent] = law is None or law.sanctioner.may_fire[agent]
        if tables.cooldown_steps > 0:
            world.cooldown[agent] = tables.cooldown_steps
