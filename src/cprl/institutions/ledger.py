"""The ledger that all institutions share: violations of agents, their fines and their transfers.

In a turn, first `forget_turn` clears what the last turn noted. Then institutions call `note_violation`
whenever an agent breaks a rule. When all have moved, `count_violation` counts the turn for each agent that
did, and `charge` fines those in whom that is detected.

Letters of axes here and in the modules of institutions: B worlds, N agents, C counts, V ballots, K sites.
"""

from typing import Annotated, Final, NamedTuple

from cprl.institutions.arrays import IN_STATE, STEPS, InState
from cprl.values.array_types import Bool, Float64, Int32

COUNT_NAMES: Final = (
    "own_bites",
    "foreign_bites",
    "trespasses",
    "excess_bites",
    "closed_bites",
    "unjust_tags",
    "violations",
    "detections",
    "sanctions",
    "returns_to_violation",
)
"""The names of what is counted for each agent in an episode; a bite is a harvest:

- own_bites, foreign_bites: harvests where the agent may harvest, and in regions of others;
- trespasses: turns that end in regions of others;
- excess_bites: harvests above a quota;
- closed_bites: harvests in a closed season or patch, or out of turn;
- unjust_tags: unjust tags by the agent;
- violations, detections: turns with a violation, and those in which it was detected;
- sanctions: sanctions of `GraduatedSanctions`;
- returns_to_violation: turns with a violation after the agent was sanctioned.
"""
(
    OWN_BITES,
    FOREIGN_BITES,
    TRESPASSES,
    EXCESS_BITES,
    CLOSED_BITES,
    UNJUST_TAGS,
    VIOLATIONS,
    DETECTIONS,
    SANCTIONS,
    RETURNS_TO_VIOLATION,
) = range(len(COUNT_NAMES))
"""The index of each of `COUNT_NAMES`, in the same order."""


class Ledger(NamedTuple):
    """The arrays that all institutions share. All but `in_force` are cleared when an episode begins."""

    in_force: Annotated[Float64, "B V", InState(cleared=False)]
    """The result of each ballot, and last what a governor sets, see `cprl.Game.in_force`: a tax rate, the
    share of a quota, or the index of an agent."""
    violation_step: Annotated[Int32, "B N", STEPS]
    """The turn, counted from 1, of the agent's last violation; 0 for none in this episode."""
    detected: Annotated[Bool, "B N", IN_STATE]
    """True for agents of whom a violation was detected in the last turn."""
    counts: Annotated[Int32, "B N C", IN_STATE]
    """What each agent has done in this episode, by `COUNT_NAMES`."""
    sanctioned: Annotated[Bool, "B N"]
    """True for agents that were sanctioned in an earlier turn of this episode."""
    has_violated: Annotated[Bool, "B N"]
    """True for agents that violated a rule in this turn."""
    has_tagged_unjustly: Annotated[Bool, "B N"]
    """True for agents that tagged unjustly in this turn."""
    due_fines: Annotated[Float64, "B N"]
    """The fines that each agent pays if its violations of this turn are detected."""
    fines: Annotated[Float64, "B N"]
    """The apples that were taken from each agent in this turn."""
    transfers: Annotated[Float64, "B N"]
    """The apples that were given to each agent in this turn."""


def forget_episode(ledger: Ledger) -> None:
    """Clear what was noted in the last episode."""
    for agent in range(ledger.violation_step.shape[0]):
        ledger.violation_step[agent] = 0
        ledger.detected[agent] = False
        for count_index in range(ledger.counts.shape[1]):
            ledger.counts[agent, count_index] = 0


def forget_turn(ledger: Ledger) -> None:
    """Clear what was noted in the last turn, and note which agents were sanctioned before this one."""
    for agent in range(ledger.has_violated.shape[0]):
        ledger.sanctioned[agent] = ledger.counts[agent, SANCTIONS] > 0
        ledger.has_violated[agent] = False
        ledger.has_tagged_unjustly[agent] = False
        ledger.due_fines[agent] = 0.0
        ledger.fines[agent] = 0.0
        ledger.transfers[agent] = 0.0


def note_violation(ledger: Ledger, agent: int, count_index: int, fine: float) -> None:
    """Note a violation of an agent.

    Args:
        ledger: the ledger of the world.
        agent: the index of the agent.
        count_index: the index in `COUNT_NAMES` under which it counts, e.g. TRESPASSES.
        fine: the apples that it costs if it is detected.
    """
    ledger.has_violated[agent] = True
    ledger.counts[agent, count_index] += 1
    ledger.due_fines[agent] += fine


def count_violation(ledger: Ledger, agent: int, turn: int) -> bool:
    """Return whether an agent violated a rule in this turn, and count the turn if it did."""
    ledger.has_violated[agent] = ledger.has_violated[agent] or ledger.has_tagged_unjustly[agent]
    if ledger.has_violated[agent]:
        ledger.counts[agent, VIOLATIONS] += 1
        ledger.counts[agent, RETURNS_TO_VIOLATION] += ledger.sanctioned[agent]
        ledger.violation_step[agent] = turn
    return ledger.has_violated[agent]


def charge(ledger: Ledger, agent: int) -> None:
    """Let an agent pay the fines for its violations of this turn, since they were detected."""
    ledger.detected[agent] = True
    ledger.counts[agent, DETECTIONS] += 1
    ledger.fines[agent] += ledger.due_fines[agent]
