"""The order of a turn of a game with institutions, on one world.

The parts are those of `turn`; where institutions decide, this module asks their rules (`cprl.institutions`).

Institutions add planes to agents' observations, after the channels of cells. A plane "forbidden" is 255 on
the cells of the window where a bite of the agent would break a rule about places. Planes "institutions" hold
what `cprl.institutions.showing` lists, in 0..255: with S entries, cell n of the planes, row by row, shows
entry n modulo S. So a single entry fills a plane evenly, as is usual for numbers that convolutions read
beside a board.
"""

import numpy as np

from cprl.commons.apples import draw, find_sprouts, grow, remove_apple
from cprl.commons.beam import count_hit, find_hits, take_out, take_out_of_play
from cprl.commons.chance import BALLOT, DETECTION
from cprl.commons.moves import (
    act,
    cell_of,
    count_down,
    note_moved_shooters,
    return_to_play,
    settle_clashes,
    settle_pairwise,
)
from cprl.commons.tables import Tables
from cprl.commons.turn import (
    begin_episode,
    check_end,
    clear_events,
    keep_old_stock,
    refresh_output,
    write_state,
)
from cprl.commons.world import PLAYING, Actions, Bytes, Scratch, StepOutput, Worlds
from cprl.institutions.deciding import appoint, hold_ballot, is_due
from cprl.institutions.limits import (
    add_to_patch,
    close_patches,
    count_patches,
    is_known_forbidden,
    note_bite,
    note_step,
    open_windows,
    stops_bite,
)
from cprl.institutions.memory import SANCTIONS, InstitutionTables, Memory, Payments
from cprl.institutions.paying import (
    charge,
    collect_taxes,
    mediate,
    note_violation,
    offend,
    pay_monitor,
    recover,
    time_out,
)
from cprl.institutions.showing import shown_entry


def play_governed_turn(
    world: Worlds,
    memory: Memory,
    tables: Tables,
    rules: InstitutionTables,
    actions: Actions,
    decisions: Actions,
    output: StepOutput,
    payments: Payments,
    scratch: Scratch,
) -> None:
    """Plays one turn; `actions`, `decisions`: int64 [N]. See `cprl.commons.turn.play_turn`."""
    if world.ended[0] != PLAYING:
        clear_events(output)
        write_state(world, tables, output, scratch)
        clear_turn(memory)
        write_payments(world, memory, tables, rules, output, payments)
        return
    began_empty = world.stock_left[0] == 0
    keep_old_stock(world, tables)
    world.step[0] += 1
    clear_turn(memory)
    if world.step[0] == 1:
        decide(world, memory, rules, decisions)
        open_windows(memory, rules, 1, stock_share(world))
    count_down(world)
    act(world, tables, actions, scratch)
    for i in range(world.row.shape[0]):
        world.fired[i] = world.fired[i] and memory.may_fire[i]
    if tables.pairwise_clashes:
        settle_pairwise(world, scratch)
    else:
        settle_clashes(world, scratch)
    note_moved_shooters(world, tables, scratch)
    sprouts = find_sprouts(world, tables, scratch)
    if tables.regrow_before_bites:
        grow(world, tables, scratch, sprouts)
        bite_by_rules(world, memory, tables, rules, output)
    else:
        bite_by_rules(world, memory, tables, rules, output)
        grow(world, tables, scratch, sprouts)
    output.regrown[0] = sprouts
    find_hits(world, tables, output.hit_by)
    tag_by_rules(world, memory, tables, rules, output)
    pursue_violations(world, memory, tables, rules)
    recover(memory, rules, world.step[0])
    check_end(world, tables, began_empty)
    pay_monitor(memory, rules)
    collect_taxes(memory, rules, world.step[0], world.ended[0] != PLAYING)
    for i in range(world.row.shape[0]):
        output.fired[i] = world.fired[i]
        world.on_board[i] = world.in_play[i]
    return_to_play(world, tables, scratch)
    write_state(world, tables, output, scratch)
    open_windows(memory, rules, world.step[0] + 1, stock_share(world))
    for s in range(sprouts):
        add_to_patch(memory, rules, scratch.sprouts[s], 1)
    close_patches(memory, rules)
    write_payments(world, memory, tables, rules, output, payments)


