"""The hooks of a turn, on one world: the moments at which the rules of the game call those of institutions.

Each hook calls the rules of all modules of institutions in the order of `Law`, so that sums of fines do not
depend on the order of institutions in a game. Kinds that a game lacks have arrays of length 0, so that the
same machine code serves every combination of institutions.

For the cost of tags and the detection of violations, the rules of the game call the modules `sanctions`,
`mediation`, `punishment` and `monitoring` directly.
"""

from typing import Protocol

from cprl.institutions import Law
from cprl.institutions.boundaries import count_own_harvest, is_foreign, is_seen_as_foreign, note_trespass
from cprl.institutions.ledger import CLOSED_BITES, EXCESS_BITES, FOREIGN_BITES, Ledger, note_violation
from cprl.institutions.mediation import show_mark
from cprl.institutions.monitoring import charge_inspection, show_monitoring
from cprl.institutions.patches import (
    close_patches,
    count_apple,
    count_apples,
    is_patch_closed,
    is_seen_as_closed,
)
from cprl.institutions.quotas import is_used_up, open_windows, show_quota, use_quotas
from cprl.institutions.rotation import is_out_of_turn, show_rotation
from cprl.institutions.sanctioner import appoint, show_may_fire
from cprl.institutions.sanctions import forget_offences, forgive, show_level
from cprl.institutions.seasons import is_season_closed, show_season
from cprl.institutions.taxes import collect_taxes, forget_income, note_income
from cprl.institutions.votes import show_in_force
from cprl.values.array_types import Bool, Float64, UInt8

(
    SEASONS_MODULE,
    QUOTAS_MODULE,
    ROTATION_MODULE,
    MONITORING_MODULE,
    VOTES_MODULE,
    SANCTIONS_MODULE,
    MEDIATION_MODULE,
) = map(Law._fields.index, ("seasons", "quotas", "rotation", "monitoring", "votes", "sanctions", "mediation"))
"""The indices in `Law` of the modules that show agents something, as `Entries.module` holds them."""


class Limits(Protocol):
    """The arrays that all modules with limits on the harvest have, by limit."""

    @property
    def is_stopped(self) -> Bool:
        """Return an array that is True for limits against which no harvest is possible."""

    @property
    def fine(self) -> Float64:
        """Return the apples that a harvest against each limit costs if it is possible and detected."""


def stops_harvest(law: Law, agent: int, cell: int, site: int, turn: int) -> bool:
    """Return whether an institution keeps an agent from harvesting a site; `cell`: that of the site."""
    return apply_limits(law, agent, cell, site, turn, False)


def note_harvest(law: Law, agent: int, cell: int, site: int, turn: int) -> None:
    """Note that an agent has harvested a site, and the limits that it broke by that."""
    apply_limits(law, agent, cell, site, turn, True)
    count_own_harvest(law.boundaries, law.ledger, agent, cell)
    use_quotas(law.quotas, agent)
    note_income(law.taxes, agent)


def apply_limits(law: Law, agent: int, cell: int, site: int, turn: int, has_harvested: bool) -> bool:
    """Return whether any limit stops a harvest of an agent.

    With `has_harvested` the harvest has happened: note all limits that it broke instead, and return False.
    """
    for limit in range(law.boundaries.fine.shape[0]):
        is_broken = is_foreign(law.boundaries, limit, agent, cell)
        if is_broken and apply_limit(law.boundaries, law.ledger, limit, agent, FOREIGN_BITES, has_harvested):
            return True
    for limit in range(law.seasons.fine.shape[0]):
        is_broken = is_season_closed(law.seasons, limit, turn)
        if is_broken and apply_limit(law.seasons, law.ledger, limit, agent, CLOSED_BITES, has_harvested):
            return True
    for limit in range(law.quotas.fine.shape[0]):
        is_broken = is_used_up(law.quotas, limit, agent)
        if is_broken and apply_limit(law.quotas, law.ledger, limit, agent, EXCESS_BITES, has_harvested):
            return True
    for limit in range(law.patches.fine.shape[0]):
        is_broken = is_patch_closed(law.patches, site)
        if is_broken and apply_limit(law.patches, law.ledger, limit, agent, CLOSED_BITES, has_harvested):
            return True
    for limit in range(law.rotation.fine.shape[0]):
        is_broken = is_out_of_turn(law.rotation, law.ledger, limit, agent, turn)
        if is_broken and apply_limit(law.rotation, law.ledger, limit, agent, CLOSED_BITES, has_harvested):
            return True
    return False


