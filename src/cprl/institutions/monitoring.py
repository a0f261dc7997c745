"""Monitoring: violations are detected, or not, at a cost."""

from dataclasses import dataclass
from typing import ClassVar, Final, Literal

from cprl.institutions.base import Amount, Institution, check_agent_indices, check_no_election
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

    principle: ClassVar[str] = "4 monitoring"
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.monitor != ELECTED:
            check_no_election(self, f'monitor is "{ELECTED}"')

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        if isinstance(self.monitor, int):
            check_agent_indices("Monitoring.monitor", (self.monitor,), agents)