def begin_governed_episode(
    world: Worlds,
    memory: Memory,
    tables: Tables,
    rules: InstitutionTables,
    output: StepOutput,
    payments: Payments,
    scratch: Scratch,
) -> None:
    """Starts the next episode; institutions forget the last one, but for what votes put in force."""
    begin_episode(world, tables, output, scratch)
    forget(memory)
    begin_ballots(world, memory, rules)
    appoint(memory, rules)
    open_windows(memory, rules, 1, stock_share(world))
    count_patches(memory, rules, world.stock)
    close_patches(memory, rules)
    clear_turn(memory)
    write_payments(world, memory, tables, rules, output, payments)


def refresh_governed_output(
    world: Worlds,
    memory: Memory,
    tables: Tables,
    rules: InstitutionTables,
    output: StepOutput,
    payments: Payments,
    scratch: Scratch,
) -> None:
    """Writes the output for a state that was set from outside, with no events and no payments."""
    refresh_output(world, tables, output, scratch)
    appoint(memory, rules)
    count_patches(memory, rules, world.stock)
    close_patches(memory, rules)
    clear_turn(memory)
    write_payments(world, memory, tables, rules, output, payments)


def stock_share(world: Worlds) -> float:
    """The share of all sites that hold an apple, 0..1."""
    return world.stock_left[0] / world.stock.shape[0]


def forget(memory: Memory) -> None:
    """Clears all that institutions remember of an episode."""
    for i in range(memory.level.shape[0]):
        memory.level[i] = 0
        memory.offence_step[i] = 0
        memory.violation_step[i] = 0
        memory.detected[i] = False
        for count in range(memory.counts.shape[1]):
            memory.counts[i, count] = 0
        for tax in range(memory.income.shape[0]):
            memory.income[tax, i] = 0.0


def begin_ballots(world: Worlds, memory: Memory, rules: InstitutionTables) -> None:
    """Before the first vote of a world, the first choice of each ballot is in force."""
    if world.episode[0] == 0:
        for ballot in range(rules.ballot_options.shape[0]):
            memory.in_force[ballot] = rules.ballot_choice[ballot, 0]


def clear_turn(memory: Memory) -> None:
    """Clears what institutions note within a turn."""
    for i in range(memory.broke.shape[0]):
        memory.sanctioned[i] = memory.counts[i, SANCTIONS] > 0
        memory.broke[i] = False
        memory.unjust[i] = False
        memory.due[i] = 0.0
        memory.fines[i] = 0.0
        memory.transfers[i] = 0.0


def decide(world: Worlds, memory: Memory, rules: InstitutionTables, decisions: Actions) -> None:
    """Holds the ballots that are due in this episode; `decisions`: int64 [N]."""
    for ballot in range(rules.ballot_options.shape[0]):
        if is_due(rules, ballot, world.episode[0]):
            hold_ballot(memory, rules, ballot, decisions, draw(world, BALLOT + ballot))
    appoint(memory, rules)


def bite_by_rules(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, output: StepOutput
) -> None:
    """Each agent in play harvests the apple on its cell, unless a rule stops it; notes what it breaks.

    Two agents share a cell only under `pairwise_clashes`: the lower index that may gets the apple.
    """
    for i in range(world.row.shape[0]):
        output.harvest[i] = 0.0
        if world.in_play[i]:
            cell = cell_of(world.row[i], world.col[i], tables)
            note_step(memory, rules, i, cell)
            k = tables.site_at[cell]
            if k >= 0 and world.stock[k] == 1 and not stops_bite(memory, rules, i, cell, k, world.step[0]):
                remove_apple(world, tables, k)
                output.harvest[i] = 1.0
                world.harvested[i] += 1
                note_bite(memory, rules, i, cell, k, world.step[0])


