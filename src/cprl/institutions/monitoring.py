"""Monitoring: violations are detected, or not, at a cost."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final

from cprl.checks import Check, check_fields, count, is_count
from cprl.institutions.base import (
    AMOUNT,
    OBSERVED,
    PROBABILITY,
    Institution,
    check_agent_indices,
    check_no_election,
)

ELECTED: Final = "elected"


@dataclass(frozen=True, kw_only=True)
class Monitoring(Institution):
    """Violations are detected with a probability, and inspection has a cost (Ostrom's principle 4).

    Each turn in which an agent violates a rule is detected with probability `prob`, by the game's own
    counters; only then fines and sanctions follow. Without Monitoring every violation is detected. Agents
    observe whether they were detected in the last turn.
    """

    prob: float = 0.5
    """The probability that a turn with a violation is detected, 0..1."""

    cost: float = 0.0
    """Apples per turn that inspection costs, at least 0."""

    monitor: int | str | None = None
    """Who pays the cost: an agent index, "elected" for the one that all elect, or None for all in equal
    parts."""

    period_episodes: int = 1
    """An election is held in every such number of episodes, from the first one."""

    principle: ClassVar[str] = "4 monitoring"
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)
        if self.monitor != ELECTED:
            check_no_election(self, f'monitor is "{ELECTED}"')

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        if isinstance(self.monitor, int):
            check_agent_indices("Monitoring.monitor", (self.monitor,), agents)


def _is_monitor(value: Any) -> bool:
    return value is None or is_count(value, 0) or value == ELECTED


_CHECKS: Final[dict[str, Check]] = {
    **OBSERVED,
    "prob": PROBABILITY,
    "cost": AMOUNT,
    "monitor": Check(_is_monitor, 'an agent index, "elected" or None'),
    "period_episodes": count(1),
}
