"""The order of a turn and of an episode, on one world."""

import numpy as np

from cprl.commons.apples import bite, draw, fill, find_sprouts, grow, recount
from cprl.commons.beam import find_hits, tag
from cprl.commons.chance import STARTS
from cprl.commons.institution_turn import (
    begin_institutions,
    begin_turn,
    clear_turn,
    end_turn,
    hold_fire,
    pursue_violations,
    refresh_institutions,
    write_payments,
)
from cprl.commons.moves import (
    act,
    count_down,
    note_moved_shooters,
    place_at_starts,
    return_to_play,
    settle_clashes,
    settle_pairwise,
)
from cprl.commons.tables import Tables
from cprl.commons.views import draw_windows
from cprl.commons.world import PLAYING, TERMINATED, TRUNCATED, Actions, Scratch, StepOutput, Worlds
from cprl.institutions.memory import Law
from cprl.institutions.paying import collect_taxes, pay_monitor, recover


def play_turn(
    world: Worlds, tables: Tables, actions: Actions, output: StepOutput, law: Law | None, scratch: Scratch
) -> None:
    """Plays one turn; `actions`: int64 [N]. A world that has ended does not change and pays nothing.

    `law` is what institutions need; without any it is None, and Numba compiles nothing of what it asks for.
    """
    if world.ended[0] != PLAYING:
        clear_events(output)
        write_state(world, tables, output, scratch)
        if law is not None:
            clear_turn(law.memory)
            write_payments(world, tables, law, output)
        return
    began_empty = world.stock_left[0] == 0
    keep_old_stock(world, tables)
    world.step[0] += 1
    if law is not None:
        begin_turn(world, law)
    count_down(world)
    act(world, tables, actions, scratch)
    if law is not None:
        hold_fire(world, law.memory)
    if tables.pairwise_clashes:
        settle_pairwise(world, scratch)
    else:
        settle_clashes(world, scratch)
    note_moved_shooters(world, tables, scratch)
    sprouts = find_sprouts(world, tables, scratch)
    if tables.regrow_before_bites:
        grow(world, tables, scratch, sprouts)
        bite(world, tables, law, output.harvest)
    else:
        bite(world, tables, law, output.harvest)
        grow(world, tables, scratch, sprouts)
    output.regrown[0] = sprouts
    find_hits(world, tables, output.hit_by)
    tag(world, tables, law, output.hit_by, output.tagged_by)
    if law is not None:
        pursue_violations(world, tables, law)
        recover(law.memory, law.rules, world.step[0])
    check_end(world, tables, began_empty)
    if law is not None:
        pay_monitor(law.memory, law.rules)
        collect_taxes(law.memory, law.rules, world.step[0], world.ended[0] != PLAYING)
    for i in range(world.row.shape[0]):
        output.fired[i] = world.fired[i]
        world.on_board[i] = world.in_play[i]
    return_to_play(world, tables, scratch)
    write_state(world, tables, output, scratch)
    if law is not None:
        end_turn(world, law, scratch, sprouts)
        write_payments(world, tables, law, output)


def shuffle_starts(world: Worlds) -> None:
    """Permutes the agents' starts, all permutations equally likely (Durstenfeld, "Algorithm 235: Random
    permutation", 1964)."""
    for i in range(world.row.shape[0] - 1, 0, -1):
        word, _, _, _ = draw(world, STARTS | i)
        j = int(word % np.uint64(i + 1))
        world.row[i], world.row[j] = world.row[j], world.row[i]
        world.col[i], world.col[j] = world.col[j], world.col[i]
        world.heading[i], world.heading[j] = world.heading[j], world.heading[i]


def begin_episode(
    world: Worlds, tables: Tables, output: StepOutput, law: Law | None, scratch: Scratch
) -> None:
    """Starts the next episode: all sites hold an apple, all agents are at their starts; institutions forget
    the last one, but for what votes put in force."""
    world.episode[0] += 1
    world.step[0] = 0
    world.ended[0] = PLAYING
    fill(world, tables)
    place_at_starts(world, tables)
    if tables.shuffle_starts:
        shuffle_starts(world)
    clear_events(output)
    write_state(world, tables, output, scratch)
    if law is not None:
        begin_institutions(world, law)
        write_payments(world, tables, law, output)


def refresh_output(
    world: Worlds, tables: Tables, output: StepOutput, law: Law | None, scratch: Scratch
) -> None:
    """Writes the output for a state that was set from outside, with no harvest, shots, hits, growth or
    payments."""
    recount(world, tables)
    clear_events(output)
    write_state(world, tables, output, scratch)
    if law is not None:
        refresh_institutions(world, law)
        write_payments(world, tables, law, output)


def keep_old_stock(world: Worlds, tables: Tables) -> None:
    """Copies the stock at the start of the turn, for `picture_shows_old_stock`."""
    if tables.picture_shows_old_stock:
        for k in range(world.stock.shape[0]):
            world.stock_before[k] = world.stock[k]


def check_end(world: Worlds, tables: Tables, began_empty: bool) -> None:
    """Ends the episode: TERMINATED if no apple is left and none can grow, else TRUNCATED if out of time."""
    is_empty = began_empty if tables.ends_one_turn_late else world.stock_left[0] == 0
    if is_empty and tables.never_from_nothing:
        world.ended[0] = TERMINATED
    elif world.step[0] >= tables.episode_steps:
        world.ended[0] = TRUNCATED


def clear_events(output: StepOutput) -> None:
    """Writes an output without harvest, shots, hits and growth."""
    agents = output.harvest.shape[0]
    for i in range(agents):
        output.harvest[i] = 0.0
        output.fired[i] = False
        for j in range(agents):
            output.hit_by[i, j] = False
            output.tagged_by[i, j] = False
    output.regrown[0] = 0


def write_state(world: Worlds, tables: Tables, output: StepOutput, scratch: Scratch) -> None:
    """Writes the current state and every agent's observation into the output."""
    for i in range(world.row.shape[0]):
        output.in_play[i] = world.in_play[i]
        for j in range(output.scoreboard.shape[1]):
            output.scoreboard[i, j] = world.harvested[(i + j) % world.row.shape[0]]
        if output.stock_gauge.shape[1] > 0:
            output.stock_gauge[i, 0] = world.stock_left[0] / world.stock.shape[0]
    output.stock[0] = world.stock_left[0]
    output.terminated[0] = world.ended[0] == TERMINATED
    output.truncated[0] = world.ended[0] == TRUNCATED
    output.done[0] = world.ended[0] != PLAYING
    draw_windows(world, tables, scratch, output.observation)
