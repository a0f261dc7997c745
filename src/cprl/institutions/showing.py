"""What institutions show agents as part of their observations, on one world; each entry is in 0..1.

`cprl.commons.institution_tables` lists the entries of a game in the order of its institutions:
- `Quota`: apples left of the window's quota, relative to the most that it can be; the part of the window that
  is left;
- `ClosedSeason`: 1 if the coming turn is closed; the part of a period until that changes;
- `GraduatedSanctions`: the agent's level, relative to the last one;
- `Monitoring`: 1 if a violation of the agent was detected in the last turn; with an election, 1 if it
  monitors;
- `Mediation`: for each agent, the own mark first, 1 if it violated a rule in the last turns;
- `Sanctioner`: 1 if the agent may fire;
- `Vote`: the value in force, relative to the highest choice.

`Boundaries` and `ClosedPatches` show where bites are forbidden, see `cprl.commons.views`.
"""

from cprl.institutions.limits import is_season_closed
from cprl.institutions.memory import (
    CLOSED,
    DETECTED,
    IN_FORCE,
    IS_ELECTED,
    LEVEL,
    MARK,
    MAY_FIRE,
    QUOTA_LEFT,
    QUOTA_TIME,
    SEASON_TIME,
    InstitutionTables,
    Memory,
)


def part_left(turn: int, period: int) -> float:
    """The part of a period that is left after a turn, in 0..1; 1 when the next one begins."""
    return (period - turn % period) / period


def season_left(tables: InstitutionTables, season: int, turn: int) -> float:
    """The part of a period after which the season opens or closes, counted after a turn."""
    period, opened = tables.season_steps[season], tables.season_open[season]
    within = turn % period
    until = opened if within < opened else period
    return (until - within) / period


def has_mark(memory: Memory, tables: InstitutionTables, agent: int, turn: int) -> bool:
    """Whether an agent violated a rule in the last turns that justify a tag in the coming turn."""
    at = memory.violation_step[agent]
    return at > 0 and turn + 1 - at < tables.mediation_turns


def quota_left(memory: Memory, tables: InstitutionTables, q: int, i: int) -> float:
    """The apples that agent i may still harvest in the window, relative to the most that it can be."""
    left = memory.allowed[q] - memory.taken[q, i]
    return left / tables.quota_full[q] if left > 0 and tables.quota_full[q] > 0 else 0.0


def shown_entry(memory: Memory, tables: InstitutionTables, i: int, entry: int, turn: int) -> float:
    """One entry of what agent i is shown after a turn."""
    kind, argument = tables.shown_kind[entry], tables.shown_argument[entry]
    if kind == QUOTA_LEFT:
        return quota_left(memory, tables, argument, i)
    if kind == QUOTA_TIME:
        return part_left(turn, tables.quota_steps[argument])
    if kind == CLOSED:
        return 1.0 if is_season_closed(tables, argument, turn + 1) else 0.0
    if kind == SEASON_TIME:
        return season_left(tables, argument, turn)
    if kind == LEVEL:
        last = max(1, tables.sanction_fine.shape[0] - 1, tables.sanction_steps.shape[1] - 1)
        return min(memory.level[i], last) / last
    if kind == DETECTED:
        return 1.0 if memory.detected[i] else 0.0
    if kind == MARK:
        agent = (i + argument) % memory.fines.shape[0]
        return 1.0 if has_mark(memory, tables, agent, turn) else 0.0
    if kind == MAY_FIRE:
        return 1.0 if memory.may_fire[i] else 0.0
    if kind == IN_FORCE:
        highest = tables.ballot_choice[argument, tables.ballot_options[argument] - 1]
        return memory.in_force[argument] / highest
    if kind == IS_ELECTED:
        return 1.0 if memory.in_force[argument] == i else 0.0
    return 0.0
