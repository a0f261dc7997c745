"""Limits on the harvest that fit the resource: quotas, closed seasons and closed patches."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from cprl.institutions.base import Amount, Institution
from cprl.values import Natural, Positive, Range


@dataclass(frozen=True, kw_only=True)
class Quota(Institution):
    """A limit on each agent's harvest in a window of time, as a share of what the map can bear (Ostrom's
    principle 2, rules that fit local conditions).

    Windows follow one another from the first turn of an episode. In each, an agent may harvest up to
    share x yield x window_steps / N apples, where the yield is `cprl.commons.yields.sustainable_yield`, a
    proven lower bound. Agents observe the part of their quota that is left and the time left in the window.
    """

    share: Annotated[float, Range(0, 1e6)] = 1.0
    """Of the sustainable yield that all agents together may take."""

    window_steps: Positive = 50
    """The length of a window in turns."""

    by_stock: bool = False
    """Whether the quota of a window is multiplied by the share of all sites that hold an apple when it
    begins."""

    fine: Amount | None = None
    """None: nobody can harvest more. A number: it can be done, is a violation, and each bite
    above the quota costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"


@dataclass(frozen=True, kw_only=True)
class ClosedSeason(Institution):
    """Times in which nobody may harvest (Ostrom's principle 2).

    Each period of `period_steps` turns, from the first turn of an episode, ends with `closed_steps` turns in
    which bites are forbidden. Agents observe whether the season is closed, and how long it stays so.
    """

    period_steps: Positive = 100
    """The length of a period in turns."""

    closed_steps: Natural = 25
    """The last turns of each period, in which the season is closed: 0 to `period_steps`."""

    fine: Amount | None = None
    """None: nobody can harvest in a closed season. A number: it can be done, is a violation, and
    each bite costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"

    def __post_init__(self) -> None:
        super().__post_init__()
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

    below: Natural = 2
    """The number of apples below which a patch is closed."""

    fine: Amount | None = None
    """None: nobody can harvest in a closed patch. A number: it can be done, is a violation, and
    each bite costs so many apples if it is detected."""

    principle: ClassVar[str] = "2 rules that fit local conditions"
    at_most: ClassVar[int | None] = 1
