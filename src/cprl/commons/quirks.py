"""What only the program of 2019 does: the group of rules `Quirks2019`, on one world.

Each is a behaviour of the program that produced the results of [W] M. Wiatrak, "Governing the Commons with
Multi-Agent Reinforcement Learning" (2019), where it differs from the text. A game without the group is
compiled without it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from cprl.commons.headings import DOWN, UP
from cprl.institutions.arrays import Kept
from cprl.values import Value
from cprl.values.arrays import UInt8

if TYPE_CHECKING:
    from cprl.commons.world import Worlds


@dataclass(frozen=True, kw_only=True)
class Quirks2019(Value):
    """What the program of 2019 does otherwise than the text of the study: all of it, but for what is
    False."""

    freeze_counts_tag_turn: bool = True
    """The turn of the tag counts as the first of `Rules.freeze_steps`, so the agent misses one turn less."""

    ends_one_turn_late: bool = True
    """The episode terminates in the turn that begins with an empty stock, one turn later."""

    picture_shows_old_stock: bool = True
    """The picture shows the apples of the start of the turn."""

    paint_over: bool = True
    """Heading marks cover apples and agents of lower indices; beams cover everything."""

    mark_behind_if_vertical: bool = True
    """The heading mark of an agent that faces up or down is painted behind the agent."""

    self_paint_stays: bool = True
    """Windows are drawn in the order of agent indices; each agent's cell is painted as "self" and stays so in
    the windows of later agents, whether the agent is in play or not."""


class Arrays(NamedTuple):
    """The quirks of a game, and what they remember of its worlds."""

    freeze_counts_tag_turn: bool
    ends_one_turn_late: bool
    picture_shows_old_stock: bool
    paint_over: bool
    mark_behind_if_vertical: bool
    self_paint_stays: bool
    stock_before: Annotated[UInt8, "B K", Kept(high=1, cleared=False)]
    """The stock at the start of the turn."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters among `Arrays`."""
    return {name: getattr(game.rules.quirks, name) for name in Arrays._fields if name != "stock_before"}


def keep_old_stock(world: "Worlds", quirks: Arrays | None) -> None:
    """Copy the stock, which the picture of this turn shows."""
    if quirks is not None:
        for k in range(world.stock.shape[0]):
            quirks.stock_before[k] = world.stock[k]


def shows_apple(world: "Worlds", quirks: Arrays | None, k: int) -> bool:
    """Return whether the picture shows an apple on site k."""
    if quirks is not None and quirks.picture_shows_old_stock:
        return quirks.stock_before[k] == 1
    return world.stock[k] == 1


def turns_missed(freeze_steps: int, quirks: Arrays | None) -> int:
    """Return the turns after that of a tag that an agent misses."""
    if quirks is not None and quirks.freeze_counts_tag_turn:
        return max(0, freeze_steps - 1)
    return freeze_steps


def ends_late(quirks: Arrays | None) -> bool:
    """Return whether an empty board ends an episode a turn later."""
    return quirks is not None and quirks.ends_one_turn_late


def paints_over(quirks: Quirks2019 | Arrays | None) -> bool:
    """Return whether marks and beams cover what they are painted on."""
    return quirks is not None and quirks.paint_over


def self_stays(quirks: Quirks2019 | Arrays | None) -> bool:
    """Return whether an agent stays painted as "self" in the windows of later agents."""
    return quirks is not None and quirks.self_paint_stays


def mark_ahead(heading: int, quirks: Arrays | None) -> int:
    """Return how many cells ahead of an agent its heading mark is: 1, or -1 for behind it."""
    if quirks is not None and quirks.mark_behind_if_vertical and heading in (UP, DOWN):
        return -1
    return 1
