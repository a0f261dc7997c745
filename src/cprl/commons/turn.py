"""The order of events in a turn and an episode, with those of institutions, on one world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cprl.commons.actions import apply_actions
from cprl.commons.apples import fill, harvest_and_grow, recount
from cprl.commons.beam import find_hits, tag, take_out
from cprl.commons.chance import BALLOT, DETECTION, END, draw
from cprl.commons.moves import (
    count_down,
    draw_starts,
    place_at_starts,
    return_to_play,
    settle_clashes,
    shuffle_starts,
)
from cprl.commons.quirks import ends_late, keep_old_stock
from cprl.commons.river import begin_river, clean, count_waste, write_waste
from cprl.commons.signals import draw_signals
from cprl.commons.views import draw_institutions, draw_scores, draw_windows, has_apple_ahead
from cprl.commons.world import BEGIN, PLAY, PLAYING, REFRESH, TERMINATED, TRUNCATED
from cprl.institutions.hooks import forget_last_episode, open_turn, refresh_derived, settle_accounts
from cprl.institutions.ledger import charge, count_violation, forget_episode, forget_turn
from cprl.institutions.sanctioner import appoint
from cprl.institutions.sanctions import sanction_violation
from cprl.institutions.votes import has_governor, hold_ballot, is_due
from cprl.values.array_types import Int64

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, StepOutput, Worlds
    from cprl.institutions import Law


def run_world(
    world: Worlds,
    tables: Tables,
    task: int,
    actions: Int64,
    decisions: Int64,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
) -> None:
    """Do a task with a world, and write its output.

    Args:
        world: the state of the world, which is changed.
        tables: the game.
        task: PLAY a turn (a world whose episode has ended stays as it is), BEGIN the next episode, or
            REFRESH: write the output that belongs to a state that was set from outside.
        actions: int64 [N], read for PLAY.
        decisions: int64 [N], read for PLAY in the first turn of an episode.
        output: the output of the world, which is written.
        law: the arrays of institutions; None without any, and then Numba compiles no code that needs them.
        scratch: working memory.
    """
    if task == PLAY and world.ended[0] == PLAYING:
        play_turn(world, tables, actions, decisions, output, law, scratch)
    else:
        clear_events(world, law, output)
        if task == BEGIN:
            begin_episode(world, tables, law)
        elif task == REFRESH:
            recount(world, tables)
            count_waste(world.groups.river)
            refresh_institutions(world, law)
    write_state(world, tables, output, scratch)
    write_payments(world, tables, law, output)


def play_turn(
    world: Worlds,
    tables: Tables,
    actions: Int64,
    decisions: Int64,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
) -> None:
    """Play one turn; `actions` and `decisions`: int64 [N]."""
    began_empty = world.stock_left[0] == 0
    keep_old_stock(world, world.groups.quirks)
    world.step[0] += 1
    begin_turn(world, law, decisions)
    count_down(world)
    apply_actions(world, tables, law, actions, scratch)
    settle_clashes(world, tables, scratch)
    clean(world, tables, world.groups.river, scratch, output.cleaned)
    output.regrown[0] = harvest_and_grow(world, tables, law, actions, scratch, output.harvest)
    find_hits(world, tables, output.hit_by)
    tag(world, tables, law, output.hit_by, output.tagged_by)
    pursue_violations(world, law)
    check_end(world, tables, began_empty)
    end_turn(world, law)
    note_events(world, output)
    return_to_play(world, tables, scratch)
    keep_on_board(world)
    open_next_turn(world, law)


def begin_episode(world: Worlds, tables: Tables, law: Law | None) -> None:
    """Begin the next episode: put apples on sites and agents at their starts, as the rules say.

    Institutions forget the last episode, except for the results of votes.
    """
    world.episode[0] += 1
    world.step[0] = 0
    world.ended[0] = PLAYING
    fill(world, tables)
    begin_river(world.groups.river)
    place_at_starts(world, tables)
    if tables.shuffle_starts:
        shuffle_starts(world)
    draw_starts(world, tables)
    begin_institutions(world, law)


def check_end(world: Worlds, tables: Tables, began_empty: bool) -> None:
    """End the episode if it is over: TERMINATED if no apple is left and none can grow, TRUNCATED by time or
    chance.

    `began_empty`: whether the turn began without any apple.
    """
    is_empty = began_empty if ends_late(world.groups.quirks) else world.stock_left[0] == 0
    if is_empty and tables.never_from_nothing:
        world.ended[0] = TERMINATED
    elif world.step[0] >= tables.episode_steps or ends_by_chance(world, tables):
        world.ended[0] = TRUNCATED


def ends_by_chance(world: Worlds, tables: Tables) -> bool:
    """Return whether the episode ends by chance after this turn, see `RandomEnd`."""
    turns_since_first = world.step[0] - tables.end_from_step
    if tables.end_below == 0 or turns_since_first < 0 or turns_since_first % tables.end_every_steps > 0:
        return False
    return int(draw(world, END)[0]) < tables.end_below


def note_events(world: Worlds, output: StepOutput) -> None:
    """Write which agents fired, and note which are on the board."""
    for agent in range(world.row.shape[0]):
        output.fired[agent] = world.fired[agent]
        world.on_board[agent] = world.in_play[agent]


def keep_on_board(world: Worlds) -> None:
    """Keep agents on the board that were tagged in this turn but miss no turn, so that they are back in
    play."""
    for agent in range(world.row.shape[0]):
        if world.in_play[agent] and world.tagged_step[agent] == world.step[0]:
            world.on_board[agent] = True


def clear_events(world: Worlds, law: Law | None, output: StepOutput) -> None:
    """Write an output without events: no harvest, shot, hit, growth, fine or transfer."""
    agents = world.row.shape[0]
    for agent in range(agents):
        output.harvest[agent] = 0.0
        output.fired[agent] = False
        for shooter in range(agents):
            output.hit_by[agent, shooter] = False
            output.tagged_by[agent, shooter] = False
    for agent in range(output.cleaned.shape[0]):
        output.cleaned[agent] = 0.0
    output.regrown[0] = 0
    if law is not None:
        forget_turn(law.ledger)


def write_state(world: Worlds, tables: Tables, output: StepOutput, scratch: Scratch) -> None:
    """Write the current state, every agent's observation, and the rewards before institutions."""
    for agent in range(world.row.shape[0]):
        output.in_play[agent] = world.in_play[agent]
        output.reward[agent] = output.harvest[agent]
        if output.apple_ahead.shape[1] > 0:
            output.apple_ahead[agent, 0] = has_apple_ahead(world, tables, agent)
    output.stock[0] = world.stock_left[0]
    write_waste(world.groups.river, output.waste)
    output.terminated[0] = world.ended[0] == TERMINATED
    output.truncated[0] = world.ended[0] == TRUNCATED
    output.done[0] = world.ended[0] != PLAYING
    draw_windows(world, tables, scratch, output.observation)
    draw_signals(world, tables, world.groups.signals, scratch, output.observation)
    if tables.scoreboard_cells + tables.stock_gauge_cells > 0:
        draw_scores(world, tables, output.observation)


