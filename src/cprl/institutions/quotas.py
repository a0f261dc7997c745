"""Quota: a limit on each agent's harvest in a window of time."""

import math
import warnings
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, NamedTuple

from cprl.institutions.arrays import STEPS, InState
from cprl.institutions.institution import Amount, Limit, field_values, with_ballots
from cprl.institutions.ledger import Ledger
from cprl.values import Positive, Range
from cprl.values.array_types import Bool, Float64, Int32

ROUNDING: Final = 1e-9
"""The apples by which a harvest may exceed a quota, which allows for rounding errors."""


@dataclass(frozen=True, kw_only=True)
class Quota(Limit):
    """A limit on each agent's harvest in a window of time, as a share of the sustainable yield.

    This is Ostrom's principle 2, rules that fit local conditions. Windows follow one another from the first
    turn of an episode. In each window an agent may harvest up to share x yield x window_steps / N apples. The
    yield is the proven lower bound of `cprl.commons.yields.sustainable_yield`, on a map with a river the one
    while the river is clean. Agents observe the part of their quota that is left, and the time left in the
    window.
    """

    share: Annotated[float, Range(0, 1e6)] = 1.0
    """The share of the sustainable yield that all agents together may take."""

    window_steps: Positive = 50
    """The length of a window in turns."""

    by_stock: bool = False
    """Whether the quota of a window is multiplied by the share of all sites that hold an apple when the
    window begins."""

    fine: Amount | None = None
    """The fine in apples for each harvest above the quota, which is a violation, if it is detected. None
    makes such harvests impossible."""

    counts: ClassVar[tuple[str, ...]] = ("excess_bites",)
    entries: ClassVar[tuple[str, ...]] = ("quota left", "quota time")
    voted_on: ClassVar[str] = "the quota's share"


class QuotaArrays(NamedTuple):
    """The parameters and memory of all `Quota` of a game, one of them per index of axis Q."""

    window_yield: Annotated[Float64, "Q"]
    """The apples that an agent may harvest in a window at a share of 1."""
    largest_allowed: Annotated[Float64, "Q"]
    """The most apples that an agent may ever harvest in a window; what agents observe is relative to it."""
    share: Annotated[Float64, "Q"]
    ballot: Annotated[Int32, "Q"]
    """The ballot that decides the share; -1 for none."""
    window_steps: Annotated[Int32, "Q"]
    by_stock: Annotated[Bool, "Q"]
    is_stopped: Annotated[Bool, "Q"]
    fine: Annotated[Float64, "Q"]
    allowed: Annotated[Float64, "B Q", InState(cleared=False)]
    """The apples that an agent may harvest in the current window."""
    taken: Annotated[Int32, "B Q N", STEPS]
    """The apples that each agent has harvested in the current window."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `QuotaArrays` by name."""
    quotas = with_ballots(game, Quota)
    agent_yield = game.sustainable_yield / game.agents if quotas else 0.0
    largest_shares = [
        quota.share if ballot < 0 else game.in_force[ballot].choices[-1] for quota, ballot in quotas
    ]
    for (quota, _), share in zip(quotas, largest_shares, strict=True):
        _warn_of_less_than_an_apple(quota, agent_yield * share)
    window_yield = [agent_yield * quota.window_steps for quota, _ in quotas]
    largest_allowed = [share * apples for share, apples in zip(largest_shares, window_yield, strict=True)]
    return {
        "window_yield": window_yield,
        "largest_allowed": largest_allowed,
        **field_values(Quota, QuotaArrays, game),
    }


def _warn_of_less_than_an_apple(quota: Quota, apples_per_turn: float) -> None:
    """Warn (UserWarning) of a quota that allows less than one apple in a window, so that nobody ever
    harvests."""
    apples = apples_per_turn * quota.window_steps
    if quota.fine is None and 0 < apples < 1 - ROUNDING:
        warnings.warn(
            f"Quota.window_steps is {quota.window_steps}: in such a window an agent may take {apples:.3g} "
            "apples at most, so nobody ever harvests; an apple is allowed in windows of "
            f"{math.ceil((1 - ROUNDING) / apples_per_turn)} turns or more",
            UserWarning,
            stacklevel=2,
        )


def open_windows(quotas: QuotaArrays, ledger: Ledger, turn: int, stock_share: float) -> None:
    """Open the windows that begin with a turn, and compute how much agents may harvest in them.

    `stock_share`: the share of all sites that hold an apple.
    """
    for quota in range(quotas.window_steps.shape[0]):
        if (turn - 1) % quotas.window_steps[quota] == 0:
            share = quotas.share[quota]
            if quotas.ballot[quota] >= 0:
                share = ledger.in_force[quotas.ballot[quota]]
            if quotas.by_stock[quota]:
                share *= stock_share
            quotas.allowed[quota] = share * quotas.window_yield[quota]
            for agent in range(quotas.taken.shape[1]):
                quotas.taken[quota, agent] = 0


def is_used_up(quotas: QuotaArrays, quota: int, agent: int) -> bool:
    """Return whether one more harvest of an agent would exceed a quota."""
    return quotas.taken[quota, agent] + 1 > quotas.allowed[quota] + ROUNDING


def use_quotas(quotas: QuotaArrays, agent: int) -> None:
    """Count a harvest of an agent for all quotas."""
    for quota in range(quotas.window_steps.shape[0]):
        quotas.taken[quota, agent] += 1


def show_quota(quotas: QuotaArrays, entry: int, quota: int, agent: int, turn: int) -> float:
    """Return what an agent observes of a quota after a turn, 0..1.

    Entry 0 is the number of apples that it may still harvest, relative to the largest quota; entry 1 is the
    part of the window that is left.
    """
    if entry == 1:
        return (quotas.window_steps[quota] - turn % quotas.window_steps[quota]) / quotas.window_steps[quota]
    left = quotas.allowed[quota] - quotas.taken[quota, agent]
    return left / quotas.largest_allowed[quota] if left > 0 and quotas.largest_allowed[quota] > 0 else 0.0
