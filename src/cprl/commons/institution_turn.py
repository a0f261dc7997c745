"""What institutions do in a turn, on one world: `cprl.commons.turn` calls this, and it asks their rules in
`cprl.institutions`.

Institutions add planes to agents' observations, after the channels of cells. A plane "forbidden" is 255 on
the cells of the window where a bite of the agent would break a rule about places. Planes "institutions" hold
what `cprl.institutions.showing` lists, in 0..255: with S entries, cell n of the planes, row by row, shows
entry n modulo S. So a single entry fills a plane evenly, as is usual for numbers that convolutions read
beside a board.
"""

import numpy as np

from cprl.commons.apples import draw
from cprl.commons.beam import take_out
from cprl.commons.chance import BALLOT, DETECTION
from cprl.commons.moves import cell_of
from cprl.commons.tables import Tables
from cprl.commons.world import Bytes, Scratch, StepOutput, Worlds
from cprl.institutions.deciding import appoint, hold_ballot, is_due
from cprl.institutions.limits import (
    add_to_patch,
    close_patches,
    count_patches,
    is_known_forbidden,
    open_windows,
)
from cprl.institutions.memory import SANCTIONS, InstitutionTables, Law, Memory
from cprl.institutions.paying import charge, note_violation, offend, time_out
from cprl.institutions.showing import shown_entry


def begin_turn(world: Worlds, law: Law) -> None:
    """Clears the notes of the last turn; in the first one of an episode agents decide, and quotas begin."""
    clear_turn(law.memory)
    if world.step[0] == 1:
        decide(world, law)
        open_windows(law.memory, law.rules, 1, stock_share(world))


def hold_fire(world: Worlds, memory: Memory) -> None:
    """Takes back the shots of agents that may not fire."""
    for i in range(world.row.shape[0]):
        world.fired[i] = world.fired[i] and memory.may_fire[i]


def end_turn(world: Worlds, law: Law, scratch: Scratch, sprouts: int) -> None:
    """Writes what quotas allow and which patches are closed in the coming turn; `sprouts`: apples grown."""
    open_windows(law.memory, law.rules, world.step[0] + 1, stock_share(world))
    for s in range(sprouts):
        add_to_patch(law.memory, law.rules, scratch.sprouts[s], 1)
    close_patches(law.memory, law.rules)


def begin_institutions(world: Worlds, law: Law) -> None:
    """Begins an episode: all is forgotten but what votes put in force."""
    forget(law.memory)
    begin_ballots(world, law.memory, law.rules)
    open_windows(law.memory, law.rules, 1, stock_share(world))
    refresh_institutions(world, law)


def refresh_institutions(world: Worlds, law: Law) -> None:
    """Writes what follows from the rest of the memory and from the stock, without events."""
    appoint(law.memory, law.rules)
    count_patches(law.memory, law.rules, world.stock)
    close_patches(law.memory, law.rules)
    clear_turn(law.memory)


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


def decide(world: Worlds, law: Law) -> None:
    """Holds the ballots that are due in this episode."""
    for ballot in range(law.rules.ballot_options.shape[0]):
        if is_due(law.rules, ballot, world.episode[0]):
            hold_ballot(law.memory, law.rules, ballot, law.decisions, draw(world, BALLOT + ballot))
    appoint(law.memory, law.rules)


def pursue_violations(world: Worlds, tables: Tables, law: Law) -> None:
    """Detects violations of this turn, or not, and lets those who are found out pay and miss turns."""
    memory, rules = law.memory, law.rules
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


def write_payments(world: Worlds, tables: Tables, law: Law, output: StepOutput) -> None:
    """Writes what institutions took, gave and counted in this turn, the reward, and what agents are shown."""
    memory, rules, payments = law.memory, law.rules, law.payments
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
    origin = 0 if tables.sees_all else cell_of(world.row[i], world.col[i], tables)
    heading = world.heading[i]
    if tables.walls_block_sight and not tables.in_sight[origin, heading, window_cell]:
        return False
    cell = origin + tables.window_cells[heading, window_cell]
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
