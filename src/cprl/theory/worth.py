"""What a unit is worth when so many are taken in all: v(A) of the herders' game."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Protocol, runtime_checkable

from cprl.arguments import callable_of
from cprl.checks import Check, check_fields, checked, is_number

_STEP: Final = 1e-6
"""Of the numerical slope, as a share of the range."""


@runtime_checkable
class Worth(Protocol):
    """What a unit is worth, as a function of the total A: positive below `most`, 0 from there on, falling,
    and ever more steeply (v' < 0, v'' < 0; a straight line is allowed too)."""

    @property
    def most(self) -> float:
        """The total from which on a unit is worth nothing."""
        ...

    def at(self, total: float) -> float:
        """v(A)."""
        ...

    def slope(self, total: float) -> float:
        """v'(A), below `most`."""
        ...


def _positive(most: float = 1e12) -> Check:
    return Check(lambda value: is_number(value, 0, most) and value > 0, f"a number above 0, up to {most:g}")


@dataclass(frozen=True, kw_only=True)
class PowerWorth:
    """v(A) = top - factor A^power, and 0 where that is negative.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    top: float = 10.0
    """v(0), above 0."""
    factor: float = 1.0
    """Above 0."""
    power: float = 2.0
    """At least 1; with 1 it is a straight line."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)

    @property
    def most(self) -> float:
        """The total from which on a unit is worth nothing."""
        return float((self.top / self.factor) ** (1 / self.power))

    def at(self, total: float) -> float:
        """v(A)."""
        return float(max(self.top - self.factor * total**self.power, 0.0))

    def slope(self, total: float) -> float:
        """v'(A), below `most`."""
        return float(-self.factor * self.power * total ** (self.power - 1))

    def balance(self, cost: float, share: float) -> float:
        """The total A with v(A) + share A v'(A) = cost, in closed form; 0 where v(0) is below the cost."""
        return float(
            (max(self.top - cost, 0.0) / (self.factor * (1 + share * self.power))) ** (1 / self.power)
        )


_CHECKS: Final[dict[str, Check]] = {
    "top": _positive(),
    "factor": _positive(),
    "power": Check(lambda value: is_number(value, 1, 64), "a number in 1..64"),
}


@dataclass(frozen=True, kw_only=True)
class CallableWorth:
    """A function of your own: positive below `most`, falling there, and never less steeply.

    Raises:
        ValueError: names the field, what came and what is allowed; also where the function rises, becomes
            less steep or is not positive at one of the totals at which it is tried.
    """

    function: Callable[[float], float]
    """v(A), from a total to what a unit is worth."""
    most: float
    """The total from which on a unit is worth nothing."""
    derivative: Callable[[float], float] | None = None
    """v'(A); by default from differences of the function."""

    def __post_init__(self) -> None:
        callable_of("CallableWorth.function", self.function, "a function of the total")
        if self.derivative is not None:
            callable_of("CallableWorth.derivative", self.derivative, "a function of the total, or None")
        object.__setattr__(self, "most", checked("CallableWorth.most", self.most, _positive()))
        totals = [self.most * nth / _TRIED for nth in range(_TRIED)]
        _check_shape(totals, list(map(self.at, totals)))

    def at(self, total: float) -> float:
        """v(A)."""
        return float(self.function(total)) if total < self.most else 0.0

    def slope(self, total: float) -> float:
        """v'(A), below `most`."""
        if self.derivative is not None:
            return float(self.derivative(total))
        step = _STEP * self.most
        low, high = max(total - step, 0.0), min(total + step, self.most)
        return (float(self.function(high)) - float(self.function(low))) / (high - low)


_TRIED: Final = 64
"""Totals at which a function of the user's own is tried."""
_ROUNDING: Final = 1e-9


def _check_shape(totals: list[float], values: list[float]) -> None:
    """Refuses a function that is not positive, does not fall, or falls less and less steeply."""
    where, margin = "CallableWorth.function", _ROUNDING * max(map(abs, values))
    falls = [before - after for before, after in pairwise(values)]
    for total, value in zip(totals, values, strict=True):
        if not value > 0:
            raise ValueError(f"{where} is {value:g} at {total:g}; allowed: above 0 below `most`")
    for total, fall in zip(totals, falls, strict=False):
        if not fall > -margin:
            raise ValueError(f"{where} rises at {total:g}; allowed: one that falls below `most`")
    for total, (before, after) in zip(totals[1:], pairwise(falls), strict=False):
        if after < before - margin:
            raise ValueError(
                f"{where} is less steep from {total:g} on; allowed: one that falls ever more steeply, or a "
                "straight line"
            )
