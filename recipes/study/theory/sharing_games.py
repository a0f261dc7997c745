"""SharingGame: agents take a number each, and every unit is worth the less the more are taken in all.

Agent i takes x_i >= 0 and is paid x_i v(X) - c x_i + e, where X is the sum of all, c what a unit costs it and
e a payment that does not depend on what anybody takes. What it takes lowers v(X) for everybody, and it feels
an n-th of that: in the symmetric equilibrium v(X) + X v'(X) / n = c, at the group's optimum
v(X) + X v'(X) = c.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from math import inf
from typing import Annotated, Any, Final, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl.values import Positive, Range, Value, Where, checked

T = TypeVar("T")

_STEP: Final = 1e-6
"""The step of the numerical derivative, as a share of the range."""
_TRIED: Final = 64
"""Totals at which a function of the user's own is tried."""
_ROUNDING: Final = 1e-9
_NOTHING: Final = 1e-3
"""The worth that a unit may still have at `most`, as a share of the highest value."""
_PRECISION: Final = 1e-14
"""The precision of a root."""
_MOST: Final = 1e12
Above0 = Annotated[float, Where(lambda value: 0 < value <= _MOST, f"a number above 0, up to {_MOST:g}")]
Cost = Annotated[float, Range(0, _MOST)]


@runtime_checkable
class Worth(Protocol):
    """What a unit is worth, as a function of the total A: positive below `most`, 0 from there on, falling,
    and ever more steeply (v' < 0, v'' < 0; a straight line is allowed too)."""

    @property
    def most(self) -> float:
        """Return the total from which on a unit is worth nothing."""

    def at(self, total: float) -> float:
        """Return v(A)."""

    def derivative(self, total: float) -> float:
        """Return v'(A), below `most`."""


@dataclass(frozen=True, kw_only=True)
class PowerWorth(Value):
    """v(A) = top - factor A^power, and 0 where that is negative."""

    top: Above0 = 10.0
    """v(0)."""
    factor: Above0 = 1.0
    """The steepness of its fall."""
    power: Annotated[float, Range(1, 64)] = 2.0
    """With 1 it is a straight line."""

    @property
    def most(self) -> float:
        return float((self.top / self.factor) ** (1 / self.power))

    def at(self, total: float) -> float:
        return float(max(self.top - self.factor * total**self.power, 0.0))

    def derivative(self, total: float) -> float:
        return float(-self.factor * self.power * total ** (self.power - 1))

    def balance(self, cost: float, share: float) -> float:
        """Return the total A with v(A) + share A v'(A) = cost, in closed form; 0 where v(0) is below the
        cost."""
        return float(
            (max(self.top - cost, 0.0) / (self.factor * (1 + share * self.power))) ** (1 / self.power)
        )


