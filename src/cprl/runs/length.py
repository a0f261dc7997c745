"""How long each replica is trained: so many episodes, or so many steps."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Any, Final, Literal, Self

Unit = Literal["episodes", "steps"]
UNITS: Final[tuple[Unit, ...]] = ("episodes", "steps")
"""The fields of an experiment, one of which says its length; and flags of the command line."""


@dataclass(frozen=True)
class Length:
    """How long each replica is trained.

    Args:
        number: how many episodes each replica plays, or how many steps it takes; a turn of W worlds is W
            steps.
        unit: which of the two.
        clock: the steps of an episode at most; None in a game without a clock.
    """

    number: int
    unit: Unit
    clock: int | None = field(default=None, compare=False)

    @classmethod
    def of(cls, config: Mapping[str, Any], clock: int | None = None) -> Self:
        """Return the length in the table of an experiment; 0 where a damaged one has no number."""
        unit: Unit = "episodes" if config.get("steps") is None else "steps"
        number = config.get(unit)
        return cls(number if isinstance(number, int) else 0, unit, clock)

    def __str__(self) -> str:
        return f"{self.number:,} {self.unit}"

    @property
    def flag(self) -> str:
        """The flag of the command line that says it."""
        return f"--{self.unit}"

    @property
    def is_of_steps(self) -> bool:
        return self.unit == "steps"

    @property
    def episodes(self) -> int:
        """The episodes of each replica that are expected: of so many steps, as many as these are where each
        lasts as long as the clock lets it, and 1 in a game without a clock."""
        return ceil(self.number / (self.clock or self.number)) if self.is_of_steps else self.number

    def reached(self, *, episodes: float, steps: float) -> float:
        """Return how far a replica with so many episodes and steps is, in its unit; at most its number."""
        return min(self.number, steps if self.is_of_steps else episodes)

    def is_over(self, *, episodes: int, steps: int) -> bool:
        """Return whether a replica with so many episodes and steps has reached it."""
        return self.reached(episodes=episodes, steps=steps) == self.number

    def is_shorter_than(self, other: "Length") -> bool:
        """Return whether it can be extended to another length, of the same unit."""
        return self.unit == other.unit and 0 < self.number < other.number


def without_length(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table of an experiment without its length, to be compared with others."""
    return {**config, **dict.fromkeys(UNITS)}
