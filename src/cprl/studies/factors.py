"""What the conditions of a study differ in: factors with levels, and distributions of random draws."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import exp, log
from posixpath import normpath
from typing import Any, Final, TypeAlias

import numpy as np

from cprl.arguments import refusal
from cprl.checks import MOST_NUMBER, is_count, is_number
from cprl.config import from_config, to_config
from cprl.custom import Custom
from cprl.envs.games import game_of, stored_game
from cprl.population import with_run_moved
from cprl.studies.paths import normalised

_ALLOWED: Final = (
    "the values of the field that the factor's path names, as a list; a table of named levels, each a table "
    "of values by path; or a distribution of cprl.studies.factors"
)


@dataclass(frozen=True)
class Uniform:
    """Numbers from `low` to `high`, equally likely."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _check_range(self, lambda value: is_number(value, -MOST_NUMBER, MOST_NUMBER))

    def draw(self, rng: np.random.Generator) -> float:
        """One of them."""
        return float(rng.uniform(self.low, self.high))


@dataclass(frozen=True)
class LogUniform:
    """Numbers above 0 from `low` to `high` whose logarithms are equally likely, e.g. learning rates."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _check_range(self, lambda value: is_number(value, 1e-300, MOST_NUMBER))

    def draw(self, rng: np.random.Generator) -> float:
        """One of them."""
        return exp(float(rng.uniform(log(self.low), log(self.high))))


@dataclass(frozen=True)
class Integers:
    """Whole numbers from `low` to `high`, both included, equally likely."""

    low: int
    high: int

    def __post_init__(self) -> None:
        _check_range(self, lambda value: is_count(value, -(2**53)))

    def draw(self, rng: np.random.Generator) -> int:
        """One of them."""
        return int(rng.integers(self.low, self.high, endpoint=True))


Distribution: TypeAlias = Uniform | LogUniform | Integers
Factor: TypeAlias = Sequence[Any] | Mapping[str, Mapping[str, Any]] | Distribution
"""Values of the field that its path names; or levels by name, each with its changes; or a distribution."""

DISTRIBUTIONS: Final[dict[str, type[Any]]] = {own.__name__: own for own in (Uniform, LogUniform, Integers)}
MOST_CONDITIONS: Final = 10_000


@dataclass(frozen=True)
class Level:
    """One level of a factor: what it is called, and what it changes in the experiment, by path."""

    value: Any
    changes: Mapping[str, Any]


def checked_factors(factors: object) -> dict[str, Factor]:
    """Factors as a study keeps them; raises a ValueError for what are none."""
    if not isinstance(factors, Mapping):
        raise refusal("factors", factors, "a table of factors by the path of a field, or by name")
    return {
        _name(name, own): _of_path(name, _factor(f"factors[{name!r}]", own)) for name, own in factors.items()
    }


def grid(factors: Mapping[str, Factor]) -> Iterator[dict[str, Level]]:
    """Every combination of the levels of all factors, in order."""
    for name, own in factors.items():
        if isinstance(own, Distribution):
            raise ValueError(f"factors[{name!r}] is {own}; allowed in a grid: levels, or with draws=N")
    for levels in product(*(levels_of(name, own) for name, own in factors.items())):
        yield dict(zip(factors, levels, strict=True))


def drawn(factors: Mapping[str, Factor], *, seed: int, nth: int) -> dict[str, Level]:
    """The nth random combination of levels; it depends on nothing else."""
    found = {}
    for place, (name, own) in enumerate(factors.items()):
        rng = np.random.default_rng([seed, nth, place])
        if isinstance(own, Distribution):
            value = own.draw(rng)
            found[name] = Level(value, {name: value})
        else:
            levels = levels_of(name, own)
            found[name] = levels[int(rng.integers(len(levels)))]
    return found


def levels_of(name: str, factor: Factor) -> list[Level]:
    """The levels of a factor that is no distribution."""
    assert not isinstance(factor, Distribution)
    if isinstance(factor, Mapping):
        return [Level(level, changes) for level, changes in factor.items()]
    return [Level(value, {name: value}) for value in factor]


def factor_to_config(name: str, factor: Factor, place: Callable[[str], str]) -> dict[str, Any]:
    """A factor as JSON can hold it; `place` gives where the runs of `Frozen` agents are said to be."""
    if isinstance(factor, Distribution):
        return {"distribution": type(factor).__name__, "low": factor.low, "high": factor.high}
    if isinstance(factor, Mapping):
        return {"levels": [[level, changes_to_config(own, place)] for level, own in factor.items()]}
    return {"values": to_config(_stored(name, factor, place), f"factors[{name!r}]")}


def factor_from_config(
    name: str, table: Mapping[str, Any], allow: Sequence[str], place: Callable[[str], str]
) -> Factor:
    """The factor that `factor_to_config` gave."""
    if "distribution" in table:
        made: Distribution = DISTRIBUTIONS[table["distribution"]](low=table["low"], high=table["high"])
        return made
    if "levels" in table:
        return {level: changes_from_config(own, allow, place) for level, own in table["levels"]}
    values = from_config(table["values"], allow=allow)
    return tuple(_read(name, own, place) for own in values)


def changes_to_config(changes: Mapping[str, Any], place: Callable[[str], str]) -> dict[str, Any]:
    """Values by path as JSON can hold them."""
    return {path: to_config(_stored(path, value, place), path) for path, value in changes.items()}


def changes_from_config(
    table: Mapping[str, Any], allow: Sequence[str], place: Callable[[str], str]
) -> dict[str, Any]:
    """The values by path that `changes_to_config` gave."""
    return {path: _read(path, from_config(value, path, allow=allow), place) for path, value in table.items()}


def _stored(path: str, value: Any, place: Callable[[str], str]) -> Any:
    """A value at a path as JSON can hold it: with `Frozen` agents whose runs are elsewhere, and a game of the
    user's own by the name of its class."""
    if isinstance(value, tuple | list):
        return tuple(_stored(path, own, place) for own in value)
    return _moved(path, stored_game(value), place)


