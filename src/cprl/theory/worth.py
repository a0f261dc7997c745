"""What a unit is worth when so many are taken in all: v(A) of the herders' game."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Protocol, runtime_checkable

from cprl import arguments
from cprl.checks import MOST_NUMBER, Check, check_fields, checked, is_number

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
    """A function of your own: positive below `most`, falling there to 0, and never less steeply.

    Raises:
        ValueError: names the field, what came and what is allowed; also where the function, at one of the
            totals at which it is tried, fails or gives no number, rises, becomes less steep, or is not
            positive; where it is not 0 at `most`, to a thousandth of its highest value; and where the
            derivative is none of this function.
    """

    function: Callable[[float], float]
    """v(A), from a total to what a unit is worth."""
    most: float
    """The total from which on a unit is worth nothing."""
    derivative: Callable[[float], float] | None = None
    """v'(A); by default from differences of the function."""

    def __post_init__(self) -> None:
        arguments.callable_of("CallableWorth.function", self.function, "a function of the total")
        if self.derivative is not None:
            arguments.callable_of(
                "CallableWorth.derivative", self.derivative, "a function of the total, or None"
            )
        object.__setattr__(self, "most", checked("CallableWorth.most", self.most, _positive()))
        totals = [self.most * nth / _TRIED for nth in range(_TRIED + 1)]
        values = [_number_of("function", self.function, total) for total in totals]
        _check_shape(totals, values)
        if self.derivative is not None:
            slopes = [_number_of("derivative", self.derivative, total) for total in totals[:-1]]
            _check_slopes(totals, values, slopes)

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
_NOTHING: Final = 1e-3
"""What a unit may still be worth at `most`, as a share of the highest value."""


def _number_of(field: str, function: Callable[[float], float], total: float) -> float:
    """What a function of the user's own gives for a total."""
    where = f"CallableWorth.{field}"
    try:
        value = function(total)
    except Exception as error:
        failed = f"{type(error).__name__}: {error}"
        raise ValueError(f"{where} fails at {total:g} ({failed}); allowed: a number there") from error
    return arguments.number(
        f"{where} at {total:g}", value, low=-MOST_NUMBER, high=MOST_NUMBER, allowed="a number"
    )


def _check_shape(totals: list[float], values: list[float]) -> None:
    """Refuses a function that is not positive, does not fall, falls less and less steeply, or not to 0."""
    where, margin = "CallableWorth.function", _ROUNDING * max(map(abs, values))
    falls = [before - after for before, after in pairwise(values)]
    for total, value in zip(totals[:-1], values, strict=False):
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
    if abs(values[-1]) > _NOTHING * max(values):
        raise ValueError(
            f"{where} is {values[-1]:g} at `most`, {totals[-1]:g}; allowed: 0 there, where a unit is worth "
            "nothing any more"
        )


def _check_slopes(totals: list[float], values: list[float], slopes: list[float]) -> None:
    """Refuses what is no derivative: that of a function which falls ever more steeply lies between the slopes
    of the chords before and after."""
    chords = [(after - before) / totals[1] for before, after in pairwise(values)]
    margin = _ROUNDING * max(map(abs, chords))
    for total, slope, before, after in zip(totals, slopes, [0.0, *chords], chords, strict=False):
        if not after - margin <= slope <= before + margin:
            raise ValueError(
                f"CallableWorth.derivative is {slope:g} at {total:g}; allowed: the derivative of the "
                f"function, there from {after:g} to {before:g}"
            )
