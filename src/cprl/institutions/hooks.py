"""The hooks of a turn, on one world: what the rules of the game ask and tell institutions, and who acts then.

Each hook calls rules of the modules of institutions, in the order of `Law`, so sums of fines do not depend on
the order of institutions in a game. Kinds that a game lacks have arrays of length 0, so that no combination
compiles anything. What a tag costs and who is detected is asked of `sanctions`, `mediation`, `punishment`
and `monitoring` by the turn itself.
"""

from typing import Protocol

from cprl.institutions import Law
from cprl.institutions.boundaries import count_own_bites, is_foreign, note_trespass, shows_foreign
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
from cprl.values.arrays import Bool, Float64, UInt8

SEASONS, QUOTAS, ROTATION, MONITORING, VOTES, SANCTIONS, MEDIATION = map(
    Law._fields.index, ("seasons", "quotas", "rotation", "monitoring", "votes", "sanctions", "mediation")
)
"""The modules that show something, in `Entries.module`."""


class Limits(Protocol):
    """The `Arrays` of a module whose limits a harvest can break, by limit."""

    @property
    def is_stopped(self) -> Bool:
        """Whether a harvest that breaks the limit does not happen."""

    @property
    def fine(self) -> Float64:
        """What it costs else, if it is detected."""


def stops_bite(law: Law, i: int, cell: int, site: int, turn: int) -> bool:
    """Return whether an institution keeps agent i from harvesting a site, which is on a cell."""
    return breaks(law, i, cell, site, turn, False)


def note_bite(law: Law, i: int, cell: int, site: int, turn: int) -> None:
    """Note that agent i has harvested a site, and the limits that it broke."""
    breaks(law, i, cell, site, turn, True)
    count_own_bites(law.boundaries, law.ledger, i, cell)
    use_quotas(law.quotas, i)
    note_income(law.taxes, i)


def breaks(law: Law, i: int, cell: int, site: int, turn: int, has_bitten: bool) -> bool:
    """Return whether a limit stops a harvest that would break it; of one that has happened, note what it
    broke instead."""
    for n in range(law.boundaries.fine.shape[0]):
        is_broken = is_foreign(law.boundaries, n, i, cell)
        if is_broken and stops(law.boundaries, law.ledger, n, i, FOREIGN_BITES, has_bitten):
            return True
    for n in range(law.seasons.fine.shape[0]):
        is_broken = is_season_closed(law.seasons, n, turn)
        if is_broken and stops(law.seasons, law.ledger, n, i, CLOSED_BITES, has_bitten):
            return True
    for n in range(law.quotas.fine.shape[0]):
        is_broken = is_used_up(law.quotas, n, i)
        if is_broken and stops(law.quotas, law.ledger, n, i, EXCESS_BITES, has_bitten):
            return True
    for n in range(law.patches.fine.shape[0]):
        is_broken = is_patch_closed(law.patches, site)
        if is_broken and stops(law.patches, law.ledger, n, i, CLOSED_BITES, has_bitten):
            return True
    for n in range(law.rotation.fine.shape[0]):
        is_broken = is_out_of_turn(law.rotation, law.ledger, n, i, turn)
        if is_broken and stops(law.rotation, law.ledger, n, i, CLOSED_BITES, has_bitten):
            return True
    return False


def stops(limits: Limits, ledger: Ledger, n: int, i: int, count: int, has_bitten: bool) -> bool:
    """Return whether limit n stops a harvest of agent i that would break it; of one that has happened, note
    the violation, counted as `count`, instead."""
    if has_bitten:
        violate(ledger, i, count, limits.fine[n])
        return False
    return limits.is_stopped[n]


def note_apple(law: Law, site: int, change: int) -> None:
    """Note that an apple has appeared on a site, change 1, or is gone from it, change -1, in whatever way."""
    count_apple(law.patches, site, change)


def note_step(law: Law, i: int, cell: int) -> None:
    """Note that agent i, in play, ends its move on a cell."""
    note_trespass(law.boundaries, law.ledger, i, cell)


def settle(law: Law, turn: int, is_over: bool) -> None:
    """Collect, pay and forgive at the end of a turn, with which the episode may be over."""
    charge_inspection(law.monitoring, law.ledger)
    collect_taxes(law.taxes, law.ledger, turn, is_over)
    forgive(law.sanctions, turn)


def begin(law: Law) -> None:
    """Clear what is remembered of the last episode."""
    forget_income(law.taxes)
    forget_offences(law.sanctions)


def refresh(law: Law, stock: UInt8) -> None:
    """Write what is derived from the rest of a state; `stock`: uint8 [K]."""
    count_apples(law.patches, stock)
    appoint(law.sanctioner, law.ledger)


def open_turn(law: Law, turn: int, stock_share: float) -> None:
    """Begin what begins with the coming turn, counted from 1; `stock_share`: of all sites, those with an
    apple."""
    open_windows(law.quotas, law.ledger, turn, stock_share)
    close_patches(law.patches)


def forbids(law: Law, i: int, cell: int, site: int) -> bool:
    """Return whether agent i sees that a harvest on a cell breaks a rule about places; `site`: -1 for
    none."""
    return shows_foreign(law.boundaries, i, cell) or shows_closed(law.patches, site)


def shown(law: Law, entry: int, i: int, turn: int) -> float:
    """Return an entry of `Law.entries` that agent i sees after a turn, 0..1."""
    module, what, argument = law.entries.module[entry], law.entries.what[entry], law.entries.argument[entry]
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
        return show_level(law.sanctions, i)
    if module == MEDIATION:
        return show_mark(law.mediation, law.ledger, argument, i, turn)
    return show_may_fire(law.sanctioner, i)
