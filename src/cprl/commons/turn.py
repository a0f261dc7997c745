"""The order of a turn and of an episode, and what institutions do in them, on one world."""

import numpy as np

from cprl.commons.apples import bite, fill, find_sprouts, grow, recount
from cprl.commons.beam import find_hits, tag, take_out
from cprl.commons.chance import BALLOT, DETECTION, END, STARTS, draw
from cprl.commons.moves import (
    act,
    count_down,
    draw_starts,
    note_moved_shooters,
    place_at_starts,
    return_to_play,
    settle_clashes,
    settle_pairwise,
)
from cprl.commons.river import begin_river, clean, count_waste, pollute
from cprl.commons.tables import FURTHER, Tables
from cprl.commons.views import draw_institutions, draw_scores, draw_signals, draw_windows, has_apple_ahead
from cprl.commons.world import PLAYING, TERMINATED, TRUNCATED, Actions, Scratch, StepOutput, Worlds
from cprl.institutions import Law
from cprl.institutions.law import begin, note_growth, open_turn, refresh, settle
from cprl.institutions.ledger import charge, count_violation, forget_episode, forget_turn
from cprl.institutions.sanctioner import appoint
from cprl.institutions.sanctions import sanction_violation
from cprl.institutions.votes import hold_ballot, is_due


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
            forget_turn(law.ledger)
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
        hold_fire(world, law)
    if tables.pairwise_clashes:
        settle_pairwise(world, scratch)
    elif not (FURTHER and tables.moves_in_turn):
        settle_clashes(world, tables, scratch)
    note_moved_shooters(world, tables, scratch)
    if FURTHER and tables.regrow_after_bites:
        bite(world, tables, law, actions, output.harvest)
    if FURTHER and world.waste.shape[0] > 0:
        clean(world, tables, scratch, output.cleaned)
    sprouts = find_sprouts(world, tables, scratch)
    if FURTHER and world.waste.shape[0] > 0:
        pollute(world, tables)
    if tables.regrow_before_bites:
        grow(world, tables, scratch, sprouts)
    if not (FURTHER and tables.regrow_after_bites):
        bite(world, tables, law, actions, output.harvest)
    if not tables.regrow_before_bites:
        grow(world, tables, scratch, sprouts)
    output.regrown[0] = sprouts
    find_hits(world, tables, output.hit_by)
    tag(world, tables, law, output.hit_by, output.tagged_by)
    if law is not None:
        pursue_violations(world, tables, law)
    check_end(world, tables, began_empty)
    if law is not None:
        settle(law, world.step[0], world.ended[0] != PLAYING)
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
    """Starts the next episode: all sites hold an apple, all agents are at their starts, if the rules say
    nothing else; institutions forget the last one, but for what votes put in force."""
    world.episode[0] += 1
    world.step[0] = 0
    world.ended[0] = PLAYING
    fill(world, tables)
    if FURTHER:
        begin_river(world, tables)
    place_at_starts(world, tables)
    if tables.shuffle_starts:
        shuffle_starts(world)
    if FURTHER and (tables.spawns.shape[0] > 0 or tables.random_headings):
        draw_starts(world, tables)
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
    if FURTHER:
        count_waste(world)
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
    elif world.step[0] >= tables.episode_steps or (FURTHER and ends_by_chance(world, tables)):
        world.ended[0] = TRUNCATED


def ends_by_chance(world: Worlds, tables: Tables) -> bool:
    """Whether this turn is one after which an episode may end by chance, and it does."""
    later = world.step[0] - tables.end_from_step
    if tables.end_below == 0 or later < 0 or later % tables.end_every_steps > 0:
        return False
    return int(draw(world, END)[0]) < tables.end_below


