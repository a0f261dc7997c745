"""Permits: an institution that sells what others forbid, as a module of `cprl.institutions` would have it.

A harvest costs apples. It breaks no rule, and nothing is stopped.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

from cprl.institutions.arrays import STEPS
from cprl.institutions.institution import Amount, Institution
from cprl.institutions.ledger import Ledger
from cprl.values.array_types import Float64, Int32


@dataclass(frozen=True, kw_only=True)
class Permits(Institution, stored=False):
    """Each harvest needs a permit, and a permit costs apples."""

    price: Amount = 0.5
    """The apples that a permit costs."""

    entries: ClassVar[tuple[str, ...]] = ("permits bought",)


class PermitArrays(NamedTuple):
    """All permits of a game, one per index of axis P."""

    price: Annotated[Float64, "P"]
    bought: Annotated[Int32, "B P N", STEPS]
    """Permits bought in this episode."""


def sell_permits(permits: PermitArrays, ledger: Ledger, i: int) -> None:
    """Let agent i pay for a harvest."""
    for p in range(permits.price.shape[0]):
        permits.bought[p, i] += 1
        ledger.fines[i] += permits.price[p]
