"""Values of cprl as tables that JSON can hold, and back.

A frozen dataclass becomes `{"kind": "DQN", ...its fields}`, a tuple a list. Reading is strict: what is not
known is refused by name, with the place where it stands, e.g. `experiment.agents[0].algorithm.settings.gama`.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from math import isfinite
from types import NoneType, UnionType
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from cprl.algorithms import (
    A2C,
    CQL,
    DQN,
    IPPO,
    IQL,
    LOLA,
    MADDPG,
    MAPPO,
    PPO,
    PR2,
    QMIX,
    SAC,
    VDN,
    DistributionalDQN,
    DQNSettings,
    LOLASettings,
    Reinforce,
    RolloutSettings,
    Tabular,
    TabularSettings,
)
from cprl.algorithms.base import Algorithm
from cprl.checks import check_nesting, shown
from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.commons.observation import Observation
from cprl.commons.rules import Rules
from cprl.custom import Custom
from cprl.envs.matrix import MatrixGame
from cprl.envs.taking import TakingGame
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.learners.decisions import Bandit
from cprl.learners.preferences import Exchange, InequityAversion, SocialValueOrientation
from cprl.networks import GRU, LSTM, MLP, Conv
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.theory import PowerWorth, SharingGame

_OF_CPRL: Final[tuple[type[Any], ...]] = (
    *(Game, Map, Rules, Observation, Learning, Team, Scripted, Frozen),
    *(MatrixGame, TakingGame, SharingGame, PowerWorth),
    *(InequityAversion, SocialValueOrientation, Exchange),
    *(Boundaries, ClosedPatches, ClosedSeason, GraduatedSanctions, Levies, Mediation),
    *(Monitoring, Quota, Sanctioner, Tax, Vote),
    *(DQN, DistributionalDQN, CQL, SAC, IQL, PPO, A2C, Reinforce, VDN, QMIX, MAPPO, IPPO, MADDPG),
    *(PR2, LOLA, Tabular),
    *(DQNSettings, RolloutSettings, LOLASettings, TabularSettings, Bandit, MLP, Conv, GRU, LSTM),
    Custom,
)
KINDS: Final[dict[str, type[Any]]] = {kind.__name__: kind for kind in _OF_CPRL}
"""The values that a table can hold, by the name that stands in it as "kind": the one registry of them."""

T = TypeVar("T")


def to_config(value: object, where: str = "value") -> Any:
    """The value as JSON can hold it: tables, lists, strings, numbers, booleans and None.

    Args:
        value: a value of `KINDS`, tuples of them, or what JSON has.
    """
    check_nesting(value, where)
    return _config(value, where)


def _config(value: object, where: str) -> Any:
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, float):
        if not isfinite(value):
            raise ValueError(f"{where} is {value}; allowed: a finite number")
        return float(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, tuple | list):
        return [_config(entry, f"{where}[{place}]") for place, entry in enumerate(value)]
    if isinstance(value, Custom):
        return {"kind": "Custom", "target": value.target, "arguments": dict(value.arguments)}
    if is_dataclass(value) and KINDS.get(type(value).__name__) is type(value):
        return {"kind": type(value).__name__, **fields_to_config(value, where)}
    raise ValueError(_refusal(value, where))


def fields_to_config(
    value: Any, where: str, *, instead: Mapping[str, object] | None = None
) -> dict[str, Any]:
    """The fields of a dataclass, each as `to_config` gives it and of the type that it says.

    Args:
        instead: values of fields by name, in place of its own.
    """
    hints, table = _hints(type(value)), {}
    for name in hints:
        own, place = (instead or {}).get(name, getattr(value, name)), f"{where}.{name}"
        table[name] = to_config(own, place)
        _check_type(own, hints[name], place)
    return table


def from_config(table: object, where: str = "value", *, allow: Iterable[str] = ()) -> Any:
    """The value that `to_config` gave; lists become tuples. Nothing is imported.

    Args:
        allow: the targets of `Custom` that it may hold, "module:Class" each.
    """
    check_nesting(table, where)
    refuse_targets(table, allow)
    return _value(table, where)


def fields_from_config(kind: type[T], table: object, where: str, *, allow: Iterable[str] = ()) -> T:
    """A dataclass out of the table of its fields; see `from_config`. Missing ones take their defaults."""
    check_nesting(table, where)
    refuse_targets(table, allow)
    return _built(kind, table, where)


def custom_targets(table: object) -> list[str]:
    """The targets of each `Custom` in a table that `to_config` gave, sorted, each once."""
    check_nesting(table, "the table")
    return sorted(set(_targets(table)))


def refuse_targets(table: object, allow: Iterable[str]) -> None:
    """Refuses a table that would import what is not allowed."""
    allowed = set(allow)
    refused = [target for target in custom_targets(table) if target not in allowed]
    if refused:
        flags = " ".join(f"--allow {target}" for target in refused)
        raise ValueError(
            f"{', '.join(refused)} would be imported, which is code of somebody's own; if you trust it: "
            f"{flags} (in Python allow={refused!r})"
        )


def _targets(table: object) -> Iterator[str]:
    if isinstance(table, Mapping):
        if table.get("kind") == "Custom":
            yield str(table.get("target"))
        else:
            for entry in table.values():
                yield from _targets(entry)
    elif isinstance(table, list | tuple):
        for entry in table:
            yield from _targets(entry)


def _value(table: object, where: str) -> Any:
    if isinstance(table, float) and not isfinite(table):
        raise ValueError(f"{where} is {table}; allowed: a finite number")
    if table is None or isinstance(table, bool | int | float | str):
        return table
    if isinstance(table, list | tuple):
        return tuple(_value(entry, f"{where}[{place}]") for place, entry in enumerate(table))
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} is a {type(table).__name__}, which JSON does not have")
    name = table.get("kind")
    if not isinstance(name, str) or name not in KINDS:
        raise ValueError(
            f"{where}.kind is {name!r}{_meant(name, KINDS)}; allowed: {', '.join(sorted(KINDS))}"
            if "kind" in table
            else f'{where} is a table without "kind"; allowed: {", ".join(sorted(KINDS))}'
        )
    return _built(KINDS[name], {key: own for key, own in table.items() if key != "kind"}, where)


def _built(kind: type[T], table: object, where: str) -> T:
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} is {shown(table)}; allowed: a table of the fields of {kind.__name__}")
    hints = _hints(kind)
    for name in table:
        if name not in hints:
            raise ValueError(
                f"{where}.{name} is no field of {kind.__name__}{_meant(name, hints)}; it has "
                f"{', '.join(hints)}"
            )
    values = {name: own if kind is Custom else _value(own, f"{where}.{name}") for name, own in table.items()}
    for name, own in values.items():
        _check_type(own, hints[name], f"{where}.{name}")
    lacking = [name for name in _required(kind) if name not in values]
    if lacking:
        raise ValueError(f"{where} lacks {', '.join(lacking)}, which {kind.__name__} requires")
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _required(kind: Any) -> list[str]:
    return [
        field.name
        for field in fields(kind)
        if field.init and field.default is MISSING and field.default_factory is MISSING
    ]


def _hints(kind: Any) -> dict[str, Any]:
    """The fields that are given to a dataclass, in its order, and their types."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind) if field.init}


