"""The ledger: what all institutions share, of who broke what, and of what is owed, taken and given.

Letters of axes here and in the modules of institutions: B worlds, N agents, C counts, V ballots, K sites.
"""

from typing import Annotated, Final, NamedTuple

from cprl.institutions.arrays import STATE, STEPS, Kept
from cprl.values.arrays import Bool, Float64, Int32

COUNTS: Final = (
    *("own_bites", "foreign_bites", "trespasses", "excess_bites", "closed_bites"),
    *("unjust_tags", "violations", "detections", "sanctions", "returns_to_violation"),
)
"""What is counted in an episode for each agent: bites where it may bite and in others' regions; turns in
others' regions; bites above a quota; in a closed season or patch, or out of turn; unjust tags of its own;
turns with a violation; those that were detected; sanctions (of `GraduatedSanctions`); turns with a violation
later than a sanction."""
OWN_BITES, FOREIGN_BITES, TRESPASSES, EXCESS_BITES, CLOSED_BITES = range(5)
UNJUST_TAGS, VIOLATIONS, DETECTIONS, SANCTIONS, RETURNS = range(5, 10)


class Ledger(NamedTuple):
    """What institutions share. All but `in_force` is cleared at an episode's begin."""

    in_force: Annotated[Float64, "B V", Kept(cleared=False)]
    """What each ballot decided: a tax rate, a quota's share or an agent index."""
    violation_step: Annotated[Int32, "B N", STEPS]
    """The step of the last violation; 0 for never."""
    detected: Annotated[Bool, "B N", STATE]
    """Whether a violation was detected in the last turn."""
    counts: Annotated[Int32, "B N C", STATE]
    """The `COUNTS` of this episode."""
    sanctioned: Annotated[Bool, "B N"]
    """Whether the agent was sanctioned in an earlier turn of this episode."""
    broke: Annotated[Bool, "B N"]
    """Whether the agent violated a rule in this turn."""
    unjust: Annotated[Bool, "B N"]
    """Whether the agent tagged unjustly in this turn."""
    due: Annotated[Float64, "B N"]
    """The fines that follow if this turn's violations are detected."""
    fines: Annotated[Float64, "B N"]
    """Apples taken in this turn."""
    transfers: Annotated[Float64, "B N"]
    """Apples given in this turn."""


class Entries(NamedTuple):
    """What agents are shown of institutions, one entry per index of axis E."""

    module: Annotated[Int32, "E"]
    """The index of the module among the fields of `cprl.institutions.Law`."""
    what: Annotated[Int32, "E"]
    """The index in the `entries` of its kind."""
    argument: Annotated[Int32, "E"]
    """Which one of its kind."""
    places: bool
    """Whether agents see where bites are forbidden."""
    first_plane: int
    """The channel of observations that is the first one of institutions."""


def forget_episode(ledger: Ledger) -> None:
    """Clear what is noted within an episode."""
    for i in range(ledger.violation_step.shape[0]):
        ledger.violation_step[i] = 0
        ledger.detected[i] = False
        for count in range(ledger.counts.shape[1]):
            ledger.counts[i, count] = 0


def forget_turn(ledger: Ledger) -> None:
    """Clear what is noted within a turn."""
    for i in range(ledger.broke.shape[0]):
        ledger.sanctioned[i] = ledger.counts[i, SANCTIONS] > 0
        ledger.broke[i] = False
        ledger.unjust[i] = False
        ledger.due[i] = 0.0
        ledger.fines[i] = 0.0
        ledger.transfers[i] = 0.0


def violate(ledger: Ledger, i: int, count: int, fine: float) -> None:
    """Note a violation of agent i, of one kind of count, that costs a fine if it is detected."""
    ledger.broke[i] = True
    ledger.counts[i, count] += 1
    ledger.due[i] += fine


def count_violation(ledger: Ledger, i: int, turn: int) -> bool:
    """Count a turn in which agent i violated a rule; return whether it did."""
    ledger.broke[i] = ledger.broke[i] or ledger.unjust[i]
    if ledger.broke[i]:
        ledger.counts[i, VIOLATIONS] += 1
        ledger.counts[i, RETURNS] += ledger.sanctioned[i]
        ledger.violation_step[i] = turn
    return ledger.broke[i]


def charge(ledger: Ledger, i: int) -> None:
    """Agent i pays for the violations of this turn, which were detected."""
    ledger.detected[i] = True
    ledger.counts[i, DETECTIONS] += 1
    ledger.fines[i] += ledger.due[i]
