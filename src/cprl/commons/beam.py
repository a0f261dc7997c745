"""The beam: the cells it covers, the agents it hits, and how they are tagged, on one world."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cprl.commons.cells import WALL
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.moves import cell_of
from cprl.commons.quirks import turns_missed
from cprl.institutions.mediation import mediate
from cprl.institutions.punishment import punish
from cprl.institutions.sanctions import sanction_tag
from cprl.values.arrays import Bool

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Worlds
    from cprl.institutions import Law


def note_shot(world: Worlds, i: int) -> None:
    """Note from where agent i fires or cleans: it stays there in this turn, unless it is tagged and returns
    somewhere else."""
    world.shot_row[i] = world.row[i]
    world.shot_col[i] = world.col[i]
    world.shot_heading[i] = world.heading[i]


def beam_cell(world: Worlds, tables: Tables, shooter: int, ahead: int, side: int) -> int:
    """Return the cell that lies `ahead` cells ahead of where a shooter fired and `side` cells to its
    right."""
    heading = world.shot_heading[shooter]
    right = (heading + 1) % 4
    row = world.shot_row[shooter] + ahead * ROW_STEP[heading] + side * ROW_STEP[right]
    col = world.shot_col[shooter] + ahead * COL_STEP[heading] + side * COL_STEP[right]
    return cell_of(row, col, tables)


def beam_begin(tables: Tables, side: int) -> int:
    """Return how many cells ahead the beam begins in its column at offset `side`: 1, or 0 beside the
    shooter."""
    return 0 if tables.beam_from_beside and side != 0 else 1


def beam_end(world: Worlds, tables: Tables, shooter: int, side: int) -> int:
    """Return how many cells ahead the beam ends at most in its column at offset `side`."""
    length = tables.beam_length[world.shot_heading[shooter]]
    return length - abs(side) if tables.beam_tapers else length


def beam_reach(world: Worlds, tables: Tables, shooter: int, side: int, present: Bool) -> int:
    """Return how many cells ahead the last cell is that the beam covers in its column at offset `side`: the
    last one before a wall there, or under `beam_stops_at_agents` the first one with an agent that is present.

    `present`: bool [N].
    """
    reach, end = beam_begin(tables, side) - 1, beam_end(world, tables, shooter, side)
    while (
        reach < end
        and tables.background[beam_cell(world, tables, shooter, reach + 1, side)] != tables.paints[WALL]
    ):
        reach += 1
    if tables.beam_stops_at_agents:
        return first_agent(world, tables, shooter, side, reach, present)
    return reach


def first_agent(world: Worlds, tables: Tables, shooter: int, side: int, reach: int, present: Bool) -> int:
    """Return how many cells ahead the first agent is in a column of a beam, or its reach if there is none."""
    for i in range(present.shape[0]):
        ahead, aside = place_in_beam(world, i, shooter)
        stands = present[i] and not has_respawned(world, tables, i)
        if stands and aside == side and ahead >= beam_begin(tables, side):
            reach = min(reach, ahead)
    return reach


def has_respawned(world: Worlds, tables: Tables, i: int) -> bool:
    """Return whether agent i was tagged in this turn and is back in play at a spawn place."""
    return tables.respawn_at_spawns and world.in_play[i] and world.tagged_step[i] == world.step[0]


def place_in_beam(world: Worlds, i: int, shooter: int) -> tuple[int, int]:
    """Return how many cells ahead of where a shooter fired, and how many to its right, agent i is."""
    heading = world.shot_heading[shooter]
    right = (heading + 1) % 4
    rows = world.row[i] - world.shot_row[shooter]
    cols = world.col[i] - world.shot_col[shooter]
    ahead = rows * ROW_STEP[heading] + cols * COL_STEP[heading]
    return ahead, rows * ROW_STEP[right] + cols * COL_STEP[right]


def is_hit(world: Worlds, tables: Tables, target: int, shooter: int) -> bool:
    """Return whether the shooter's beam covers the target's cell."""
    ahead, side = place_in_beam(world, target, shooter)
    return (
        ahead >= beam_begin(tables, side)
        and ahead <= tables.beam_length[world.shot_heading[shooter]]
        and abs(side) <= tables.beam_half_width
        and ahead <= beam_reach(world, tables, shooter, side, world.in_play)
    )


def find_hits(world: Worlds, tables: Tables, hit_by: Bool) -> None:
    """Find which agents in play are hit by whom, after all moves; `hit_by`: bool [N, N], row: agent hit."""
    agents = world.row.shape[0]
    for i in range(agents):
        for j in range(agents):
            hit_by[i, j] = world.fired[j] and i != j and world.in_play[i] and is_hit(world, tables, i, j)


def tag(world: Worlds, tables: Tables, law: Law | None, hit_by: Bool, tagged_by: Bool) -> None:
    """Count hits, at most one per agent and turn, and tag agents with `hits_to_tag` hits; [N, N] each.

    Institutions may have other time-outs, and fines, and refund unjust tags.
    """
    for i in range(world.row.shape[0]):
        if count_hit(world, tables, hit_by, tagged_by, i):
            freeze_steps = tables.freeze_steps
            if law is not None:
                freeze_steps = sanction_tag(
                    law.sanctions, law.ledger, tagged_by, i, world.step[0], freeze_steps
                )
            world.hits[i] = 0
            world.offences[i] += 1
            take_out(world, i, freeze_steps)
    if law is not None:
        mediate(law.mediation, law.ledger, tagged_by, world.step[0])
        punish(law.punishment, law.ledger, tagged_by, world.fired)


def count_hit(world: Worlds, tables: Tables, hit_by: Bool, tagged_by: Bool, i: int) -> bool:
    """Count at most one hit of agent i; the last of `hits_to_tag` tags it: write by whom, and return True."""
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


def take_out(world: Worlds, i: int, freeze_steps: int) -> None:
    """Take agent i out of play for at least so many turns."""
    world.in_play[i] = False
    world.tagged_step[i] = world.step[0]
    world.out_steps[i] = max(world.out_steps[i], turns_missed(freeze_steps, world.groups.quirks))