def _check_type(value: object, hint: Any, where: str) -> None:
    if not fits(value, hint):
        raise ValueError(f"{where} is {shown(value)}; allowed: {type_text(hint)}")


def _refusal(value: object, where: str) -> str:
    named = value if isinstance(value, type) or hasattr(value, "__qualname__") else type(value)
    name = getattr(named, "__qualname__", "<none>")
    target = f"{named.__module__}:{name}" if "<" not in name else "module:name"
    also = " of a class or function at the top of a module" if "<" in name else ""
    if isinstance(value, Algorithm):
        return (
            f"{where} is a {name}, which a recipe cannot hold; allowed: algorithms of cprl, or "
            'Custom("module:function", arguments={...}) of a function at the top of a module that makes it '
            'from numbers, texts and lists, see docs/algorithms.md, "An algorithm of your own"'
        )
    what = "a class" if isinstance(value, type) else f"a {type(value).__name__}"
    return (
        f"{where} is {what}, which a recipe cannot hold; allowed: values of cprl, or "
        f'Custom("{target}", arguments={{...}}){also}'
    )


def _meant(name: object, known: Iterable[str]) -> str:
    close = get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def fits(value: object, hint: Any) -> bool:
    """Whether a value is of an annotated type; whole numbers are numbers too, True and False are not."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in (Union, UnionType):
        return any(fits(value, own) for own in arguments)
    if origin is Literal:
        return any(value == own and type(value) is type(own) for own in arguments)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        if arguments[-1:] == (Ellipsis,):
            return all(fits(entry, arguments[0]) for entry in value)
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, origin or hint)


def type_text(hint: Any) -> str:
    """A type in words, for messages."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(map(type_text, arguments))
    if origin is Literal:
        return ", ".join(map(repr, arguments))
    if origin is tuple:
        inner = ", ".join("..." if own is Ellipsis else type_text(own) for own in arguments)
        return f"({inner})"
    words = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", NoneType: "None"}
    return words.get(hint) or f"a {getattr(hint, '__name__', hint)}"


