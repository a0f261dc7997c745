"""Monitoring: violations are detected, or not, at a cost."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, NamedTuple

from cprl.institutions.base import (
    A_RULE_TO_BREAK,
    Amount,
    Ballot,
    Institution,
    check_agent_indices,
    check_no_election,
    threshold,
    with_ballots,
)
from cprl.institutions.ledger import Ledger
from cprl.values import Natural, Positive, Share

ELECTED: Final = "elected"


@dataclass(frozen=True, kw_only=True)
class Monitoring(Institution):
    """Violations are detected with a probability, and inspection has a cost (Ostrom's principle 4).

    Each turn in which an agent violates a rule is detected with probability `prob`, by the game's own
    counters; only then fines and sanctions follow. Without Monitoring every violation is detected. Agents
    observe whether they were detected in the last turn.
    """

    prob: Share = 0.5
    """The probability that a turn with a violation is detected."""

    cost: Amount = 0.0
    """Apples per turn that inspection costs."""

    monitor: Natural | Literal["elected"] | None = None
    """Who pays the cost: an agent index, "elected" for the one that all elect, or None for all in equal
    parts."""

    period_episodes: Positive = 1
    """An election is held in every such number of episodes, from the first one."""

    entries: ClassVar[tuple[str, ...]] = ("detected", "elected")
    at_most: ClassVar[int | None] = 1
    counts: ClassVar[tuple[str, ...]] = ("detections",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.monitor != ELECTED:
            check_no_election(self, f'monitor is "{ELECTED}"')

    def ballot(self, agents: int) -> Ballot | None:
        if self.monitor != ELECTED:
            return None
        return Ballot("who monitors", tuple(map(float, range(agents))), True, self.period_episodes, 0.0)

    def shows(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("detected", 0), *([("elected", ballot)] if self.monitor == ELECTED else [])]

    def check(self, game: Any) -> None:
        if isinstance(self.monitor, int):
            check_agent_indices("Monitoring.monitor", (self.monitor,), game.agents)
        if self.cost == 0 and not any(other.can_be_broken for other in game.institutions):
            raise ValueError(
                f"Monitoring has no violation to detect; allowed: {A_RULE_TO_BREAK}, or a cost above 0"
            )


class Arrays(NamedTuple):
    """How violations are detected."""

    detected_below: int
    """A violation is detected if a uniform 32-bit word is below this threshold."""
    cost: float
    payer: int
    """Who pays it; -1 for all."""
    ballot: int
    """The ballot that elects who pays it; -1 for none."""


def parameters(game: Any) -> dict[str, Any]:
    monitoring, ballot = next(iter(with_ballots(game, Monitoring)), (Monitoring(prob=1.0), -1))
    payer = monitoring.monitor if isinstance(monitoring.monitor, int) else -1
    below = threshold(monitoring.prob)
    return {"detected_below": below, "cost": monitoring.cost, "payer": payer, "ballot": ballot}


def charge_inspection(monitoring: Arrays, ledger: Ledger) -> None:
    """Charge the cost of inspection to who monitors, or to all in equal parts."""
    if monitoring.cost == 0:
        return
    agents, payer = ledger.fines.shape[0], monitoring.payer
    if monitoring.ballot >= 0:
        payer = int(ledger.in_force[monitoring.ballot])
    for i in range(agents):
        if payer == i:
            ledger.fines[i] += monitoring.cost
        elif payer < 0:
            ledger.fines[i] += monitoring.cost / agents


def show_monitoring(monitoring: Arrays, ledger: Ledger, what: int, ballot: int, i: int) -> float:
    """1 if a violation of the agent was detected in the last turn; with an election, 1 if it monitors."""
    if what == 0:
        return 1.0 if ledger.detected[i] else 0.0
    return 1.0 if ledger.in_force[ballot] == i else 0.0
