"""Institutions: rules that people make, such as quotas and taxes, on top of the rules of a game.

A game carries institutions as values: `Game(..., institutions=(Quota(share=0.8), Tax(rate=0.2)))`. Each kind
of institution has a module, with four parts:

- the value, a dataclass such as `Quota`, with the settings that a user chooses;
- its arrays, a named tuple such as `QuotaArrays` with its parameters, and with what it remembers in each of B
  worlds;
- `parameters(game)`, which returns the parameters among its arrays by name; a module without it takes them
  from the fields of the value;
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

from typing import Annotated, NamedTuple

from cprl.institutions.boundaries import Boundaries, BoundaryArrays
from cprl.institutions.governor import Governor
from cprl.institutions.institution import Institution
from cprl.institutions.ledger import COUNT_NAMES, Ledger
from cprl.institutions.mediation import Mediation, MediationArrays
from cprl.institutions.monitoring import Monitoring, MonitoringArrays
from cprl.institutions.patches import ClosedPatches, PatchArrays
from cprl.institutions.punishment import Punishment, PunishmentArrays
from cprl.institutions.quotas import Quota, QuotaArrays
from cprl.institutions.rotation import Rotation, RotationArrays
from cprl.institutions.sanctioner import Sanctioner, SanctionerArrays
from cprl.institutions.sanctions import GraduatedSanctions, SanctionArrays
from cprl.institutions.seasons import ClosedSeason, SeasonArrays
from cprl.institutions.taxes import Levies, Tax, TaxArrays
from cprl.institutions.votes import BallotArrays, Vote
from cprl.values.array_types import Int32


class Entries(NamedTuple):
    """The numbers that institutions show agents, one per index of axis E."""

    module: Annotated[Int32, "E"]
    """The index of the module among the fields of `Law`."""
    entry: Annotated[Int32, "E"]
    """The index of the number in the `entries` of its institution's class."""
    argument: Annotated[Int32, "E"]
    """The index of what the number is about: an institution of its kind, a ballot, or an agent."""
    shows_places: bool
    """Whether agents see the cells where they may not harvest."""
    first_plane: int
    """The index of the first channel of institutions in observations."""


class Law(NamedTuple):
    """The arrays of all institutions for B worlds.

    First come the arrays that institutions share, then those of each module, in the order in which their
    rules are called.
    """

    ledger: Ledger
    entries: Entries
    boundaries: BoundaryArrays
    seasons: SeasonArrays
    quotas: QuotaArrays
    patches: PatchArrays
    rotation: RotationArrays
    monitoring: MonitoringArrays
    taxes: TaxArrays
    votes: BallotArrays
    sanctions: SanctionArrays
    mediation: MediationArrays
    punishment: PunishmentArrays
    sanctioner: SanctionerArrays


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
