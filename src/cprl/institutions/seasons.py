"""ClosedSeason: times in which nobody may harvest."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.base import Amount, Limit, columns
from cprl.values import Natural, Positive
from cprl.values.arrays import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class ClosedSeason(Limit):
    """Times in which nobody may harvest (Ostrom's principle 2).

    Each period of `period_steps` turns, from the first turn of an episode, ends with `closed_steps` turns in
    which bites are forbidden. Agents observe whether the season is closed, and how long it stays so.
    """

    period_steps: Positive = 100
    """The length of a period in turns."""

    closed_steps: Natural = 25
    """The last turns of each period, in which the season is closed: 0 to `period_steps`."""

    fine: Amount | None = None
    """None: nobody can harvest in a closed season. A number: it can be done, is a violation, and each bite
    costs so many apples if it is detected."""

    counts: ClassVar[tuple[str, ...]] = ("closed_bites",)
    entries: ClassVar[tuple[str, ...]] = ("season closed", "season time")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.closed_steps > self.period_steps:
            raise ValueError(
                f"ClosedSeason.closed_steps is {self.closed_steps}; allowed: up to period_steps, "
                f"{self.period_steps}"
            )


class Arrays(NamedTuple):
    """All closed seasons of a game, one per index of axis S."""

    period_steps: Annotated[Int32, "S"]
    closed_steps: Annotated[Int32, "S"]
    is_stopped: Annotated[Bool, "S"]
    fine: Annotated[Float64, "S"]


def parameters(game: Any) -> dict[str, Any]:
    return columns(ClosedSeason, Arrays, game)


def is_season_closed(seasons: Arrays, s: int, turn: int) -> bool:
    """Return whether a season is closed in a turn, counted from 1."""
    return (turn - 1) % seasons.period_steps[s] >= seasons.period_steps[s] - seasons.closed_steps[s]


def show_season(seasons: Arrays, what: int, s: int, turn: int) -> float:
    """1 if the coming turn is closed; the part of a period until that changes."""
    if what == 0:
        return 1.0 if is_season_closed(seasons, s, turn + 1) else 0.0
    period, within = seasons.period_steps[s], turn % seasons.period_steps[s]
    open_steps = period - seasons.closed_steps[s]
    return ((open_steps if within < open_steps else period) - within) / period