def apply_limit(
    limits: Limits, ledger: Ledger, limit: int, agent: int, count_index: int, has_harvested: bool
) -> bool:
    """Return whether a limit stops a harvest of an agent that breaks it.

    With `has_harvested` the harvest has happened: note the violation instead, and return False.
    `count_index`: the index in `COUNT_NAMES` under which the violation counts.
    """
    if has_harvested:
        note_violation(ledger, agent, count_index, limits.fine[limit])
        return False
    return limits.is_stopped[limit]


def note_apple(law: Law, site: int, change: int) -> None:
    """Note that an apple has appeared on a site (`change` 1) or has gone from it (`change` -1)."""
    count_apple(law.patches, site, change)


def note_step(law: Law, agent: int, cell: int) -> None:
    """Note that an agent, in play, ends its move on a cell."""
    note_trespass(law.boundaries, law.ledger, agent, cell)


def settle_accounts(law: Law, turn: int, is_over: bool) -> None:
    """Settle the accounts at the end of a turn: charge for inspection, collect taxes, and forgive offences.

    `is_over`: whether the episode ends with this turn.
    """
    charge_inspection(law.monitoring, law.ledger)
    collect_taxes(law.taxes, law.ledger, turn, is_over)
    forgive(law.sanctions, turn)


def forget_last_episode(law: Law) -> None:
    """Clear what institutions remember of the last episode."""
    forget_income(law.taxes)
    forget_offences(law.sanctions)


def refresh_derived(law: Law, stock: UInt8) -> None:
    """Compute the arrays that follow from the rest of the state; `stock`: uint8 [K]."""
    count_apples(law.patches, stock)
    appoint(law.sanctioner, law.ledger)


def open_turn(law: Law, turn: int, stock_share: float) -> None:
    """Open the windows of quotas that begin with the coming turn, and close patches for it.

    `turn`: the coming turn, counted from 1; `stock_share`: the share of all sites that hold an apple.
    """
    open_windows(law.quotas, law.ledger, turn, stock_share)
    close_patches(law.patches)


def is_seen_as_forbidden(law: Law, agent: int, cell: int, site: int) -> bool:
    """Return whether an agent observes that a harvest on a cell breaks a rule about places.

    `site`: the site on the cell, or -1.
    """
    return is_seen_as_foreign(law.boundaries, agent, cell) or is_seen_as_closed(law.patches, site)


def shown_value(law: Law, index: int, agent: int, turn: int) -> float:
    """Return a number that an agent observes after a turn, 0..1; `index`: that of the number in
    `Law.entries`."""
    module = law.entries.module[index]
    entry = law.entries.entry[index]
    argument = law.entries.argument[index]
    if module == SEASONS_MODULE:
        return show_season(law.seasons, entry, argument, turn)
    if module == QUOTAS_MODULE:
        return show_quota(law.quotas, entry, argument, agent, turn)
    if module == ROTATION_MODULE:
        return show_rotation(law.rotation, law.ledger, entry, argument, agent, turn)
    if module == MONITORING_MODULE:
        return show_monitoring(law.monitoring, law.ledger, entry, argument, agent)
    if module == VOTES_MODULE:
        return show_in_force(law.votes, law.ledger, argument)
    if module == SANCTIONS_MODULE:
        return show_level(law.sanctions, law.ledger, agent)
    if module == MEDIATION_MODULE:
        return show_mark(law.mediation, law.ledger, argument, agent, turn)
    return show_may_fire(law.sanctioner, agent)
