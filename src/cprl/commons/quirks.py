"""Quirks2019: a group of rules with the quirks of the program of 2019. The rules work on one world.

A quirk is a behaviour in which the program that produced the results of [W] M. Wiatrak, "Governing the
Commons with Multi-Agent Reinforcement Learning" (2019), differs from the text. A game without this group is
compiled without its code.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from cprl.commons.headings import DOWN, UP
from cprl.institutions.arrays import InState
from cprl.values import Value
from cprl.values.array_types import UInt8

if TYPE_CHECKING:
    from cprl.commons.world import Worlds


@dataclass(frozen=True, kw_only=True)
class Quirks2019(Value):
    """The quirks of the program of 2019, which differs from the text of the study; False leaves one out."""

    freeze_counts_tag_turn: bool = True
    """The turn of a tag counts as the first of `Rules.freeze_steps`, so an agent misses one turn less."""

    ends_one_turn_late: bool = True
    """The episode terminates one turn late, in the turn that begins without any apple."""

    picture_shows_old_stock: bool = True
    """The picture shows the apples as they were at the start of the turn."""

    paint_over: bool = True
    """Heading marks cover apples and agents of lower indices; beams cover everything."""

    mark_behind_if_vertical: bool = True
    """The heading mark of an agent that faces up or down is painted behind the agent."""

    self_paint_stays: bool = True
    """The windows are drawn in the order of agent indices. Each agent's cell is painted as "self" for its own
    window and stays so in the windows of later agents, whether the agent is in play or not."""


class QuirkArrays(NamedTuple):
    """The quirks of a game, and the memory that they need in each world."""

    freeze_counts_tag_turn: bool
    ends_one_turn_late: bool
    picture_shows_old_stock: bool
    paint_over: bool
    mark_behind_if_vertical: bool
    self_paint_stays: bool
    stock_before: Annotated[UInt8, "B K", InState(high=1, cleared=False)]
    """The stock at the start of the turn."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `QuirkArrays` by name."""
    return {name: getattr(game.rules.quirks, name) for name in QuirkArrays._fields if name != "stock_before"}


def keep_old_stock(world: "Worlds", quirks: QuirkArrays | None) -> None:
    """Copy the stock at the start of a turn, since the picture of this turn may show it."""
    if quirks is not None:
        for site in range(world.stock.shape[0]):
            quirks.stock_before[site] = world.stock[site]


def shows_apple(world: "Worlds", quirks: QuirkArrays | None, site: int) -> bool:
    """Return whether the picture shows an apple on a site."""
    if quirks is not None and quirks.picture_shows_old_stock:
        return quirks.stock_before[site] == 1
    return world.stock[site] == 1


def turns_missed(freeze_steps: int, quirks: QuirkArrays | None) -> int:
    """Return the number of turns that an agent misses after the turn in which it is tagged."""
    if quirks is not None and quirks.freeze_counts_tag_turn:
        return max(0, freeze_steps - 1)
    return freeze_steps


def ends_late(quirks: QuirkArrays | None) -> bool:
    """Return whether an empty board ends an episode only one turn later."""
    return quirks is not None and quirks.ends_one_turn_late


def paints_over(quirks: Quirks2019 | QuirkArrays | None) -> bool:
    """Return whether heading marks and beams cover what is on their cells."""
    return quirks is not None and quirks.paint_over


def self_stays(quirks: Quirks2019 | QuirkArrays | None) -> bool:
    """Return whether an agent stays painted as "self" in the windows of later agents."""
    return quirks is not None and quirks.self_paint_stays


def mark_ahead(heading: int, quirks: QuirkArrays | None) -> int:
    """Return how many cells ahead of an agent its heading mark is: 1, or -1 for behind it."""
    if quirks is not None and quirks.mark_behind_if_vertical and heading in (UP, DOWN):
        return -1
    return 1
