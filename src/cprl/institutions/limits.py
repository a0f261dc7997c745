"""Boundaries, quotas, closed seasons and closed patches: which bites and steps they stop or forbid, on one
world.

A violation adds its fine to `Memory.due`; whether it is paid depends on its detection.
"""

from cprl.institutions.memory import (
    CLOSED_BITES,
    EXCESS_BITES,
    FOREIGN_BITES,
    OWN_BITES,
    TRESPASSES,
    Bytes,
    InstitutionTables,
    Memory,
)

ROUNDING = 1e-9
"""Apples by which a quota may be exceeded: the rounding of its computation."""


def open_windows(memory: Memory, tables: InstitutionTables, turn: int, stock_share: float) -> None:
    """Begins the windows of quotas that begin with this turn; `stock_share`: sites with an apple, 0..1."""
    for q in range(tables.quota_unit.shape[0]):
        if (turn - 1) % tables.quota_steps[q] == 0:
            share = tables.quota_share[q]
            if tables.quota_ballot[q] >= 0:
                share = memory.in_force[tables.quota_ballot[q]]
            if tables.quota_by_stock[q]:
                share *= stock_share
            memory.allowed[q] = share * tables.quota_unit[q]
            for i in range(memory.taken.shape[1]):
                memory.taken[q, i] = 0


def is_season_closed(tables: InstitutionTables, season: int, turn: int) -> bool:
    """Whether a season is closed in a turn, counted from 1."""
    return (turn - 1) % tables.season_steps[season] >= tables.season_open[season]


def is_patch_closed(memory: Memory, tables: InstitutionTables, site: int) -> bool:
    """Whether the patch of a site is closed in this turn."""
    return tables.patch_sites.shape[0] > 0 and memory.closed[tables.patch_of[site]]


def is_above_quota(memory: Memory, q: int, i: int, apples: int) -> bool:
    """Whether so many apples in the current window are more than agent i may harvest."""
    return apples > memory.allowed[q] + ROUNDING


def stops_bite(memory: Memory, tables: InstitutionTables, i: int, cell: int, site: int, turn: int) -> bool:
    """Whether agent i cannot harvest this site in this turn."""
    for boundary in range(tables.may_use.shape[0]):
        if tables.bite_stopped[boundary] and not tables.may_use[boundary, i, cell]:
            return True
    for season in range(tables.season_steps.shape[0]):
        if tables.season_stopped[season] and is_season_closed(tables, season, turn):
            return True
    for q in range(tables.quota_unit.shape[0]):
        if tables.quota_stopped[q] and is_above_quota(memory, q, i, memory.taken[q, i] + 1):
            return True
    return tables.patch_stopped and is_patch_closed(memory, tables, site)


def violate(memory: Memory, i: int, count: int, fine: float) -> None:
    """Notes a violation of agent i, of one kind of count, that costs a fine if it is detected."""
    memory.broke[i] = True
    memory.counts[i, count] += 1
    memory.due[i] += fine


def add_to_patch(memory: Memory, tables: InstitutionTables, site: int, apples: int) -> None:
    """Counts apples that grew on a site, or with -1 the one that was bitten there."""
    if tables.patch_sites.shape[0] > 0:
        memory.patch_stock[tables.patch_of[site]] += apples


def note_bite(memory: Memory, tables: InstitutionTables, i: int, cell: int, site: int, turn: int) -> None:
    """Counts a bite of agent i, and notes the rules that it breaks."""
    add_to_patch(memory, tables, site, -1)
    for boundary in range(tables.may_use.shape[0]):
        if tables.may_use[boundary, i, cell]:
            memory.counts[i, OWN_BITES] += 1
        else:
            violate(memory, i, FOREIGN_BITES, tables.bite_fine[boundary])
    for season in range(tables.season_steps.shape[0]):
        if is_season_closed(tables, season, turn):
            violate(memory, i, CLOSED_BITES, tables.season_fine[season])
    for q in range(tables.quota_unit.shape[0]):
        memory.taken[q, i] += 1
        if is_above_quota(memory, q, i, memory.taken[q, i]):
            violate(memory, i, EXCESS_BITES, tables.quota_fine[q])
    if is_patch_closed(memory, tables, site):
        violate(memory, i, CLOSED_BITES, tables.patch_fine)
    for tax in range(tables.tax_steps.shape[0]):
        memory.income[tax, i] += 1.0


def note_step(memory: Memory, tables: InstitutionTables, i: int, cell: int) -> None:
    """Notes that agent i, in play, ends its move on a cell."""
    for boundary in range(tables.may_use.shape[0]):
        if not tables.may_use[boundary, i, cell]:
            if tables.step_is_violation[boundary]:
                violate(memory, i, TRESPASSES, tables.step_fine[boundary])
            else:
                memory.counts[i, TRESPASSES] += 1


def count_patches(memory: Memory, tables: InstitutionTables, stock: Bytes) -> None:
    """Counts the apples of each patch; `stock`: uint8 [K], 1 for an apple."""
    patches = tables.patch_sites.shape[0]
    for p in range(patches):
        memory.patch_stock[p] = 0
    for site in range(stock.shape[0]):
        add_to_patch(memory, tables, site, int(stock[site]))


def close_patches(memory: Memory, tables: InstitutionTables) -> None:
    """Writes which patches are closed in the coming turn."""
    for p in range(tables.patch_sites.shape[0]):
        memory.closed[p] = memory.patch_stock[p] < tables.patch_below


def is_known_forbidden(memory: Memory, tables: InstitutionTables, i: int, cell: int, site: int) -> bool:
    """Whether a bite of agent i on a cell would break a rule about places that it observes; `site`: -1 for
    none."""
    for boundary in range(tables.may_use.shape[0]):
        if tables.may_use_shown[boundary] and not tables.may_use[boundary, i, cell]:
            return True
    return tables.patch_shown and site >= 0 and is_patch_closed(memory, tables, site)
