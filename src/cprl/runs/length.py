"""Length: for how many episodes or steps each replica is trained."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Any, Final, Literal, Self

Unit = Literal["episodes", "steps"]
UNITS: Final[tuple[Unit, ...]] = ("episodes", "steps")
"""The two fields of an experiment of which one is its length; also flags of the command line."""


@dataclass(frozen=True)
class Length:
    """The length of the training of each replica.

    Args:
        number: the episodes or steps of each replica; a turn of W worlds is W steps.
        unit: whether `number` counts episodes or steps.
        clock: the most steps of an episode; None in a game without a clock.
    """

    number: int
    unit: Unit
    clock: int | None = field(default=None, compare=False)

    @classmethod
    def of(cls, config: Mapping[str, Any], clock: int | None = None) -> Self:
        """Return the length in the table of an experiment; 0 if a damaged table has no number."""
        unit: Unit = "episodes" if config.get("steps") is None else "steps"
        number = config.get(unit)
        if not isinstance(number, int):
            number = 0
        return cls(number, unit, clock)

    def __str__(self) -> str:
        unit = self.unit.removesuffix("s") if self.number == 1 else self.unit
        return f"{self.number:,} {unit}"

    @property
    def flag(self) -> str:
        """Return the flag of the command line that sets it."""
        return f"--{self.unit}"

    @property
    def is_of_steps(self) -> bool:
        return self.unit == "steps"

    @property
    def episodes(self) -> int:
        """Return the expected episodes of each replica: a length in steps is divided by the clock, and is 1
        episode in a game without a clock."""
        return ceil(self.number / (self.clock or self.number)) if self.is_of_steps else self.number

    def reached(self, *, episodes: float, steps: float) -> float:
        """Return the progress of a replica after so many episodes and steps, in `unit`, at most `number`."""
        count = steps if self.is_of_steps else episodes
        return min(self.number, count)

    def is_over(self, *, episodes: int, steps: int) -> bool:
        """Return whether a replica has reached the length after so many episodes and steps."""
        return self.reached(episodes=episodes, steps=steps) == self.number

    def is_shorter_than(self, other: "Length") -> bool:
        """Return whether it can be extended to another length in the same unit."""
        return self.unit == other.unit and 0 < self.number < other.number


def without_length(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table of an experiment without its length, for comparison."""
    return {**config, **dict.fromkeys(UNITS)}