def clear_events(output: StepOutput) -> None:
    """Writes an output without harvest, shots, hits and growth."""
    agents = output.harvest.shape[0]
    for i in range(agents):
        output.harvest[i] = 0.0
        output.fired[i] = False
        if FURTHER and output.cleaned.shape[0] > 0:
            output.cleaned[i] = 0.0
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
        if output.apple_ahead.shape[1] > 0:
            output.apple_ahead[i, 0] = has_apple_ahead(world, tables, i)
    output.stock[0] = world.stock_left[0]
    if FURTHER and output.waste.shape[0] > 0:
        output.waste[0] = world.waste_left[0]
    output.terminated[0] = world.ended[0] == TERMINATED
    output.truncated[0] = world.ended[0] == TRUNCATED
    output.done[0] = world.ended[0] != PLAYING
    draw_windows(world, tables, scratch, output.observation)
    if FURTHER and tables.signals > 0:
        draw_signals(world, tables, scratch, output.observation)
    if FURTHER and tables.scoreboard_cells + tables.stock_gauge_cells > 0:
        draw_scores(world, tables, output.observation)


def begin_turn(world: Worlds, law: Law) -> None:
    """Clears the notes of the last turn; in the first one of an episode agents decide, and windows open."""
    forget_turn(law.ledger)
    if world.step[0] == 1:
        for ballot in range(law.votes.options.shape[0]):
            if is_due(law.votes, ballot, world.episode[0]):
                words = draw(world, BALLOT + ballot)
                hold_ballot(law.votes, law.ledger, ballot, law.decisions, words)
        appoint(law.sanctioner, law.ledger)
        open_turn(law, 1, stock_share(world))


def hold_fire(world: Worlds, law: Law) -> None:
    """Takes back the shots of agents that may not fire."""
    for i in range(world.row.shape[0]):
        world.fired[i] = world.fired[i] and law.sanctioner.may_fire[i]


def end_turn(world: Worlds, law: Law, scratch: Scratch, sprouts: int) -> None:
    """Begins what begins with the coming turn; `sprouts`: apples grown."""
    for s in range(sprouts):
        note_growth(law, scratch.sprouts[s])
    open_turn(law, world.step[0] + 1, stock_share(world))


def begin_institutions(world: Worlds, law: Law) -> None:
    """Begins an episode: all is forgotten but what votes put in force. Before the first vote of a world, that
    is the first choice of each ballot."""
    forget_episode(law.ledger)
    begin(law)
    if world.episode[0] == 0:
        for ballot in range(law.votes.options.shape[0]):
            law.ledger.in_force[ballot] = law.votes.choices[ballot, 0]
    refresh_institutions(world, law)
    open_turn(law, 1, stock_share(world))


def refresh_institutions(world: Worlds, law: Law) -> None:
    """Writes what follows from the rest of the memory and from the stock, without events."""
    refresh(law, world.stock)
    forget_turn(law.ledger)


def stock_share(world: Worlds) -> float:
    """The share of all sites that hold an apple, 0..1."""
    return world.stock_left[0] / world.stock.shape[0]


def pursue_violations(world: Worlds, tables: Tables, law: Law) -> None:
    """Detects violations of this turn, or not, and lets those who are found out pay and miss turns."""
    for i in range(world.row.shape[0]):
        law.ledger.detected[i] = False
        if count_violation(law.ledger, i, world.step[0]):
            word = np.int64(draw(world, DETECTION + i)[0])
            if word < law.monitoring.detected_below:
                charge(law.ledger, i)
                steps = sanction_violation(law.sanctions, law.ledger, i, world.step[0])
                if steps > 0:
                    take_out(world, tables, i, steps)


def write_payments(world: Worlds, tables: Tables, law: Law, output: StepOutput) -> None:
    """Writes what institutions took, gave and counted in this turn, the reward, and what agents are shown."""
    ledger, payments = law.ledger, law.payments
    if law.entries.places or law.entries.what.shape[0] > 0:
        draw_institutions(world, tables, law, output.observation)
    for i in range(world.row.shape[0]):
        payments.fines[i] = ledger.fines[i]
        payments.transfers[i] = ledger.transfers[i]
        payments.reward[i] = output.harvest[i] - ledger.fines[i] + ledger.transfers[i]
        payments.violated[i] = ledger.broke[i]
        for count in range(ledger.counts.shape[1]):
            payments.counts[i, count] = ledger.counts[i, count]
    for ballot in range(payments.in_force.shape[0]):
        payments.in_force[ballot] = ledger.in_force[ballot]
        payments.ballots_due[ballot] = world.step[0] == 0 and is_due(law.votes, ballot, world.episode[0])
