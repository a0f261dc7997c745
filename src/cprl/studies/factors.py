"""Factors: the fields of an experiment that a study varies, and the values that it tries.

A path names a field by its place in the experiment's table (`Experiment.to_config`), e.g.
"agents.*.algorithm.settings.gamma". Each part of a path is the name of a field, the name of an argument of a
`Custom`, or the index of an element of a list. `*` means all elements of a list; in `agents` it means all
agents that learn. A path may be written with "-" for "_", as flags are.
"""

import re
from abc import ABC, abstractmethod
from ast import literal_eval
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import exp, log
from posixpath import normpath
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np

from cprl.commons import maps
from cprl.commons.maps import Map
from cprl.envs.make_env import game_of, stored_game
from cprl.experiment import Experiment
from cprl.runs.recipe import STORED_RUN
from cprl.values import (
    KINDS,
    MOST_INT32,
    MOST_NUMBER,
    Custom,
    Range,
    Value,
    as_custom,
    checked,
    custom_targets,
    describe_type,
    did_you_mean,
    from_config,
    hints_of,
    matches_type,
    refusal,
    short_repr,
    to_config,
    trusting,
)
from cprl.values.array_types import Float64

ALL: Final = "*"


def with_changes(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """Return an experiment with other values of some fields, all changed together.

    A path that leads into another changed value applies to the new value. A path with an index wins over the
    same path with `*`.

    Args:
        changes: the new values by path. Lists become tuples, and a board may be given by its name.

    Raises:
        ValueError: if a path matches nothing, or a value is not allowed there; the message names the path.
    """
    table = experiment.to_config()
    for path in sorted(changes, key=lambda path: (path.count("."), ALL not in path)):
        value = _plain(changes[path])
        for holder, name in places(table, path):
            held = holder[name]
            if isinstance(value, str) and isinstance(held, Mapping) and held.get("kind") == "Map":
                try:
                    value = maps.published(value)
                except ValueError as error:
                    raise ValueError(f"at the path {path}: {error}") from error
            holder[name] = to_config(stored_game(value), f"the value at the path {path}")
    try:
        with trusting(custom_targets(table)):
            return Experiment.from_config(table)
    except ValueError as error:
        raise ValueError(f"with {', '.join(changes)}: {error}") from error


def values_at(experiment: Experiment, path: str) -> list[Any]:
    """Return the values of all fields that a path means, at least one."""
    tables = [holder[name] for holder, name in places(experiment.to_config(), path)]
    with trusting(custom_targets(tables)):
        return [_value_of(path, table) for table in tables]


def places(table: dict[str, Any], path: str) -> list[tuple[Any, Any]]:
    """Return the fields that a path means, each as (the table or list that holds it, its name or index)."""
    *outer, last = normalised(path).split(".")
    holders: list[Any] = [table]
    for depth, name in enumerate(outer):
        above = outer[:depth]
        holders = [inner[key] for holder in holders for inner, key in _places_in(holder, name, above)]
    return [place for holder in holders for place in _places_in(holder, last, outer)]


def _places_in(holder: Any, name: str, above: list[str]) -> list[tuple[Any, Any]]:
    """Return the fields of one table or list that one part of a path means, as `places` does.

    Args:
        above: the parts of the path that lead to this table or list.
    """
    where = ".".join(above) or "the experiment"
    path = ".".join([*above, name])
    if isinstance(holder, list) and name == ALL:
        is_all = above != ["agents"]
        matches = [is_all or entry["kind"] in ("Learning", "Team") for entry in holder]
        if any(matches):
            return [(holder, place) for place, is_match in enumerate(matches) if is_match]
        raise ValueError(f"the path {path} matches nothing: {where} has no agent that learns")
    if isinstance(holder, Mapping) and holder.get("kind") == "Custom" and name in holder["arguments"]:
        holder = holder["arguments"]  # a field of a game of the user's own
    names: list[str] = []
    if isinstance(holder, list):
        names = [str(place) for place in range(len(holder))]
    elif isinstance(holder, Mapping):
        names = [key for key in holder if key != "kind"]
    if name in names:
        return [(holder, int(name) if isinstance(holder, list) else name)]
    has = f"{where} has {', '.join(names)}" if names else f"{where} is {short_repr(holder)}"
    if holder is None:
        has += f"; give the base one, or vary {where} as a whole"
    raise ValueError(f"the path {path} matches nothing{did_you_mean(name, names)}; {has}")


def normalised(path: object) -> str:
    """Return a path with "_" for "-"; refuse anything that is not a path.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(path, str) or not path or not all(path.split(".")):
        raise refusal("path", path, 'names with dots between them, e.g. "game.rules.freeze_steps"')
    return path.replace("-", "_")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    value = as_custom(value)
    return tuple(map(_plain, value)) if isinstance(value, list | tuple | range) else value


Number: TypeAlias = Annotated[float, Range(-MOST_NUMBER, MOST_NUMBER)]
NumberAbove0: TypeAlias = Annotated[float, Range(1e-300, MOST_NUMBER)]
WholeNumber: TypeAlias = Annotated[int, Range(-(2**53), MOST_INT32)]


@dataclass(frozen=True)
class Distribution(Value, ABC, stored=False):
    """Numbers from `low` to `high`."""

    low: Any
    high: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low > self.high:
            raise refusal(f"{type(self).__name__}.low", self.low, f"up to its high, {self.high}")

    @abstractmethod
    def at(self, share: float) -> Any:
        """Return the quantile: the number below which this share of all numbers lies.

        Args:
            share: from 0 to 1.
        """


@dataclass(frozen=True)
class Uniform(Distribution, stored=False):
    """Numbers from `low` to `high`, equally likely."""

    low: Number
    high: Number

    def at(self, share: float) -> float:
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class LogUniform(Distribution, stored=False):
    """Numbers above 0 from `low` to `high` whose logarithms are equally likely, e.g. learning rates."""

    low: NumberAbove0
    high: NumberAbove0

    def at(self, share: float) -> float:
        return exp(log(self.low) + share * (log(self.high) - log(self.low)))


@dataclass(frozen=True)
class Integers(Distribution, stored=False):
    """Whole numbers from `low` to `high`, both included, equally likely."""

    low: WholeNumber
    high: WholeNumber

    def at(self, share: float) -> int:
        return min(self.low + int(share * (self.high - self.low + 1)), self.high)


Factor: TypeAlias = Sequence[Any] | Mapping[str, Mapping[str, Any]] | Distribution
"""A list of values for a field; named levels, each a table of values by path; or a distribution."""
DISTRIBUTIONS: Final[dict[str, type[Any]]] = {kind.__name__: kind for kind in (Uniform, LogUniform, Integers)}
MOST_CONDITIONS: Final = 10_000
Design = Literal["random", "latin_hypercube", "sobol"]
"""The ways to draw combinations. "random" draws independently. "latin_hypercube" divides the range of each
factor into as many equal parts as there are draws, and draws once in each part. "sobol" uses Sobol's
sequence, whose points fill all ranges together evenly."""


@dataclass(frozen=True)
class Level:
    """A level of a factor."""

    value: Any
    """The value, or the name of a named level."""
    changes: Mapping[str, Any]
    """The values that the level sets in the experiment, by path."""


def checked_factors(factors: Mapping[str, Any]) -> dict[str, Factor]:
    """Return the factors of a study with normalised paths and with tuples of values; refuse any other.

    Raises:
        ValueError: for a factor that is none of the three; the message names it.
    """
    normal: dict[str, Factor] = {}
    for name, factor in factors.items():
        if isinstance(factor, Mapping) and factor:
            normal[name] = {level: _plain_changes(changes) for level, changes in factor.items()}
            continue
        path = normalised(name)
        values = _plain(factor)
        if isinstance(factor, Distribution):
            normal[path] = factor
        elif isinstance(values, tuple) and values:
            is_run = STORED_RUN.fullmatch(path)  # which Frozen keeps like this: levels keep their names
            normal[path] = tuple(normpath(run) if run else run for run in values) if is_run else values
        else:
            raise refusal(
                f"factors[{name!r}]",
                factor,
                "the values of the field that its path names, as a list; a table of named levels, each a "
                "table of values by path; or a distribution of cprl.studies.factors",
            )
    return normal


def _plain_changes(changes: Mapping[str, Any]) -> dict[str, Any]:
    return {normalised(path): _plain(value) for path, value in changes.items()}


def levels_of(name: str, factor: Factor) -> list[Level]:
    """Return the levels of a factor, which must not be a distribution."""
    assert not isinstance(factor, Distribution)
    if isinstance(factor, Mapping):
        return [Level(level, changes) for level, changes in factor.items()]
    return [Level(value, {name: value}) for value in factor]


def all_combinations(factors: Mapping[str, Factor]) -> list[dict[str, Level]]:
    """Return all combinations of the factors' levels; the last factor varies fastest.

    Raises:
        ValueError: for a distribution among the factors, or more than `MOST_CONDITIONS` combinations.
    """
    for name, factor in factors.items():
        if isinstance(factor, Distribution):
            raise refusal(f"factors[{name!r}]", factor, "in a grid levels, or with draws=N")
    every = product(*(levels_of(name, factor) for name, factor in factors.items()))
    combinations = [dict(zip(factors, levels, strict=True)) for levels in every]
    if len(combinations) > MOST_CONDITIONS:
        raise ValueError(f"a study has {len(combinations):,} conditions; allowed: up to {MOST_CONDITIONS:,}")
    return combinations


_TRIES: Final = 20
"""The number of draws for each combination that is asked for. More are drawn than asked for, since draws of
a few levels may be equal."""


def draw_combinations(
    factors: Mapping[str, Factor], draws: int, *, seed: int, design: Design
) -> Iterator[dict[str, Level]]:
    """Draw random combinations of levels, more than are asked for.

    A larger number of draws begins with the same combinations, except in a Latin hypercube.
    """
    for shares in _shares(len(factors), draws, seed, design):
        combination = {}
        for (name, factor), share in zip(factors.items(), shares, strict=True):
            if isinstance(factor, Distribution):
                value = factor.at(share)
                combination[name] = Level(value, {name: value})
            else:
                levels = levels_of(name, factor)
                combination[name] = levels[min(int(share * len(levels)), len(levels) - 1)]
        yield combination


def _shares(dimensions: int, draws: int, seed: int, design: Design) -> Iterable[Float64]:
    """Return draws from 0 to 1, float64 [draws, factors]: the quantile of each factor in each combination."""
    most = _TRIES * draws
    if design == "random":
        return (np.random.default_rng([seed, number]).random(dimensions) for number in range(most))
    from scipy.stats import qmc

    rng = np.random.default_rng(seed)
    if design == "latin_hypercube":
        points: Float64 = qmc.LatinHypercube(dimensions, rng=rng).random(draws)
    else:
        points = qmc.Sobol(dimensions, rng=rng).random_base2((most - 1).bit_length())
    return points


def factor_to_config(factor: Factor) -> dict[str, Any]:
    """Return a factor as JSON can hold it."""
    if isinstance(factor, Distribution):
        return {"distribution": type(factor).__name__, "low": factor.low, "high": factor.high}
    if isinstance(factor, Mapping):
        return {"levels": [[level, changes_to_config(changes)] for level, changes in factor.items()]}
    return {"values": [to_config(stored_game(value), "a value of a factor") for value in factor]}


def factor_from_config(name: str, table: Mapping[str, Any]) -> Factor:
    """Return the factor that `factor_to_config` gave."""
    if "distribution" in table:
        distribution: Distribution = DISTRIBUTIONS[table["distribution"]](table["low"], table["high"])
        return distribution
    if "levels" in table:
        return {level: changes_from_config(changes) for level, changes in table["levels"]}
    return tuple(_value_of(name, value) for value in table["values"])


def changes_to_config(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changes by path as JSON can hold them."""
    return {path: to_config(stored_game(_plain(value)), path) for path, value in changes.items()}


def changes_from_config(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes that `changes_to_config` gave."""
    return {path: _value_of(path, value) for path, value in table.items()}


def _value_of(path: str, table: Any) -> Any:
    value = from_config(table, path)
    return game_of(value) if path == "game" and isinstance(value, Custom) else value


def factors_of(experiment: Experiment, flags: Iterable[str]) -> dict[str, Factor]:
    """Parse the factors of a command line.

    Each flag is "PATH=VALUES": values separated by commas, e.g. "game.rules.freeze-steps=5,25", or a
    distribution, e.g. "agents.*.algorithm.settings.gamma=uniform(0.5,0.9)".

    Raises:
        ValueError: for a flag of another form, or a value that its field does not take.
    """
    factors: dict[str, Factor] = {}
    for flag in flags:
        path, equals, text = flag.partition("=")
        pieces = [piece.strip() for piece in _BETWEEN.split(text)]
        if not equals or not path or not all(pieces):
            raise refusal("--vary", flag, "PATH=VALUE,VALUE..., e.g. game.rules.freeze-steps=5,25,100")
        path = normalised(path)
        if path in factors:
            raise ValueError(f"--vary has {path} twice; allowed: once, with all its values")
        hints = _types_at(experiment, path)
        distribution = _DRAWN.fullmatch(text.replace("_", ""))
        if distribution is not None:
            kind = _BY_WORD[distribution[1].lower()]
            factors[path] = kind(*(_literal(end.strip()) for end in distribution[2].split(",")))
        else:
            factors[path] = tuple(_value(piece, hints, path) for piece in pieces)
    return factors


def _types_at(experiment: Experiment, path: str) -> list[Any]:
    """Return the annotated types of the fields that a path means, `Any` for a field without annotation."""
    table = experiment.to_config()
    hints = []
    for holder, name in places(table, path):
        kind: Any = None
        if holder is table:
            kind = Experiment
        elif isinstance(holder, Mapping):
            kind = KINDS.get(holder.get("kind", ""))
        is_typed = kind not in (None, Custom)
        hint = hints_of(kind)[name] if is_typed else Any
        hints.append(hint)
    return hints


_BETWEEN: Final = re.compile(r",(?![^(]*\))")
"""A comma outside of parentheses."""
_BY_WORD: Final[Mapping[str, Any]] = {name.lower(): kind for name, kind in DISTRIBUTIONS.items()}
_DRAWN: Final = re.compile(rf"\s*({'|'.join(_BY_WORD)})\(([^,]*,[^,]*)\)\s*", re.IGNORECASE)
_CONSTANTS: Final = {"true": True, "false": False, "none": None}


def _value(text: str, hints: Sequence[Any], path: str) -> Any:
    """Parse a value that fits the types of all fields of a path; a number also fits a list of one number."""
    value = _literal(text)
    for candidate in (value, (value,), text):
        if all(matches_type(candidate, hint) or (hint is Map and candidate == text) for hint in hints):
            return candidate if hints[0] is Map else checked(path, candidate, hints[0])
    allowed = " and ".join(map(describe_type, dict.fromkeys(hints)))
    raise ValueError(
        f"at the path {path} is {text!r}; allowed: {allowed}, by what a command line can say; a Study in "
        "Python can have any"
    )


def _literal(text: str) -> Any:
    """Parse a text as a Python literal, and "8x8" or "8 8" as (8, 8); return any other text unchanged."""
    numbers = re.split(r"\s*x\s*|\s+", text)
    try:
        if len(numbers) > 1 and "(" not in text:
            list(map(float, numbers))
            return tuple(map(literal_eval, numbers))
        return _CONSTANTS[text.lower()] if text.lower() in _CONSTANTS else literal_eval(text)
    except (ValueError, SyntaxError, TypeError):
        return text
