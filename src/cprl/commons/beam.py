"""The beam: the cells it covers, the agents it hits, and how they are tagged. The rules work on one world.

A beam has columns, each a row of cells ahead of the shooter. `side` is the offset of a column: 0 is straight
ahead, negative to the left, positive to the right. `ahead` counts cells from the shooter, which is at 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cprl.commons.cells import WALL
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.moves import cell_of
from cprl.commons.quirks import turns_missed
from cprl.institutions.mediation import mediate
from cprl.institutions.punishment import punish
from cprl.institutions.sanctions import sanction_tag
from cprl.values.array_types import Bool

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Worlds
    from cprl.institutions import Law


def note_shot(world: Worlds, agent: int) -> None:
    """Note the cell and heading from which an agent fires or cleans.

    It stays there for the rest of this turn, unless it is tagged and returns at a spawn place.
    """
    world.shot_row[agent] = world.row[agent]
    world.shot_col[agent] = world.col[agent]
    world.shot_heading[agent] = world.heading[agent]


def beam_cell(world: Worlds, tables: Tables, shooter: int, ahead: int, side: int) -> int:
    """Return the cell that lies `ahead` cells ahead of a shooter and `side` cells to its right."""
    heading = world.shot_heading[shooter]
    right = (heading + 1) % 4
    row = world.shot_row[shooter] + ahead * ROW_STEP[heading] + side * ROW_STEP[right]
    col = world.shot_col[shooter] + ahead * COL_STEP[heading] + side * COL_STEP[right]
    return cell_of(row, col, tables)


def beam_begin(tables: Tables, side: int) -> int:
    """Return how many cells ahead a column of the beam begins: 1, or 0 if it begins beside the shooter."""
    return 0 if tables.beam_from_beside and side != 0 else 1


def beam_end(world: Worlds, tables: Tables, shooter: int, side: int) -> int:
    """Return how many cells ahead a column of the beam ends where nothing stops it."""
    length = tables.beam_length[world.shot_heading[shooter]]
    return length - abs(side) if tables.beam_tapers else length


def beam_reach(world: Worlds, tables: Tables, shooter: int, side: int, stands: Bool) -> int:
    """Return how many cells ahead the last cell is that the beam covers in a column.

    A wall stops the column before it, and under `beam_stops_at_agents` the first agent stops it on its cell.
    `stands`: bool [N], the agents that can stop it.
    """
    reach = beam_begin(tables, side) - 1
    end = beam_end(world, tables, shooter, side)
    while (
        reach < end
        and tables.background[beam_cell(world, tables, shooter, reach + 1, side)] != tables.paints[WALL]
    ):
        reach += 1
    if tables.beam_stops_at_agents:
        return first_agent(world, tables, shooter, side, reach, stands)
    return reach


def first_agent(world: Worlds, tables: Tables, shooter: int, side: int, reach: int, stands: Bool) -> int:
    """Return how many cells ahead the first agent in a column of the beam is, `reach` if there is none."""
    for agent in range(stands.shape[0]):
        ahead, agent_side = place_in_beam(world, agent, shooter)
        is_in_the_way = stands[agent] and not has_respawned(world, tables, agent)
        if is_in_the_way and agent_side == side and ahead >= beam_begin(tables, side):
            reach = min(reach, ahead)
    return reach


def has_respawned(world: Worlds, tables: Tables, agent: int) -> bool:
    """Return whether an agent was tagged in this turn and is already back in play, at a spawn place."""
    return tables.respawn_at_spawns and world.in_play[agent] and world.tagged_step[agent] == world.step[0]


def place_in_beam(world: Worlds, agent: int, shooter: int) -> tuple[int, int]:
    """Return where an agent is as seen from a shooter: the cells ahead of it, and the cells to its right."""
    heading = world.shot_heading[shooter]
    right = (heading + 1) % 4
    rows_down = world.row[agent] - world.shot_row[shooter]
    cols_right = world.col[agent] - world.shot_col[shooter]
    ahead = rows_down * ROW_STEP[heading] + cols_right * COL_STEP[heading]
    return ahead, rows_down * ROW_STEP[right] + cols_right * COL_STEP[right]


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
    """Find the agents in play that beams hit after all moves.

    Write `hit_by`, bool [N, N]: agent hit, shooter.
    """
    agents = world.row.shape[0]
    for agent in range(agents):
        for shooter in range(agents):
            hit_by[agent, shooter] = (
                world.fired[shooter]
                and agent != shooter
                and world.in_play[agent]
                and is_hit(world, tables, agent, shooter)
            )


def tag(world: Worlds, tables: Tables, law: Law | None, hit_by: Bool, tagged_by: Bool) -> None:
    """Count hits, at most one per agent and turn, and tag agents that have `hits_to_tag` hits.

    Institutions may change the time-out, fine the agents, and refund unjust tags. `hit_by` and `tagged_by`,
    which is written, are bool [N, N]: agent hit, shooter.
    """
    for agent in range(world.row.shape[0]):
        if count_hit(world, tables, hit_by, tagged_by, agent):
            freeze_steps = tables.freeze_steps
            if law is not None:
                freeze_steps = sanction_tag(
                    law.sanctions, law.ledger, tagged_by, agent, world.step[0], freeze_steps
                )
            world.hits[agent] = 0
            world.offences[agent] += 1
            take_out(world, agent, freeze_steps)
    if law is not None:
        mediate(law.mediation, law.ledger, tagged_by, world.step[0])
        punish(law.punishment, law.ledger, tagged_by, world.fired)


def count_hit(world: Worlds, tables: Tables, hit_by: Bool, tagged_by: Bool, agent: int) -> bool:
    """Count at most one hit of an agent, and return whether this hit tags it.

    Write into `tagged_by`, bool [N, N], which agents tagged this one.
    """
    is_hit_now = False
    for shooter in range(world.row.shape[0]):
        tagged_by[agent, shooter] = False
        if hit_by[agent, shooter]:
            is_hit_now = True
    if not is_hit_now:
        return False
    world.hits[agent] += 1
    if world.hits[agent] < tables.hits_to_tag:
        return False
    for shooter in range(world.row.shape[0]):
        tagged_by[agent, shooter] = hit_by[agent, shooter]
    return True


def take_out(world: Worlds, agent: int, freeze_steps: int) -> None:
    """Take an agent out of play for at least `freeze_steps` turns."""
    world.in_play[agent] = False
    world.tagged_step[agent] = world.step[0]
    world.out_steps[agent] = max(world.out_steps[agent], turns_missed(freeze_steps, world.groups.quirks))
