"""Monitoring: violations are detected with a probability, and inspection costs apples."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, NamedTuple

from cprl.institutions.institution import (
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
"""The value of `Monitoring.monitor` for an agent that all agents elect."""


@dataclass(frozen=True, kw_only=True)
class Monitoring(Institution):
    """Violations are detected only with a probability, and inspection has a cost.

    This is Ostrom's principle 4, monitoring. Each turn in which an agent violates a rule is detected with
    probability `prob`, drawn from the random numbers of the game, and only then fines and sanctions follow.
    In a game without Monitoring every violation is detected. Agents observe whether a violation of theirs was
    detected in the last turn.
    """

    prob: Share = 0.5
    """The probability that a turn with a violation is detected."""

    cost: Amount = 0.0
    """The cost of inspection in apples per turn."""

    monitor: Natural | Literal["elected"] | None = None
    """The agent that pays the cost: the index of an agent, "elected" for an agent that all elect, or None for
    all agents in equal parts."""

    period_episodes: Positive = 1
    """The number of episodes from one election to the next; the first one is in the first episode."""

    entries: ClassVar[tuple[str, ...]] = ("detected", "elected")
    most_in_game: ClassVar[int | None] = 1
    counts: ClassVar[tuple[str, ...]] = ("detections",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.monitor != ELECTED:
            check_no_election(self, f'monitor is "{ELECTED}"')

    def ballot(self, agents: int) -> Ballot | None:
        if self.monitor != ELECTED:
            return None
        return Ballot(
            title="who monitors",
            choices=tuple(map(float, range(agents))),
            is_election=True,
            period_episodes=self.period_episodes,
        )

    def shown_entries(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("detected", 0), *([("elected", ballot)] if self.monitor == ELECTED else [])]

    def check(self, game: Any) -> None:
        if isinstance(self.monitor, int):
            check_agent_indices("Monitoring.monitor", (self.monitor,), game.agents)
        if self.cost == 0 and not any(other.can_be_broken for other in game.institutions):
            raise ValueError(
                f"Monitoring has no violation to detect; allowed: {A_RULE_TO_BREAK}, or a cost above 0"
            )


class MonitoringArrays(NamedTuple):
    """The parameters of the detection of violations, in any game."""

    detected_below: int
    """A violation is detected if a uniform 32-bit word is below this threshold."""
    cost: float
    payer: int
    """The index of the agent that pays the cost; -1 for all agents."""
    ballot: int
    """The ballot that elects the payer; -1 for none."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `MonitoringArrays`; without `Monitoring` every violation is detected."""
    monitoring, ballot = next(iter(with_ballots(game, Monitoring)), (Monitoring(prob=1.0), -1))
    payer = monitoring.monitor if isinstance(monitoring.monitor, int) else -1
    below = threshold(monitoring.prob)
    return {"detected_below": below, "cost": monitoring.cost, "payer": payer, "ballot": ballot}


def charge_inspection(monitoring: MonitoringArrays, ledger: Ledger) -> None:
    """Let the agent that monitors, or all agents in equal parts, pay the cost of inspection."""
    if monitoring.cost == 0:
        return
    agents = ledger.fines.shape[0]
    payer = monitoring.payer
    if monitoring.ballot >= 0:
        payer = int(ledger.in_force[monitoring.ballot])
    for agent in range(agents):
        if payer == agent:
            ledger.fines[agent] += monitoring.cost
        elif payer < 0:
            ledger.fines[agent] += monitoring.cost / agents


def show_monitoring(
    monitoring: MonitoringArrays, ledger: Ledger, entry: int, ballot: int, agent: int
) -> float:
    """Return what an agent observes of monitoring after a turn, 0 or 1.

    Entry 0 is 1 if a violation of the agent was detected in the turn; entry 1 is 1 if it is the elected
    monitor. `entry`: its index.
    """
    if entry == 0:
        return 1.0 if ledger.detected[agent] else 0.0
    return 1.0 if ledger.in_force[ballot] == agent else 0.0