@dataclass(frozen=True, kw_only=True)
class CallableWorth(Value):
    """A function of your own: positive below `most`, falling there to 0, and never less steeply."""

    function: Callable[[float], float]
    """v(A), from a total to what a unit is worth."""
    most: Above0
    """The total from which on a unit is worth nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        totals = np.linspace(0.0, self.most, _TRIED + 1)
        try:
            values = np.array([float(self.function(float(total))) for total in totals])
        except Exception as error:
            raise ValueError(f"CallableWorth.function fails: {type(error).__name__}: {error}") from error
        chords = np.diff(values) / totals[1]
        margin = _ROUNDING * np.abs(chords).max()
        falls_ever_more = chords.max() < margin and np.diff(chords).max() <= margin
        if not (falls_ever_more and values[:-1].min() > 0 and abs(values[-1]) <= _NOTHING * values.max()):
            allowed = "positive below `most`, falling there to 0, ever more steeply or in a straight line"
            raise ValueError(f"CallableWorth.function is {values[:2]} .. {values[-2:]}; allowed: {allowed}")

    def at(self, total: float) -> float:
        return float(self.function(total)) if total < self.most else 0.0

    def derivative(self, total: float) -> float:
        step = _STEP * self.most
        low = max(total - step, 0.0)
        high = min(total + step, self.most)
        return (float(self.function(high)) - float(self.function(low))) / (high - low)


@dataclass(frozen=True, kw_only=True)
class SharingGame(Value):
    """n agents share what is worth v(X) a unit when they take X in all; see the module for the formulas.

    Totals, payoffs and costs are numbers of Python, in units of one's own.
    """

    agents: Positive
    """The number of agents n."""
    worth: Worth
    """v, what a unit is worth; a table of the fields of a `PowerWorth` is made one."""
    cost: Cost
    """c, what a unit costs who takes it."""
    most_each: Above0 | None = None
    """The most that an agent can take; None for as much as it wants."""
    payment: Annotated[float, Range(-_MOST, _MOST)] = 0.0
    """e, what each agent is paid whatever it takes."""

    def __post_init__(self) -> None:
        if isinstance(self.worth, Mapping):
            object.__setattr__(self, "worth", from_table(PowerWorth, self.worth, "SharingGame.worth"))
        super().__post_init__()

    def to_config(self) -> dict[str, Any]:
        """Return the arguments that make it, as JSON can hold them; refuse a worth of your own."""
        if not isinstance(self.worth, PowerWorth):
            return super().to_config()  # which refuses it by its place
        arguments = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**arguments, "worth": self.worth.to_config()}

    def payoffs(self, taken: ArrayLike) -> NDArray[np.float64]:
        """Return what agents are paid, float64 [..., n].

        Args:
            taken: what each takes, float [..., n], from 0 to `most_each`.
        """
        amounts = np.asarray(taken, np.float64)
        if amounts.ndim == 0 or amounts.shape[-1] != self.agents:
            raise ValueError(f"taken is {list(amounts.shape)}; allowed: [..., {self.agents}], one per agent")
        if not ((amounts >= 0) & (amounts <= self._limit) & np.isfinite(amounts)).all():
            raise ValueError(
                f"taken is from {amounts.min():g} to {amounts.max():g}; allowed: 0 to {self._limit:g}"
            )
        values = np.vectorize(self.worth.at, otypes=[np.float64])(amounts.sum(-1))
        paid: NDArray[np.float64] = amounts * (values - self.cost)[..., None] + self.payment
        return paid

    def surplus(self, total: float) -> float:
        """Return what all agents together gain when they take so much in all: X (v(X) - c), without
        payments."""
        return total * (self.worth.at(total) - self.cost)

    @cached_property
    def nash_total(self) -> float:
        """Return X* of the symmetric Nash equilibrium, in which each agent takes X* / n."""
        return self._balance(1 / self.agents)

    @cached_property
    def optimum_total(self) -> float:
        """Return X** that is best for the group."""
        return self._balance(1.0)

    @cached_property
    def open_access_total(self) -> float:
        """Return the total at which a unit is worth what it costs, and nobody gains anything."""
        return self._balance(0.0)

    @property
    def price_of_anarchy(self) -> float:
        """Return the surplus at the optimum over that in equilibrium, at least 1; 1 where nothing can be
        gained."""
        best = self.surplus(self.optimum_total)
        reached = self.surplus(self.nash_total)
        if best <= 0:
            return 1.0
        return best / reached if reached > 0 else inf

    @property
    def rent_share(self) -> float:
        """Return the surplus in equilibrium as a share of that at the optimum: 1 / `price_of_anarchy`."""
        return 1 / self.price_of_anarchy

    def best_response(self, others: float) -> float:
        """Return what an agent takes to gain most while all others together take so much.

        It solves v(x + O) + x v'(x + O) = c, where O is what the others take.
        """
        worth = self.worth

        def gain(taken: float) -> float:
            return worth.at(taken + others) + taken * worth.derivative(taken + others) - self.cost

        return _root(gain, min(self._limit, max(worth.most - others, 0.0)))

    @property
    def _limit(self) -> float:
        return inf if self.most_each is None else self.most_each

    def _balance(self, share: float) -> float:
        """Return the total X with v(X) + share X v'(X) = c, or the nearest one that agents can take."""
        worth = self.worth
        most = self.agents * self._limit
        if isinstance(worth, PowerWorth):
            return min(worth.balance(self.cost, share), most)

        def gain(total: float) -> float:
            return worth.at(total) + share * total * worth.derivative(total) - self.cost

        return _root(gain, min(worth.most, most))


def herders(agents: int, *, worth: Worth = PowerWorth(), cost: float = 1.0) -> SharingGame:
    """Return the game of n herders who graze a_i animals each; one is worth v(A) when A graze in all.

    With v(A) = 10 - A^2 and c = 1 the optimum is A** = 1.7321, and A* = 1.7321, 2.1213, 2.5355, 2.7386 and
    2.9704 for 1, 2, 5, 10 and 100 herders.

    Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), equations 2.1
    to 2.5, on G. Hardin, "The Tragedy of the Commons" (1968).

    Args:
        worth: v; by default 10 - A^2.
        cost: c, of an animal.
    """
    return SharingGame(agents=agents, worth=worth, cost=cost)


def appropriation(
    agents: int = 8,
    *,
    tokens: float = 10.0,
    outside: float = 5.0,
    linear: float = 23.0,
    quadratic: float = 0.25,
) -> SharingGame:
    """Return the game of agents who divide tokens between a common-pool resource and an outside activity.

    The resource pays F(X) = linear X - quadratic X^2 for all X tokens in it, to each agent the share that its
    tokens have; a token outside pays `outside`. With the numbers of the experiments 8 agents put in 8 tokens
    each in equilibrium, 64 in all, where 36 were best; at 72 there is no rent, and in equilibrium 39.5 % of
    the best one.

    Source: E. Ostrom, R. Gardner and J. Walker, "Rules, Games, and Common-Pool Resources" (1994), chapter 5.

    Args:
        tokens: of each agent; 10 or 25 in the experiments.
        outside: w, what a token earns outside.
    """
    worth = PowerWorth(top=linear, factor=quadratic, power=1.0)
    tokens = checked("tokens", tokens, Above0)
    outside = checked("outside", outside, Cost)
    return SharingGame(agents=agents, worth=worth, cost=outside, most_each=tokens, payment=tokens * outside)


def from_table(kind: type[T], table: Mapping[str, Any], name: str) -> T:
    """Return a value of the table of its fields; raise a ValueError with its name for other fields."""
    try:
        return kind(**table)
    except TypeError as error:
        raise ValueError(f"{name}: {error}") from error


def _root(falling: Callable[[float], float], most: float) -> float:
    """Return where a falling function is 0, between 0 and `most`; one of these where it has one sign."""
    if most <= 0 or falling(0.0) <= 0:
        return 0.0
    high = float(np.nextafter(most, 0.0))  # a worth may have a kink where it becomes 0
    if falling(high) >= 0:
        return most
    from scipy.optimize import brentq

    return float(brentq(falling, 0.0, high, xtol=_PRECISION * most, rtol=_PRECISION))
