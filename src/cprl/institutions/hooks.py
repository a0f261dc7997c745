"""The hooks of a turn, on one world: the moments at which the rules of the game call those of institutions.

Each hook calls the rules of all modules of institutions in the order of `Law`, so that sums of fines do not
depend on the order of institutions in a game. Kinds that a game lacks have arrays of length 0, so that the
same machine code serves every combination of institutions.

For the cost of tags and the detection of violations, the rules of the game call the modules `sanctions`,
`mediation`, `punishment` and `monitoring` directly.
"""

from typing import Protocol

from cprl.institutions import Law
from cprl.institutions.boundaries import count_own_harvest, is_foreign, note_trespass, shows_foreign
from cprl.institutions.ledger import CLOSED_BITES, EXCESS_BITES, FOREIGN_BITES, Ledger, violate
from cprl.institutions.mediation import show_mark
from cprl.institutions.monitoring import charge_inspection, show_monitoring
from cprl.institutions.patches import (
    close_patches,
    count_apple,
    count_apples,
    is_patch_closed,
    shows_closed,
)
from cprl.institutions.quotas import is_used_up, open_windows, show_quota, use_quotas
from cprl.institutions.rotation import is_out_of_turn, show_rotation
from cprl.institutions.sanctioner import appoint, show_may_fire
from cprl.institutions.sanctions import forget_offences, forgive, show_level
from cprl.institutions.seasons import is_season_closed, show_season
from cprl.institutions.taxes import collect_taxes, forget_income, note_income
from cprl.institutions.votes import show_in_force
from cprl.values.array_types import Bool, Float64, UInt8

SEASONS, QUOTAS, ROTATION, MONITORING, VOTES, SANCTIONS, MEDIATION = map(
    Law._fields.index, ("seasons", "quotas", "rotation", "monitoring", "votes", "sanctions", "mediation")
)
"""The indices in `Law` of the modules that show agents something, as `Entries.module` holds them."""


class Limits(Protocol):
    """The arrays that the `Arrays` of all modules with limits on the harvest have, by limit."""

    @property
    def is_stopped(self) -> Bool:
        """Return an array that is True for limits against which no harvest is possible."""

    @property
    def fine(self) -> Float64:
        """Return the apples that a harvest against each limit costs if it is possible and detected."""


def stops_harvest(law: Law, i: int, cell: int, site: int, turn: int) -> bool:
    """Return whether an institution keeps agent i from harvesting a site, which lies on a cell, in a turn."""
    return breaks(law, i, cell, site, turn, False)


def note_harvest(law: Law, i: int, cell: int, site: int, turn: int) -> None:
    """Note that agent i has harvested a site, and the limits that it broke by that."""
    breaks(law, i, cell, site, turn, True)
    count_own_harvest(law.boundaries, law.ledger, i, cell)
    use_quotas(law.quotas, i)
    note_income(law.taxes, i)


def breaks(law: Law, i: int, cell: int, site: int, turn: int, has_harvested: bool) -> bool:
    """Return whether a limit stops a harvest of agent i.

    With `has_harvested` the harvest has happened: note all limits that it broke instead, and return False.
    """
    for n in range(law.boundaries.fine.shape[0]):
        is_broken = is_foreign(law.boundaries, n, i, cell)
        if is_broken and stops(law.boundaries, law.ledger, n, i, FOREIGN_BITES, has_harvested):
            return True
    for n in range(law.seasons.fine.shape[0]):
        is_broken = is_season_closed(law.seasons, n, turn)
        if is_broken and stops(law.seasons, law.ledger, n, i, CLOSED_BITES, has_harvested):
            return True
    for n in range(law.quotas.fine.shape[0]):
        is_broken = is_used_up(law.quotas, n, i)
        if is_broken and stops(law.quotas, law.ledger, n, i, EXCESS_BITES, has_harvested):
            return True
    for n in range(law.patches.fine.shape[0]):
        is_broken = is_patch_closed(law.patches, site)
        if is_broken and stops(law.patches, law.ledger, n, i, CLOSED_BITES, has_harvested):
            return True
    for n in range(law.rotation.fine.shape[0]):
        is_broken = is_out_of_turn(law.rotation, law.ledger, n, i, turn)
        if is_broken and stops(law.rotation, law.ledger, n, i, CLOSED_BITES, has_harvested):
            return True
    return False


def stops(limits: Limits, ledger: Ledger, n: int, i: int, count: int, has_harvested: bool) -> bool:
    """Return whether limit n stops a harvest of agent i that breaks it.

    With `has_harvested` the harvest has happened: note the violation instead, under the index `count` of
    `COUNT_NAMES`, and return False.
    """
    if has_harvested:
        violate(ledger, i, count, limits.fine[n])
        return False
    return limits.is_stopped[n]


def note_apple(law: Law, site: int, change: int) -> None:
    """Note that an apple has appeared on a site (`change` 1) or has gone from it (`change` -1)."""
    count_apple(law.patches, site, change)


def note_step(law: Law, i: int, cell: int) -> None:
    """Note that agent i, in play, ends its move on a cell."""
    note_trespass(law.boundaries, law.ledger, i, cell)


def settle(law: Law, turn: int, is_over: bool) -> None:
    """Settle the accounts at the end of a turn: charge for inspection, collect taxes, and forgive offences.

    `is_over`: whether the episode ends with this turn.
    """
    charge_inspection(law.monitoring, law.ledger)
    collect_taxes(law.taxes, law.ledger, turn, is_over)
    forgive(law.sanctions, turn)


def begin(law: Law) -> None:
    """Clear what institutions remember of the last episode."""
    forget_income(law.taxes)
    forget_offences(law.sanctions)


def refresh(law: Law, stock: UInt8) -> None:
    """Compute the arrays that follow from the rest of the state; `stock`: uint8 [K]."""
    count_apples(law.patches, stock)
    appoint(law.sanctioner, law.ledger)


def open_turn(law: Law, turn: int, stock_share: float) -> None:
    """Open the windows of quotas that begin with the coming turn, and close patches for it.

    `turn`: the coming turn, counted from 1; `stock_share`: the share of all sites that hold an apple.
    """
    open_windows(law.quotas, law.ledger, turn, stock_share)
    close_patches(law.patches)


def forbids(law: Law, i: int, cell: int, site: int) -> bool:
    """Return whether agent i observes that a harvest on a cell breaks a rule about places.

    `site`: the site on the cell, or -1.
    """
    return shows_foreign(law.boundaries, i, cell) or shows_closed(law.patches, site)


def shown_value(law: Law, entry: int, i: int, turn: int) -> float:
    """Return the value of an entry that agent i observes after a turn, 0..1; `entry`: an index of
    `Law.entries`."""
    module = law.entries.module[entry]
    what = law.entries.what[entry]
    argument = law.entries.argument[entry]
    if module == SEASONS:
        return show_season(law.seasons, what, argument, turn)
    if module == QUOTAS:
        return show_quota(law.quotas, what, argument, i, turn)
    if module == ROTATION:
        return show_rotation(law.rotation, law.ledger, what, argument, i, turn)
    if module == MONITORING:
        return show_monitoring(law.monitoring, law.ledger, what, argument, i)
    if module == VOTES:
        return show_in_force(law.votes, law.ledger, argument)
    if module == SANCTIONS:
        return show_level(law.sanctions, law.ledger, i)
    if module == MEDIATION:
        return show_mark(law.mediation, law.ledger, argument, i, turn)
    return show_may_fire(law.sanctioner, i)
