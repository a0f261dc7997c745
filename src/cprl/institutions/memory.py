"""The arrays of institutions: their memory in B worlds, what they output in a turn, and their parameters.

Letters: B worlds, N agents, C counts, S entries shown, V ballots, Q quotas, T taxes, P patches.
"""

from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.institutions.arrays import zeros

Ints: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]
Floats: TypeAlias = NDArray[np.float32]
Numbers: TypeAlias = NDArray[np.float64]
Longs: TypeAlias = NDArray[np.int64]

COUNTS: Final = (
    *("own_bites", "foreign_bites", "trespasses", "excess_bites", "closed_bites"),
    *("unjust_tags", "violations", "detections", "sanctions", "returns_to_violation"),
)
"""What is counted in an episode for each agent: bites where it may bite and in others' regions; turns in
others' regions; bites above a quota, and in a closed season or patch; unjust tags of its own; turns with a
violation; those that were detected; sanctions (of `GraduatedSanctions`); turns with a violation
later than a sanction."""
OWN_BITES, FOREIGN_BITES, TRESPASSES, EXCESS_BITES, CLOSED_BITES = range(5)
UNJUST_TAGS, VIOLATIONS, DETECTIONS, SANCTIONS, RETURNS = range(5, 10)


class Memory(NamedTuple):
    """What institutions remember of B worlds. All but `in_force` is cleared at an episode's begin."""

    in_force: Annotated[Numbers, "B V"]
    """What each ballot decided: a tax rate, a quota's share or an agent index."""
    allowed: Annotated[Numbers, "B Q"]
    """The apples that an agent may harvest in the current window."""
    taken: Annotated[Ints, "B Q N"]
    """Apples harvested in the current window."""
    income: Annotated[Numbers, "B T N"]
    """Apples harvested in the current period of each tax."""
    level: Annotated[Ints, "B N"]
    """The level of the next sanction."""
    offence_step: Annotated[Ints, "B N"]
    """The step of the last offence, or at which the level last fell."""
    violation_step: Annotated[Ints, "B N"]
    """The step of the last violation; 0 for never."""
    may_fire: Annotated[Bools, "B N"]
    """Whether the agent may fire; derived from `in_force`."""
    detected: Annotated[Bools, "B N"]
    """Whether a violation was detected in the last turn."""
    closed: Annotated[Bools, "B P"]
    """Whether the patch is closed in the coming turn; derived from the stock."""
    counts: Annotated[Ints, "B N C"]
    """The `COUNTS` of this episode."""
    sanctioned: Annotated[Bools, "B N"]
    """Whether the agent was sanctioned in an earlier turn of this episode; working memory."""
    broke: Annotated[Bools, "B N"]
    """Whether the agent violated a rule in this turn; working memory."""
    unjust: Annotated[Bools, "B N"]
    """Whether the agent tagged unjustly in this turn; working memory."""
    due: Annotated[Numbers, "B N"]
    """The fines that follow if this turn's violations are detected; working memory."""
    fines: Annotated[Numbers, "B N"]
    """Apples taken in this turn; working memory."""
    transfers: Annotated[Numbers, "B N"]
    """Apples given in this turn; working memory."""
    owed: Annotated[Numbers, "B N"]
    """The tax that each agent owes; working memory."""
    patch_stock: Annotated[Ints, "B P"]
    """Apples on each patch; derived from the stock."""


WORKING: Final = ("sanctioned", "broke", "unjust", "due", "fines", "transfers", "owed")
"""Entries of `Memory` that hold nothing between turns."""
DERIVED: Final = ("may_fire", "closed", "patch_stock")
"""Entries of `Memory` that are computed from the others and from the stock."""
REMEMBERED: Final = tuple(name for name in Memory._fields if name not in (*WORKING, *DERIVED))
"""Entries of `Memory` that are part of the state of a world."""


class Payments(NamedTuple):
    """What institutions output in a turn, written into arrays that the caller provides."""

    reward: Annotated[Floats, "B N"]
    """Harvest - fines + transfers."""
    fines: Annotated[Floats, "B N"]
    """Apples taken."""
    transfers: Annotated[Floats, "B N"]
    """Apples given."""
    violated: Annotated[Bools, "B N"]
    """Whether the agent broke a rule in this turn, detected or not."""
    counts: Annotated[Ints, "B N C"]
    """The `COUNTS` of this episode so far."""
    in_force: Annotated[Floats, "B V"]
    """What each ballot decided."""
    ballots_due: Annotated[Bools, "B V"]
    """Whether the ballot is held in the coming turn."""


