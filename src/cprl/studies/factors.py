"""What the conditions of a study differ in: factors with levels, and distributions of random draws.

A factor names places of values in an experiment, e.g. "agents.*.algorithm.settings.gamma": a name is a field
of a dataclass or an argument of a `Custom`, a number a place in a tuple. `*` stands for each value of a
tuple; in `agents` for each agent that learns. Words may be written with "-", as flags are.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from itertools import product
from math import exp, isfinite, log
from posixpath import normpath
from types import NoneType, UnionType
from typing import Any, Final, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

import numpy as np

from cprl.arguments import refusal
from cprl.checks import MOST_NUMBER, is_count, is_number, shown
from cprl.commons import maps
from cprl.commons.maps import Map
from cprl.custom import Custom
from cprl.envs.make_env import game_of, stored_game
from cprl.experiment import Experiment
from cprl.population import Learning, Team, with_run_moved
from cprl.values import fits, from_config, to_config, words

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
    values = from_config(table["values"])
    return tuple(_read(name, own, place) for own in values)


def changes_to_config(changes: Mapping[str, Any], place: Callable[[str], str]) -> dict[str, Any]:
    """Values by path as JSON can hold them."""
    return {path: to_config(_stored(path, value, place), path) for path, value in changes.items()}


def changes_from_config(
    table: Mapping[str, Any], allow: Sequence[str], place: Callable[[str], str]
) -> dict[str, Any]:
    """The values by path that `changes_to_config` gave."""
    return {path: _read(path, from_config(value, path), place) for path, value in table.items()}


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


ALL: Final = "*"
_SELF: Final = object()


def normalised(path: object) -> str:
    """A path as it is kept, without "-"; raises a ValueError for what is no path."""
    if not isinstance(path, str) or not path or not all(path.split(".")):
        raise refusal("path", path, 'names with dots between them, e.g. "game.rules.freeze_steps"')
    return path.replace("-", "_")


def changed(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """An experiment with other values in some places, all of them changed at once.

    A path within a value that is changed too applies to the new value, and one with a number after one
    with `*`.

    Args:
        experiment: as it is.
        changes: the new values by path; lists become tuples, and a board may be given by its name.
    """
    tree: dict[Any, Any] = {}
    for path, value in changes.items():
        node = tree
        for name in normalised(path).split("."):
            node = node.setdefault(name, {})
        node[_SELF] = value
    try:
        made: Experiment = _applied(experiment, tree, ())
    except ValueError as error:
        if "path" in str(error):
            raise
        raise ValueError(f"with {', '.join(changes)}: {error}") from error
    return made


def values_at(experiment: Experiment, path: str) -> list[Any]:
    """The values in the places that a path names, at least one."""
    return [value for value, _ in _found(experiment, normalised(path).split("."), (), Experiment)]


def types_at(experiment: Experiment, path: str) -> list[Any]:
    """The annotated types of the places that a path names; see `values_at`."""
    return [hint for _, hint in _found(experiment, normalised(path).split("."), (), Experiment)]


def _found(value: Any, left: list[str], at: tuple[str, ...], hint: Any) -> Iterator[tuple[Any, Any]]:
    if not left:
        yield value, hint
        return
    for name in _names(value, left[0], at):
        yield from _found(_child(value, name), left[1:], (*at, name), _hint(value, name, hint))


def _applied(value: Any, tree: Mapping[Any, Any], at: tuple[str, ...]) -> Any:
    """A value with the changes of a tree; see `changed`."""
    new: dict[str, Any] = {}
    for name in sorted((own for own in tree if own is not _SELF), key=lambda own: own != ALL):
        for place in _names(value, name, at):
            old = new.get(place, _child(value, place))
            node, where = tree[name], (*at, place)
            if _SELF in node:
                old = _fitting(node[_SELF], _hint(value, place, None), where)
            new[place] = _applied(old, node, where)
    return _with(value, new) if new else value


def _names(value: Any, name: str, at: tuple[str, ...]) -> list[str]:
    """The children that a word of a path names, at least one."""
    children = _children(value)
    where = ".".join(at) or "the experiment"
    if name == ALL and isinstance(value, tuple):
        named = [
            own for own in children if at != ("agents",) or isinstance(_child(value, own), Learning | Team)
        ]
        if named:
            return named
        raise ValueError(
            f"the path {'.'.join((*at, name))} matches nothing: {where} has no agent that learns"
        )
    if name in children:
        return [name]
    close = get_close_matches(name, children, n=1)
    meant = f" (did you mean {close[0]!r}?)" if close else ""
    has = f"{where} has {', '.join(children)}" if children else f"{where} is {shown(value)}"
    raise ValueError(f"the path {'.'.join((*at, name))} matches nothing{meant}; {has}")


def _children(value: Any) -> list[str]:
    if isinstance(value, Custom):
        return ["target", "arguments"]
    if isinstance(value, Mapping):
        return [str(own) for own in value]
    if isinstance(value, tuple):
        return list(map(str, range(len(value))))
    return [own.name for own in fields(value) if own.init] if is_dataclass(value) else []


def _child(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return value[name]
    return value[int(name)] if isinstance(value, tuple) else getattr(value, name)


def _hint(value: Any, name: str, own: Any) -> Any:
    """The annotated type of a child; `Any` where nothing says it."""
    if is_dataclass(value):
        return get_type_hints(type(value))[name]
    if isinstance(value, tuple):
        kinds = get_args(own) if get_origin(own) is tuple else ()
        if kinds[1:] == (Ellipsis,):
            return kinds[0]
        return kinds[int(name)] if len(kinds) == len(value) else Any
    return Any


def _with(value: Any, new: Mapping[str, Any]) -> Any:
    if isinstance(value, tuple):
        return tuple(new.get(str(place), own) for place, own in enumerate(value))
    if isinstance(value, Mapping):
        return {**value, **new}
    return replace(value, **new)


def _fitting(value: Any, hint: Any, at: tuple[str, ...]) -> Any:
    """A value as a place of this type has it."""
    found = _as_tuples(value)
    if hint is Map and isinstance(found, str):
        try:
            return maps.named(found)
        except ValueError as error:
            raise ValueError(f"at the path {'.'.join(at)}: {error}") from error
    if not fits(found, hint):
        raise ValueError(f"at the path {'.'.join(at)} is {shown(value)}; allowed: {words(hint)}")
    return found


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


_BY_WORD: Final[Mapping[str, Any]] = {name.lower(): kind for name, kind in DISTRIBUTIONS.items()}
"""What draws values, by the word before its range: "loguniform(1e-5, 1e-3)"."""

_DRAWN: Final = re.compile(r"\s*([a-z_]+)\((.*)\)\s*", re.IGNORECASE)
_FORM: Final = "PATH=VALUE,VALUE..., e.g. game.rules.freeze-steps=5,25,100"
_INNER: Final = re.compile(r"[\s,]+|(?<=[\d.])\s*x\s*(?=[-+\d.])")
_BOOLS: Final = {"true": True, "false": False}


def factors_of(experiment: Experiment, words: Iterable[str]) -> dict[str, Factor]:
    """Factors for a `Study` of this experiment.

    Args:
        experiment: whose fields the paths name.
        words: "PATH=VALUES" each; values with commas between them, or a distribution with its range.
    """
    found: dict[str, Factor] = {}
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path:
            raise ValueError(f"--vary is {shown(word)}; allowed: {_FORM}")
        path = normalised(path)
        if path in found:
            raise ValueError(f"--vary has {path} twice; allowed: once, with all its values")
        found[path] = _factor_in(experiment, path, text)
    return found


def _factor_in(experiment: Experiment, path: str, text: str) -> Factor:
    hints = types_at(experiment, path)
    drawn = _DRAWN.fullmatch(text)
    if drawn is not None and not any(fits(text, hint) for hint in hints):
        return _distribution(path, *drawn.groups())
    pieces = _pieces(text)
    if not pieces or not all(pieces):
        raise ValueError(f"the values at the path {path} are {shown(text)}; allowed: {_FORM}")
    return tuple(_value(piece, hints, path) for piece in pieces)


def _distribution(path: str, name: str, inside: str) -> Distribution:
    kind = _BY_WORD.get(name.lower().replace("_", ""))
    ends = [_scalar(end.strip(), int if kind is Integers else float) for end in inside.split(",")]
    if kind is None or len(ends) != 2 or _UNREAD in ends:
        allowed = ", ".join(f"{own}(LOW, HIGH)" for own in _BY_WORD)
        raise ValueError(
            f"at the path {path} is {name}({inside}); allowed: {allowed}, whole numbers for integers"
        )
    made: Distribution = kind(*ends)
    return made


def _value(text: str, hints: list[Any], path: str) -> Any:
    """A value that every place of the path can have."""
    for hint in hints:
        value = _read_word(text, hint)
        if value is not _UNREAD and all(own is Map or fits(value, own) for own in hints):
            return value
    kinds = [kind for hint in dict.fromkeys(hints) if (kind := _sayable(hint)) is not None]
    if not kinds:
        raise ValueError(
            f"the path {path} holds {words(hints[0])}, which a command line cannot say; allowed: paths "
            "of its fields, or a Study in Python"
        )
    raise ValueError(f"at the path {path} is {text!r}; allowed: {' and '.join(map(words, kinds))}")


_UNREAD: Final = object()


def _read_word(text: str, hint: Any) -> Any:
    """A text as a value of a type; `_UNREAD` for one that it cannot have."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        ordered = sorted(arguments, key=lambda own: own in (str, Any))
        return next((value for own in ordered if (value := _read_word(text, own)) is not _UNREAD), _UNREAD)
    if origin is Literal:
        return next((own for own in arguments if str(own) == text), _UNREAD)
    if origin is tuple:
        return _tuple(text, arguments)
    if hint is Any:
        return _read_word(text, None | bool | int | float | str)
    return text if hint is Map else _scalar(text, hint)