def begin_turn(world: Worlds, law: Law | None, decisions: Int64) -> None:
    """Clear what institutions noted in the last turn; in the first turn of an episode also hold the ballots.
    Open the windows of this turn again, if a ballot or a governor may have changed a rule.

    `decisions`: int64 [N].
    """
    if law is None:
        return
    forget_turn(law.ledger)
    if world.step[0] == 1:
        for ballot in range(law.votes.options.shape[0]):
            if is_due(law.votes, ballot, world.episode[0]):
                words = draw(world, BALLOT + ballot)
                hold_ballot(law.votes, law.ledger, ballot, decisions, words)
        appoint(law.sanctioner, law.ledger)
    if world.step[0] == 1 or has_governor(law.votes):
        open_turn(law, world.step[0], stock_share(world))


def end_turn(world: Worlds, law: Law | None) -> None:
    """Let institutions collect, pay and forgive at the end of a turn."""
    if law is not None:
        settle_accounts(law, world.step[0], world.ended[0] != PLAYING)


def open_next_turn(world: Worlds, law: Law | None) -> None:
    """Let institutions prepare the coming turn, e.g. open the windows of quotas."""
    if law is not None:
        open_turn(law, world.step[0] + 1, stock_share(world))


def begin_institutions(world: Worlds, law: Law | None) -> None:
    """Let institutions forget the last episode, except for the results of votes.

    Before the first vote of a world, the first choice of each ballot is in force.
    """
    if law is None:
        return
    forget_episode(law.ledger)
    forget_last_episode(law)
    if world.episode[0] == 0:
        for ballot in range(law.votes.options.shape[0]):
            law.ledger.in_force[ballot] = law.votes.choices[ballot, 0]
    refresh_institutions(world, law)
    open_turn(law, 1, stock_share(world))


def refresh_institutions(world: Worlds, law: Law | None) -> None:
    """Compute what institutions derive from the state of the world, and clear the events of a turn."""
    if law is not None:
        refresh_derived(law, world.stock)
        forget_turn(law.ledger)


def stock_share(world: Worlds) -> float:
    """Return the share of all sites that hold an apple, 0..1."""
    return world.stock_left[0] / world.stock.shape[0]


def pursue_violations(world: Worlds, law: Law | None) -> None:
    """Detect violations of this turn by chance; detected agents pay fines and may miss turns."""
    if law is None:
        return
    for agent in range(world.row.shape[0]):
        law.ledger.detected[agent] = False
        if count_violation(law.ledger, agent, world.step[0]):
            word = np.int64(draw(world, DETECTION + agent)[0])
            if word < law.monitoring.detected_below:
                charge(law.ledger, agent)
                steps = sanction_violation(law.sanctions, law.ledger, agent, world.step[0])
                if steps > 0:
                    take_out(world, agent, steps)


def write_payments(world: Worlds, tables: Tables, law: Law | None, output: StepOutput) -> None:
    """Write the fines, transfers and counts of institutions, the rewards after them, and what agents observe
    of institutions."""
    if law is None:
        return
    ledger = law.ledger
    if law.entries.shows_places or law.entries.entry.shape[0] > 0:
        draw_institutions(world, tables, law, output.observation)
    for agent in range(world.row.shape[0]):
        output.fines[agent] = ledger.fines[agent]
        output.transfers[agent] = ledger.transfers[agent]
        output.reward[agent] = output.harvest[agent] - ledger.fines[agent] + ledger.transfers[agent]
        output.violated[agent] = ledger.has_violated[agent]
        for count_index in range(ledger.counts.shape[1]):
            output.counts[agent, count_index] = ledger.counts[agent, count_index]
    for ballot in range(output.in_force.shape[0]):
        output.in_force[ballot] = ledger.in_force[ballot]
    for ballot in range(output.ballots_due.shape[0]):
        output.ballots_due[ballot] = world.step[0] == 0 and is_due(law.votes, ballot, world.episode[0])