_ABSENT: Final = object()


def differences(before: object, now: object, where: str, kind: Any = None) -> list[str]:
    """How two tables differ, a sentence for each place.

    A field that the earlier one lacks, and that has its default in the later one, is no difference: a version
    that did not know the field did what its default says.

    Args:
        kind: the dataclass that they are of, where they do not say it themselves.
    """
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if before.get("kind") == now.get("kind"):
            return [
                line
                for name in {**before, **now}
                if not _is_default_of_later(name, before, now, kind)
                for line in differences(before.get(name, _ABSENT), now.get(name, _ABSENT), f"{where}.{name}")
            ]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [line for place, (a, b) in pairs for line in differences(a, b, f"{where}[{place}]")]
    return [] if before == now else [f"{where} was {_held(before)}, is {_held(now)}"]


def _is_default_of_later(
    name: str, before: Mapping[str, Any], now: Mapping[str, Any], kind: Any = None
) -> bool:
    """Whether a field is one of a later version, and says nothing that the earlier one did not do."""
    if before.get(name) is None and now.get(name) is None:
        return True
    kind = KINDS.get(str(now.get("kind"))) if kind is None else kind
    if name in before or kind is None:
        return False
    defaults = defaults_of(kind)
    return name in defaults and without_defaults(now[name]) == defaults[name]


def defaults_of(kind: Any) -> dict[str, Any]:
    """The defaults of the fields of a dataclass as a recipe holds them; those without one are left out."""
    found = {}
    for own in fields(kind):
        if own.init and own.default is not MISSING:
            found[own.name] = own.default
        elif own.init and own.default_factory is not MISSING:
            found[own.name] = own.default_factory()
    tables = {  # the arguments of a Custom are a table already
        name: value if isinstance(value, Mapping) else to_config(value) for name, value in found.items()
    }
    return {name: without_defaults(table) for name, table in tables.items()}


def without_defaults(table: Any, kind: Any = None) -> Any:
    """A table of `to_config` without the fields that have their default, and with 1.0 as 1."""
    if isinstance(table, list):
        return [without_defaults(own) for own in table]
    if isinstance(table, float) and table.is_integer():
        return int(table)
    if not isinstance(table, Mapping):
        return table
    if table.get("kind") == "Custom":
        return dict(table)
    kind = KINDS.get(str(table.get("kind"))) if kind is None else kind
    left_out = {} if kind is None else defaults_of(kind)
    plain = {name: without_defaults(own) for name, own in table.items()}
    return {name: own for name, own in plain.items() if name not in left_out or own != left_out[name]}


def _held(value: object) -> str:
    return "not there" if value is _ABSENT else shown(value)
