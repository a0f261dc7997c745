"""The beam: the cells it covers, the agents it hits, and how they are tagged, on one world."""

from cprl.commons.colours import WALL
from cprl.commons.moves import cell_of
from cprl.commons.tables import FURTHER, Tables
from cprl.commons.world import COL_STEP, ROW_STEP, Bools, Worlds
from cprl.institutions import Law
from cprl.institutions.mediation import mediate
from cprl.institutions.punishment import punish
from cprl.institutions.sanctions import sanction_tag


def beam_row(world: Worlds, tables: Tables, shooter: int) -> int:
    """The row from which a shooter fired: its own, unless another agent has moved it since."""
    if tables.agent_1_right_moves_agent_0 and world.moved_after_firing[shooter]:
        return world.row[shooter] - ROW_STEP[(world.heading[shooter] + 1) % 4]
    return world.row[shooter]


def beam_col(world: Worlds, tables: Tables, shooter: int) -> int:
    """The column from which a shooter fired; see `beam_row`."""
    if tables.agent_1_right_moves_agent_0 and world.moved_after_firing[shooter]:
        return world.col[shooter] - COL_STEP[(world.heading[shooter] + 1) % 4]
    return world.col[shooter]


def beam_cell(world: Worlds, tables: Tables, shooter: int, ahead: int, side: int) -> int:
    """The cell that lies `ahead` cells ahead of where a shooter fired and `side` cells to its right."""
    heading = world.heading[shooter]
    right = (heading + 1) % 4
    row = beam_row(world, tables, shooter) + ahead * ROW_STEP[heading] + side * ROW_STEP[right]
    col = beam_col(world, tables, shooter) + ahead * COL_STEP[heading] + side * COL_STEP[right]
    return cell_of(row, col, tables)


def beam_begin(tables: Tables, side: int) -> int:
    """How many cells ahead the beam begins in its column at offset `side`: 1, or 0 beside the shooter."""
    return 0 if FURTHER and tables.beam_from_beside and side != 0 else 1


def beam_end(world: Worlds, tables: Tables, shooter: int, side: int) -> int:
    """How many cells ahead the beam ends at most in its column at offset `side`."""
    length = tables.beam_length[world.heading[shooter]]
    return length - abs(side) if FURTHER and tables.beam_tapers else length


def beam_reach(world: Worlds, tables: Tables, shooter: int, side: int, present: Bools) -> int:
    """How many cells ahead the last cell is that the beam covers in its column at offset `side`: the last one
    before a wall there, or under `beam_stops_at_agents` the first one with an agent that is present.

    `present`: bool [N].
    """
    reach, end = beam_begin(tables, side) - 1, beam_end(world, tables, shooter, side)
    while (
        reach < end
        and tables.background[beam_cell(world, tables, shooter, reach + 1, side)] != tables.paints[WALL]
    ):
        reach += 1
    if FURTHER and tables.beam_stops_at_agents:
        return first_agent(world, tables, shooter, side, reach, present)
    return reach


def first_agent(world: Worlds, tables: Tables, shooter: int, side: int, reach: int, present: Bools) -> int:
    """How many cells ahead the first agent is in a column of a beam, or its reach if there is none."""
    for i in range(present.shape[0]):
        ahead, aside = place_in_beam(world, tables, i, shooter)
        if present[i] and aside == side and ahead >= beam_begin(tables, side):
            reach = min(reach, ahead)
    return reach


def place_in_beam(world: Worlds, tables: Tables, i: int, shooter: int) -> tuple[int, int]:
    """How many cells ahead of where a shooter fired, and how many to its right, agent i is."""
    heading = world.heading[shooter]
    right = (heading + 1) % 4
    rows = world.row[i] - beam_row(world, tables, shooter)
    cols = world.col[i] - beam_col(world, tables, shooter)
    ahead = rows * ROW_STEP[heading] + cols * COL_STEP[heading]
    return ahead, rows * ROW_STEP[right] + cols * COL_STEP[right]


def is_hit(world: Worlds, tables: Tables, target: int, shooter: int) -> bool:
    """Whether the shooter's beam covers the target's cell."""
    ahead, side = place_in_beam(world, tables, target, shooter)
    return (
        ahead >= beam_begin(tables, side)
        and ahead <= tables.beam_length[world.heading[shooter]]
        and abs(side) <= tables.beam_half_width
        and ahead <= beam_reach(world, tables, shooter, side, world.in_play)
    )


def find_hits(world: Worlds, tables: Tables, hit_by: Bools) -> None:
    """Finds which agents in play are hit by whom, after all moves; `hit_by`: bool [N, N], row: agent hit."""
    agents = world.row.shape[0]
    for i in range(agents):
        for j in range(agents):
            hit_by[i, j] = world.fired[j] and i != j and world.in_play[i] and is_hit(world, tables, i, j)


def tag(world: Worlds, tables: Tables, law: Law | None, hit_by: Bools, tagged_by: Bools) -> None:
    """Counts hits, at most one per agent and turn, and tags agents with `hits_to_tag` hits; [N, N] each.

    Institutions may have other time-outs, and fines, and refund unjust tags.
    """
    for i in range(world.row.shape[0]):
        if count_hit(world, tables, hit_by, tagged_by, i):
            steps = tables.freeze_steps
            if law is not None:
                steps = sanction_tag(law.sanctions, law.ledger, tagged_by, i, world.step[0], steps)
            take_out_of_play(world, tables, i, steps)
    if law is not None:
        mediate(law.mediation, law.ledger, tagged_by, world.step[0])
        punish(law.punishment, law.ledger, tagged_by, world.fired)


def count_hit(world: Worlds, tables: Tables, hit_by: Bools, tagged_by: Bools, i: int) -> bool:
    """Counts at most one hit of agent i; the last of `hits_to_tag` tags it: writes by whom, returns True."""
    is_hit_now = False
    for j in range(world.row.shape[0]):
        tagged_by[i, j] = False
        if hit_by[i, j]:
            is_hit_now = True
    if not is_hit_now:
        return False
    world.hits[i] += 1
    if world.hits[i] < tables.hits_to_tag:
        return False
    for j in range(world.row.shape[0]):
        tagged_by[i, j] = hit_by[i, j]
    return True


def take_out_of_play(world: Worlds, tables: Tables, i: int, freeze: int) -> None:
    """Takes agent i, which was tagged, out of play for `freeze` turns."""
    world.hits[i] = 0
    world.offences[i] += 1
    take_out(world, tables, i, freeze)


def take_out(world: Worlds, tables: Tables, i: int, freeze: int) -> None:
    """Takes agent i out of play for at least `freeze` turns."""
    steps = max(0, freeze - 1) if tables.freeze_counts_tag_turn else freeze
    world.in_play[i] = False
    world.tagged_step[i] = world.step[0]
    world.out_steps[i] = max(world.out_steps[i], steps)