def tag_by_rules(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, output: StepOutput
) -> None:
    """Tags agents as `tag` does; time-outs and fines are those of institutions, unjust tags are refunded."""
    agents = world.row.shape[0]
    for i in range(agents):
        if count_hit(world, tables, output.hit_by, output.tagged_by, i):
            steps = tables.freeze_steps
            if rules.sanctions_tags:
                steps = 0
                for j in range(agents):
                    if output.tagged_by[i, j]:
                        steps = max(steps, time_out(memory, rules, j, i))
                offend(memory, rules, i, world.step[0])
            take_out_of_play(world, tables, i, steps)
    if rules.mediation_turns > 0:
        for i in range(agents):
            mediate(memory, rules, output.tagged_by, i, world.step[0])


def pursue_violations(world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables) -> None:
    """Detects violations of this turn, or not, and lets those who are found out pay and miss turns."""
    for i in range(world.row.shape[0]):
        memory.detected[i] = False
        if note_violation(memory, i, world.step[0]):
            word = np.int64(draw(world, DETECTION + i)[0])
            if word < rules.detected_below:
                charge(memory, i)
                if rules.sanctions_violations:
                    steps = time_out(memory, rules, i, i)
                    if steps > 0:
                        take_out(world, tables, i, steps)
                    offend(memory, rules, i, world.step[0])


def write_payments(
    world: Worlds,
    memory: Memory,
    tables: Tables,
    rules: InstitutionTables,
    output: StepOutput,
    payments: Payments,
) -> None:
    """Writes what institutions took, gave and counted in this turn, the reward, and what agents are shown."""
    draw_institutions(world, memory, tables, rules, output.observation)
    for i in range(world.row.shape[0]):
        payments.fines[i] = memory.fines[i]
        payments.transfers[i] = memory.transfers[i]
        payments.reward[i] = output.harvest[i] - memory.fines[i] + memory.transfers[i]
        payments.violated[i] = memory.broke[i]
        for count in range(memory.counts.shape[1]):
            payments.counts[i, count] = memory.counts[i, count]
    for ballot in range(payments.in_force.shape[0]):
        payments.in_force[ballot] = memory.in_force[ballot]
        payments.ballots_due[ballot] = world.step[0] == 0 and is_due(rules, ballot, world.episode[0])


HIGHEST = 255


def is_shown_forbidden(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, i: int, window_cell: int
) -> bool:
    """Whether agent i sees that a bite on a cell of its window would break a rule about places."""
    own = 0 if tables.sees_all else cell_of(world.row[i], world.col[i], tables)
    heading = world.heading[i]
    if tables.walls_block_sight and not tables.in_sight[own, heading, window_cell]:
        return False
    cell = own + tables.window_cells[heading, window_cell]
    return is_known_forbidden(memory, rules, i, cell, tables.site_at[cell])


def draw_forbidden(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, i: int, plane: Bytes
) -> None:
    """Draws where bites of agent i are forbidden; `plane`: uint8 [X * Y]."""
    for n in range(plane.shape[0]):
        plane[n] = HIGHEST if is_shown_forbidden(world, memory, tables, rules, i, n) else 0


def draw_entries(memory: Memory, rules: InstitutionTables, i: int, turn: int, planes: Bytes) -> None:
    """Writes the entries shown to agent i, each into every S-th cell; `planes`: uint8 [cells]."""
    entries = rules.shown_kind.shape[0]
    for entry in range(entries):
        level = shown_entry(memory, rules, i, entry, turn)
        value = int(HIGHEST * min(1.0, max(0.0, level)) + 0.5)
        for n in range(entry, planes.shape[0], entries):
            planes[n] = value


def draw_institutions(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, observation: Bytes
) -> None:
    """Writes what institutions show each agent; `observation`: uint8 [N, C, X, Y]."""
    cells = tables.window_cells.shape[1]
    for i in range(world.row.shape[0]):
        planes = observation[i].reshape(-1)
        first = cells * rules.first_plane
        if rules.shows_places:
            draw_forbidden(world, memory, tables, rules, i, planes[first : first + cells])
            first += cells
        if rules.shown_kind.shape[0] > 0:
            draw_entries(memory, rules, i, world.step[0], planes[first:])
