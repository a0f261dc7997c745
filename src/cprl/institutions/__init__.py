"""Institutions: rules that people make, such as quotas and taxes, on top of the rules of a game.

A game carries institutions as values: `Game(..., institutions=(Quota(share=0.8), Tax(rate=0.2)))`. Each kind
of institution has a module, with four parts:

- the value, a dataclass such as `Quota`, with the settings that a user chooses;
- `Arrays`, a named tuple with its parameters, and with what it remembers in each of B worlds;
- `parameters(game)`, which returns the parameters among `Arrays`; a module without it takes them from the
  fields of the value;
- its rules, functions that `hooks` calls at fixed moments of a turn, and that Numba compiles.

Modules in reading order:

    arrays       allocates named tuples of arrays, and takes single worlds out of them
    ledger       Ledger, which all institutions share: violations, fines and transfers
    equality     how evenly agents share what they have
    institution  Institution, the base class of all values
    boundaries   Boundaries: regions with owners
    seasons      ClosedSeason: times without harvest
    quotas       Quota: a limit on each agent's harvest
    patches      ClosedPatches: no harvest where few apples are left
    rotation     Rotation: agents harvest in turn
    taxes        Tax on the harvest, and Levies of nested groups
    votes        Vote on a tax or a quota, and how ballots are held
    governor     Governor: sets the number of another institution every few turns
    monitoring   Monitoring: violations are detected by chance, at a cost
    sanctions    GraduatedSanctions: time-outs and fines that grow with the offences
    mediation    Mediation: unjust tags are refunded
    punishment   Punishment: fines that also cost the agent that fines
    sanctioner   Sanctioner: the only agents that may fire
    hooks        calls the rules of all institutions at the moments of a turn
    law          joins the institutions of a game: their parameters, arrays and checks
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
from cprl.institutions.boundaries import Boundaries
from cprl.institutions.governor import Governor
from cprl.institutions.institution import Institution
from cprl.institutions.ledger import COUNT_NAMES, Entries, Ledger
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
    """The arrays of all institutions for B worlds.

    First come the arrays that institutions share, then the `Arrays` of each module, in the order in which
    their rules are called.
    """

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
    "COUNT_NAMES",
    "Boundaries",
    "ClosedPatches",
    "ClosedSeason",
    "Governor",
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
