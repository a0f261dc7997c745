"""Sanctions, mediation, the cost of monitoring, and taxes: who pays what, on one world."""

from cprl.institutions.memory import (
    DETECTIONS,
    RETURNS,
    SANCTIONS,
    UNJUST_TAGS,
    VIOLATIONS,
    Bools,
    InstitutionTables,
    Memory,
)


def recover(memory: Memory, tables: InstitutionTables, turn: int) -> None:
    """Lowers the level of agents that have had no offence in the last turns, this one included."""
    if tables.sanction_recovery > 0:
        for i in range(memory.level.shape[0]):
            if memory.level[i] > 0 and turn - memory.offence_step[i] >= tables.sanction_recovery:
                memory.level[i] -= 1
                memory.offence_step[i] = turn


def time_out(memory: Memory, tables: InstitutionTables, shooter: int, i: int) -> int:
    """The turns that agent i misses for an offence at its level; `shooter`: who sanctions."""
    last = tables.sanction_steps.shape[1] - 1
    return tables.sanction_steps[shooter, min(memory.level[i], last)]


def offend(memory: Memory, tables: InstitutionTables, i: int, turn: int) -> None:
    """Counts an offence of agent i, which pays the fine of its level and rises by one."""
    memory.fines[i] += tables.sanction_fine[min(memory.level[i], tables.sanction_fine.shape[0] - 1)]
    memory.level[i] += 1
    memory.offence_step[i] = turn
    memory.counts[i, SANCTIONS] += 1


def mediate(memory: Memory, tables: InstitutionTables, tagged_by: Bools, i: int, turn: int) -> None:
    """Refunds agent i for a tag if it broke no rule in the last turns; `tagged_by`: bool [N, N]."""
    shooters = 0
    for j in range(tagged_by.shape[0]):
        shooters += tagged_by[i, j]
    since = turn - memory.violation_step[i]
    has_violated = memory.broke[i] or (memory.violation_step[i] > 0 and since < tables.mediation_turns)
    if shooters == 0 or has_violated:
        return
    memory.transfers[i] += tables.mediation_refund
    for j in range(tagged_by.shape[0]):
        if tagged_by[i, j]:
            memory.fines[j] += tables.mediation_refund / shooters
            memory.counts[j, UNJUST_TAGS] += 1
            memory.unjust[j] = True


def sanction_tag(
    memory: Memory, tables: InstitutionTables, tagged_by: Bools, i: int, turn: int, freeze: int
) -> int:
    """Lets agent i pay for being tagged, where that is an offence; returns the turns that it misses, `freeze`
    where it is none."""
    if not tables.sanctions_tags:
        return freeze
    steps = 0
    for j in range(tagged_by.shape[0]):
        if tagged_by[i, j]:
            steps = max(steps, time_out(memory, tables, j, i))
    offend(memory, tables, i, turn)
    return steps


def note_violation(memory: Memory, i: int, turn: int) -> bool:
    """Counts a turn in which agent i violated a rule; returns whether it did."""
    memory.broke[i] = memory.broke[i] or memory.unjust[i]
    if memory.broke[i]:
        memory.counts[i, VIOLATIONS] += 1
        memory.counts[i, RETURNS] += memory.sanctioned[i]
        memory.violation_step[i] = turn
    return memory.broke[i]


def charge(memory: Memory, i: int) -> None:
    """Agent i pays for the violations of this turn, which were detected."""
    memory.detected[i] = True
    memory.counts[i, DETECTIONS] += 1
    memory.fines[i] += memory.due[i]


def pay_monitor(memory: Memory, tables: InstitutionTables) -> None:
    """Charges the cost of inspection to who monitors, or to all in equal parts."""
    if tables.monitor_cost == 0:
        return
    agents = memory.fines.shape[0]
    for i in range(agents):
        if tables.monitor_ballot >= 0:
            if memory.in_force[tables.monitor_ballot] == i:
                memory.fines[i] += tables.monitor_cost
        elif tables.monitor < 0:
            memory.fines[i] += tables.monitor_cost / agents
        elif tables.monitor == i:
            memory.fines[i] += tables.monitor_cost


def tax_of(memory: Memory, tables: InstitutionTables, tax: int, i: int) -> float:
    """The apples that agent i owes on its harvest of the period."""
    income, owed = memory.income[tax, i], 0.0
    if tables.tax_ballot[tax] >= 0:
        return memory.in_force[tables.tax_ballot[tax]] * income
    for bracket in range(tables.tax_rate.shape[1]):
        from_ = tables.tax_from[tax, bracket]
        if income > from_:
            upper = income
            if bracket + 1 < tables.tax_from.shape[1]:
                upper = min(income, tables.tax_from[tax, bracket + 1])
            owed += tables.tax_rate[tax, bracket] * (upper - from_)
    return owed


def pay_out(memory: Memory, tables: InstitutionTables, tax: int, i: int) -> None:
    """Gives agent i its equal part of what its group owed."""
    pool, members = 0.0, 0
    for j in range(memory.fines.shape[0]):
        if tables.tax_group[tax, j] == tables.tax_group[tax, i]:
            pool += memory.owed[j]
            members += 1
    memory.transfers[i] += pool / members


def has_income(memory: Memory, tax: int) -> bool:
    """Whether any agent harvested in the period of a tax."""
    for i in range(memory.income.shape[1]):
        if memory.income[tax, i] > 0:
            return True
    return False


def collect_taxes(memory: Memory, tables: InstitutionTables, turn: int, is_over: bool) -> None:
    """Collects and pays out the taxes whose period ends with this turn, or with the episode."""
    agents = memory.fines.shape[0]
    for tax in range(tables.tax_steps.shape[0]):
        if (is_over or turn % tables.tax_steps[tax] == 0) and has_income(memory, tax):
            for i in range(agents):
                memory.owed[i] = tax_of(memory, tables, tax, i)
                memory.fines[i] += memory.owed[i]
                memory.income[tax, i] = 0.0
            for i in range(agents):
                if tables.tax_group[tax, i] >= 0:
                    pay_out(memory, tables, tax, i)