def _read(path: str, value: Any, place: Callable[[str], str]) -> Any:
    """The value of which `_stored` was kept."""
    if isinstance(value, tuple):
        return tuple(_read(path, own, place) for own in value)
    if path == "game" and isinstance(value, Custom):
        return game_of(value)
    return _moved(path, value, place)


def _moved(path: str, value: Any, place: Callable[[str], str]) -> Any:
    """A value at a path with the run of its `Frozen` agent elsewhere, where it has or is one."""
    if isinstance(value, str):
        return place(value) if _is_run(path) else value
    return with_run_moved(value, place)


def _is_run(path: str) -> bool:
    """Whether a path names the run of a `Frozen` agent, and no argument of the user's own of that name."""
    return re.fullmatch(r"agents\.(\*|\d+)(\.start_from)?\.run", path.replace("-", "_")) is not None


def _name(name: object, factor: object) -> str:
    if isinstance(factor, Mapping):
        if isinstance(name, str) and name:
            return name
        raise refusal("a factor's name", name, "a text")
    return normalised(name)


def _of_path(path: str, factor: Factor) -> Factor:
    """A factor with runs as `Frozen` has them, so that its levels have the same names when it is read."""
    if isinstance(factor, tuple) and _is_run(path):
        return tuple(normpath(own) if isinstance(own, str) and own else own for own in factor)
    return factor


def _factor(where: str, value: Any) -> Factor:
    if isinstance(value, Distribution):
        return value
    if isinstance(value, Mapping):
        if not value or not all(isinstance(own, Mapping) for own in value.values()):
            raise refusal(where, value, _ALLOWED)
        return {
            level: {normalised(path): own for path, own in changes.items()}
            for level, changes in value.items()
        }
    if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes) and len(value):
        return tuple(own.item() if isinstance(own, np.generic) else own for own in value)
    raise refusal(where, value, _ALLOWED)


def _check_range(own: Any, is_one: Any) -> None:
    kind = type(own).__name__
    for name in ("low", "high"):
        if not is_one(getattr(own, name)):
            raise refusal(f"{kind}.{name}", getattr(own, name), "a number that it can draw")
    if own.low > own.high:
        raise ValueError(f"{kind}.low is {own.low}; allowed: up to its high, {own.high}")
