"""Limits on the harvest that fit the resource: quotas, closed seasons and closed patches."""

from dataclasses import dataclass
from typing import ClassVar, Final

from cprl.checks import SWITCH, Check, check_fields, count, number
from cprl.institutions.base import FINE, OBSERVED, Institution


@dataclass(frozen=True, kw_only=True)
class Quota(Institution):
    """A limit on each agent's harvest in a window of time, as a share of what the map can bear (Ostrom's
    principle 2, rules that fit local conditions).

    Windows follow one another from the first turn of an episode. In each, an agent may harvest up to
    share x yield x window_steps / N apples, where the yield is `cprl.commons.yields.sustainable_yield`, a
    proven lower bound. Agents observe the part of their quota that is left and the time left in the window.
    """

    share: float = 1.0
    """Of the sustainable yield that all agents together may take, at least 0."""

    window_steps: int = 50
    """The length of a window in turns, at least 1."""

    by_stock: bool = False
    """Whether the quota of a window is multiplied by the share of all sites that hold an apple when it
    begins."""

    fine: float | None = None
    """None: nobody can harvest more. A number, at least 0: it can be done, is a violation, and each bite
    above the quota costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"

    def __post_init__(self) -> None:
        check_fields(self, _QUOTA)


@dataclass(frozen=True, kw_only=True)
class ClosedSeason(Institution):
    """Times in which nobody may harvest (Ostrom's principle 2).

    Each period of `period_steps` turns, from the first turn of an episode, ends with `closed_steps` turns in
    which bites are forbidden. Agents observe whether the season is closed, and how long it stays so.
    """

    period_steps: int = 100
    """The length of a period in turns, at least 1."""

    closed_steps: int = 25
    """The last turns of each period, in which the season is closed: 0 to `period_steps`."""

    fine: float | None = None
    """None: nobody can harvest in a closed season. A number, at least 0: it can be done, is a violation, and
    each bite costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"

    def __post_init__(self) -> None:
        check_fields(self, _SEASON)
        if self.closed_steps > self.period_steps:
            raise ValueError(
                f"ClosedSeason.closed_steps is {self.closed_steps}; allowed: up to period_steps, "
                f"{self.period_steps}"
            )


@dataclass(frozen=True, kw_only=True)
class ClosedPatches(Institution):
    """A patch is closed while it holds too few apples (Ostrom's principle 2).

    A patch is a set of sites that are connected by being near each other (`Rules.regrow_radius_cells`). It is
    closed in every turn that begins with fewer than `below` apples on it. Agents observe, for each cell of
    their window, whether a bite there would break a rule.
    """

    below: int = 2
    """The number of apples, at least 0, below which a patch is closed."""

    fine: float | None = None
    """None: nobody can harvest in a closed patch. A number, at least 0: it can be done, is a violation, and
    each bite costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        check_fields(self, _PATCHES)


_QUOTA: Final[dict[str, Check]] = {
    **OBSERVED,
    "share": number(0, 1e6),
    "window_steps": count(1),
    "by_stock": SWITCH,
    "fine": FINE,
}
_SEASON: Final[dict[str, Check]] = {
    **OBSERVED,
    "period_steps": count(1),
    "closed_steps": count(0),
    "fine": FINE,
}
_PATCHES: Final[dict[str, Check]] = {**OBSERVED, "below": count(0), "fine": FINE}
