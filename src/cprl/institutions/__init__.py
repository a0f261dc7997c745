"""Institutions: rules that people make, a module a kind, and their scalar rules.

Values: `Game(..., institutions=(Quota(share=0.8), Tax(rate=0.2)))`. A module has the value, `Arrays`, which
are its parameters and what it remembers of B worlds, `parameters`, which fills them, and its rules, which act
at the hooks of a turn. In reading order:

    arrays      tuples of arrays, allocated and cut into worlds
    ledger      what all share: who broke what, what is owed, taken and given
    base        Institution, the base of all values
    boundaries  Boundaries: regions with owners
    seasons     ClosedSeason
    quotas      Quota
    patches     ClosedPatches
    rotation    Rotation: agents take turns in harvesting
    taxes       Tax, and Levies of nested groups
    votes       Vote, and how ballots are held
    monitoring  Monitoring: whether violations are detected, and what that costs
    sanctions   GraduatedSanctions
    mediation   Mediation of tags
    punishment  Punishment: fines that cost the one who fines
    sanctioner  Sanctioner: who may fire
    hooks       when in a turn the rules of each are called
    law         all of them together: their kinds, their arrays, and whether they fit a game
"""

from typing import NamedTuple

from cprl.institutions import (
    boundaries,
    mediation,
    monitoring,
    patches,
    punishment,
    quotas,
    rotation,
    sanctioner,
    sanctions,
    seasons,
    taxes,
    votes,
)
from cprl.institutions.base import Institution
from cprl.institutions.boundaries import Boundaries
from cprl.institutions.ledger import COUNTS, Entries, Ledger
from cprl.institutions.mediation import Mediation
from cprl.institutions.monitoring import Monitoring
from cprl.institutions.patches import ClosedPatches
from cprl.institutions.punishment import Punishment
from cprl.institutions.quotas import Quota
from cprl.institutions.rotation import Rotation
from cprl.institutions.sanctioner import Sanctioner
from cprl.institutions.sanctions import GraduatedSanctions
from cprl.institutions.seasons import ClosedSeason
from cprl.institutions.taxes import Levies, Tax
from cprl.institutions.votes import Vote


class Law(NamedTuple):
    """What institutions need in a turn of B worlds: the `Arrays` of each module, in the order in which their
    rules are called, and what all share."""

    ledger: Ledger
    entries: Entries
    boundaries: boundaries.Arrays
    seasons: seasons.Arrays
    quotas: quotas.Arrays
    patches: patches.Arrays
    rotation: rotation.Arrays
    monitoring: monitoring.Arrays
    taxes: taxes.Arrays
    votes: votes.Arrays
    sanctions: sanctions.Arrays
    mediation: mediation.Arrays
    punishment: punishment.Arrays
    sanctioner: sanctioner.Arrays


__all__ = [
    "COUNTS",
    "Boundaries",
    "ClosedPatches",
    "ClosedSeason",
    "GraduatedSanctions",
    "Institution",
    "Law",
    "Levies",
    "Mediation",
    "Monitoring",
    "Punishment",
    "Quota",
    "Rotation",
    "Sanctioner",
    "Tax",
    "Vote",
]
