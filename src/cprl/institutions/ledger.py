"""The ledger that all institutions share: violations of agents, their fines and their transfers.

Letters of axes here and in the modules of institutions: B worlds, N agents, C counts, V ballots, K sites.
"""

from typing import Annotated, Final, NamedTuple

from cprl.institutions.arrays import IN_STATE, STEPS, InState
from cprl.values.array_types import Bool, Float64, Int32

COUNT_NAMES: Final = (
    *("own_bites", "foreign_bites", "trespasses", "excess_bites", "closed_bites"),
    *("unjust_tags", "violations", "detections", "sanctions", "returns_to_violation"),
)
"""The names of what is counted for each agent in an episode:

- own_bites, foreign_bites: harvests where the agent may harvest, and in regions of others;
- trespasses: turns that end in regions of others;
- excess_bites: harvests above a quota;
- closed_bites: harvests in a closed season or patch, or out of turn;
- unjust_tags: unjust tags by the agent;
- violations, detections: turns with a violation, and those in which it was detected;
- sanctions: sanctions of `GraduatedSanctions`;
- returns_to_violation: turns with a violation after the agent was sanctioned.
"""
OWN_BITES, FOREIGN_BITES, TRESPASSES, EXCESS_BITES, CLOSED_BITES = range(5)
UNJUST_TAGS, VIOLATIONS, DETECTIONS, SANCTIONS, RETURNS = range(5, 10)


class Ledger(NamedTuple):
    """The arrays that all institutions share. All but `in_force` are cleared when an episode begins."""

    in_force: Annotated[Float64, "B V", InState(cleared=False)]
    """The result of each ballot, and last what a governor sets, see `cprl.Game.in_force`: a tax rate, the
    share of a quota, or the index of an agent."""
    violation_step: Annotated[Int32, "B N", STEPS]
    """The step of the agent's last violation; 0 for none in this episode."""
    detected: Annotated[Bool, "B N", IN_STATE]
    """True for agents of whom a violation was detected in the last turn."""
    counts: Annotated[Int32, "B N C", IN_STATE]
    """What each agent has done in this episode, by `COUNT_NAMES`."""
    sanctioned: Annotated[Bool, "B N"]
    """True for agents that were sanctioned in an earlier turn of this episode."""
    broke: Annotated[Bool, "B N"]
    """True for agents that violated a rule in this turn."""
    unjust: Annotated[Bool, "B N"]
    """True for agents that tagged unjustly in this turn."""
    due: Annotated[Float64, "B N"]
    """The fines that each agent pays if its violations of this turn are detected."""
    fines: Annotated[Float64, "B N"]
    """The apples that were taken from each agent in this turn."""
    transfers: Annotated[Float64, "B N"]
    """The apples that were given to each agent in this turn."""


class Entries(NamedTuple):
    """The numbers that institutions show agents, one per index of axis E."""

    module: Annotated[Int32, "E"]
    """The index of the module among the fields of `cprl.institutions.Law`."""
    what: Annotated[Int32, "E"]
    """The index of the entry in the `entries` of its institution's class."""
    argument: Annotated[Int32, "E"]
    """The index of what the entry is about: an institution of its kind, a ballot, or an agent."""
    places: bool
    """Whether agents see the cells where they may not harvest."""
    first_plane: int
    """The index of the first channel of institutions in observations."""


def forget_episode(ledger: Ledger) -> None:
    """Clear what was noted in the last episode."""
    for i in range(ledger.violation_step.shape[0]):
        ledger.violation_step[i] = 0
        ledger.detected[i] = False
        for count in range(ledger.counts.shape[1]):
            ledger.counts[i, count] = 0


def forget_turn(ledger: Ledger) -> None:
    """Clear what was noted in the last turn, and note which agents were sanctioned before this one."""
    for i in range(ledger.broke.shape[0]):
        ledger.sanctioned[i] = ledger.counts[i, SANCTIONS] > 0
        ledger.broke[i] = False
        ledger.unjust[i] = False
        ledger.due[i] = 0.0
        ledger.fines[i] = 0.0
        ledger.transfers[i] = 0.0


def violate(ledger: Ledger, i: int, count: int, fine: float) -> None:
    """Note a violation of agent i, with the fine that it costs if it is detected; `count`: an index of
    `COUNT_NAMES`, e.g. TRESPASSES."""
    ledger.broke[i] = True
    ledger.counts[i, count] += 1
    ledger.due[i] += fine


def count_violation(ledger: Ledger, i: int, turn: int) -> bool:
    """Return whether agent i violated a rule in this turn, and count the turn if it did."""
    ledger.broke[i] = ledger.broke[i] or ledger.unjust[i]
    if ledger.broke[i]:
        ledger.counts[i, VIOLATIONS] += 1
        ledger.counts[i, RETURNS] += ledger.sanctioned[i]
        ledger.violation_step[i] = turn
    return ledger.broke[i]


def charge(ledger: Ledger, i: int) -> None:
    """Let agent i pay the fines for its violations of this turn, since they were detected."""
    ledger.detected[i] = True
    ledger.counts[i, DETECTIONS] += 1
    ledger.fines[i] += ledger.due[i]