SHOWN: Final = (
    *("quota left", "quota time", "season closed", "season time", "sanction level"),
    *("detected", "violator", "may fire", "in force", "elected"),
)
"""What an entry shows agents; see `cprl.institutions.showing`."""
QUOTA_LEFT, QUOTA_TIME, CLOSED, SEASON_TIME, LEVEL = range(5)
DETECTED, MARK, MAY_FIRE, IN_FORCE, IS_ELECTED = range(5, 10)


class InstitutionTables(NamedTuple):
    """All institutions of a game as parameters; a kind that the game does not have has arrays of length 0."""

    may_use: Bools
    """bool [boundaries, N, cells], whether the agent may use the cell."""
    bite_stopped: Bools
    """bool [boundaries], whether bites in others' regions do not happen."""
    bite_fine: Numbers
    """float64 [boundaries]."""
    step_is_violation: Bools
    """bool [boundaries]."""
    step_fine: Numbers
    """float64 [boundaries]."""
    may_use_shown: Bools
    """bool [boundaries], whether agents are shown where it forbids bites."""

    quota_unit: Numbers
    """float64 [Q], apples per agent and window at a share of 1."""
    quota_full: Numbers
    """float64 [Q], the most apples that an agent may harvest in a window, for what agents are shown."""
    quota_share: Numbers
    """float64 [Q]."""
    quota_ballot: Ints
    """[Q], the ballot that decides the share; -1 for none."""
    quota_steps: Ints
    """[Q], turns per window."""
    quota_by_stock: Bools
    quota_stopped: Bools
    """bool [Q], whether bites above the quota do not happen."""
    quota_fine: Numbers

    season_steps: Ints
    """[seasons], turns per period."""
    season_open: Ints
    """[seasons], the first turns of a period, in which it is open."""
    season_stopped: Bools
    season_fine: Numbers

    patch_of: Ints
    """[K], the patch of each site."""
    patch_sites: Ints
    """[P], sites per patch; [0] without `ClosedPatches`."""
    patch_below: int
    patch_stopped: bool
    patch_fine: float
    patch_shown: bool
    """Whether agents are shown where patches are closed."""

    tax_from: Numbers
    """float64 [T, brackets], where each bracket begins; infinite for those that a tax lacks."""
    tax_rate: Numbers
    """float64 [T, brackets]."""
    tax_ballot: Ints
    """[T], the ballot that decides the rate; -1 for none."""
    tax_steps: Ints
    """[T], turns per period."""
    tax_group: Ints
    """[T, N], the group within which it is paid out; -1 where it is lost."""

    ballot_options: Ints
    """[V], the number of choices."""
    ballot_choice: Numbers
    """float64 [V, choices]."""
    ballot_is_election: Bools
    ballot_episodes: Ints
    """[V], held in every such number of episodes."""
    ballot_override: Longs
    """int64 [V], overridden if a uniform 32-bit word is below this threshold."""

    detected_below: int
    """A violation is detected if a uniform 32-bit word is below this threshold."""
    monitor_cost: float
    monitor: int
    """Who pays it; -1 for all."""
    monitor_ballot: int
    """The ballot that elects who pays it; -1 for none."""

    sanction_steps: Ints
    """[N, levels], the time-out by shooter and level; [N, 0] without `GraduatedSanctions`."""
    sanction_fine: Numbers
    """float64 [levels]."""
    sanction_recovery: int
    """Turns; 0 for never."""
    sanctions_tags: bool
    sanctions_violations: bool

    mediation_turns: int
    """0 without `Mediation`."""
    mediation_refund: float

    may_fire: Bools
    """bool [N], whether the agent may fire where none is elected."""
    fire_ballot: int
    """The ballot that elects who may fire; -1 for none."""

    shown_kind: Ints
    """[S], what each entry shows agents."""
    shown_argument: Ints
    """[S], which one of its kind."""
    shows_places: bool
    """Whether agents see where bites are forbidden."""
    first_plane: int
    """The channel of observations that is the first one of institutions."""


class Law(NamedTuple):
    """What the institutions of a game need in a turn of B worlds, beside the worlds."""

    rules: InstitutionTables
    memory: Memory
    decisions: Longs
    """int64 [B, N], read in the first turn of an episode."""
    payments: Payments


def empty_memory(tables: InstitutionTables, *, worlds: int) -> Memory:
    """Memory for B worlds, all zero, except that the first choice of each ballot is in force."""
    empty = zeros(
        Memory,
        B=worlds,
        N=tables.may_fire.shape[0],
        C=len(COUNTS),
        V=tables.ballot_choice.shape[0],
        Q=tables.quota_unit.shape[0],
        T=tables.tax_steps.shape[0],
        P=tables.patch_sites.shape[0],
    )
    empty.in_force[:] = tables.ballot_choice[:, 0]
    return empty