def _scalar(text: str, hint: Any) -> Any:
    if hint is str:
        return text
    if hint is NoneType:
        return None if text.lower() == "none" else _UNREAD
    if hint is bool:
        return _BOOLS.get(text.lower(), _UNREAD)
    if hint not in (int, float):
        return _UNREAD
    try:
        number = hint(text)
    except ValueError:
        return _UNREAD
    return number if isfinite(number) else _UNREAD


def _tuple(text: str, arguments: tuple[Any, ...]) -> Any:
    inside = text.removeprefix("(").removesuffix(")").strip(" ,")
    words = _INNER.split(inside) if inside else []
    if arguments[-1:] == (Ellipsis,):
        arguments = (arguments[0],) * len(words)
    if len(words) != len(arguments):
        return _UNREAD
    values = tuple(_read_word(word, hint) for word, hint in zip(words, arguments, strict=True))
    return _UNREAD if _UNREAD in values else values


def _sayable(hint: Any) -> Any:
    """The part of a type that words can be; None for nothing."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        kept = [own for argument in arguments if (own := _sayable(argument)) not in (None, NoneType)]
        if kept and NoneType in arguments:
            kept.append(NoneType)
        return Union[tuple(kept)] if kept else None  # noqa: UP007
    if origin is tuple:
        inner = [own for own in arguments if own is not Ellipsis]
        return (
            hint if inner and all(get_origin(own) is not tuple and _sayable(own) for own in inner) else None
        )
    return hint if hint in (bool, int, float, str, NoneType, Map, Any) or origin is Literal else None


def _pieces(text: str) -> list[str]:
    """The texts between commas that are in no parentheses."""
    pieces, depth = [""], 0
    for sign in text:
        depth += (sign == "(") - (sign == ")")
        if sign == "," and depth <= 0:
            pieces.append("")
        else:
            pieces[-1] += sign
    return [piece.strip() for piece in pieces]
