"""ClosedSeason: times in which nobody may harvest."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

from cprl.institutions.institution import Amount, Limit
from cprl.values import Natural, Positive
from cprl.values.array_types import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class ClosedSeason(Limit):
    """Times in which nobody may harvest.

    This is Ostrom's principle 2, rules that fit local conditions. An episode is divided into periods of
    `period_steps` turns, and in the last `closed_steps` turns of each period the season is closed. Agents
    observe whether the season is closed, and how long it stays open or closed.
    """

    period_steps: Positive = 100
    """The length of a period in turns."""

    closed_steps: Natural = 25
    """The number of turns at the end of each period in which the season is closed: 0 to `period_steps`."""

    fine: Amount | None = None
    """The fine in apples for each harvest in a closed season, which is a violation, if it is detected. None
    makes such harvests impossible."""

    counts: ClassVar[tuple[str, ...]] = ("closed_bites",)
    entries: ClassVar[tuple[str, ...]] = ("season closed", "season time")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.closed_steps > self.period_steps:
            raise ValueError(
                f"ClosedSeason.closed_steps is {self.closed_steps}; allowed: up to period_steps, "
                f"{self.period_steps}"
            )


class SeasonArrays(NamedTuple):
    """The parameters of all `ClosedSeason` of a game, one of them per index of axis S."""

    period_steps: Annotated[Int32, "S"]
    closed_steps: Annotated[Int32, "S"]
    is_stopped: Annotated[Bool, "S"]
    fine: Annotated[Float64, "S"]


def is_season_closed(seasons: SeasonArrays, season: int, turn: int) -> bool:
    """Return whether a season is closed in a turn, counted from 1."""
    return (turn - 1) % seasons.period_steps[season] >= seasons.period_steps[season] - seasons.closed_steps[
        season
    ]


def show_season(seasons: SeasonArrays, entry: int, season: int, turn: int) -> float:
    """Return what agents observe of a season after a turn, 0..1.

    Entry 0 is 1 if the season is closed in the coming turn; entry 1 is the time until that changes, in
    periods. `entry`: its index.
    """
    if entry == 0:
        return 1.0 if is_season_closed(seasons, season, turn + 1) else 0.0
    period = seasons.period_steps[season]
    within = turn % period
    open_steps = period - seasons.closed_steps[season]
    return ((open_steps if within < open_steps else period) - within) / period
