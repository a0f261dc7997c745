"""Values: frozen dataclasses whose annotations say what each field allows, and the tables that keep them.

    gamma: Annotated[float, Range(0, 1)] = 0.995

The annotation is the one place for a field's range. It serves construction, recipes, command lines, paths of
studies and tests. `Value` checks fields and stores them as plain Python: lists and arrays as tuples, numpy's
numbers as Python's, whole numbers of a float field as floats. A refusal is a ValueError of one form:
"DQNSettings.gamma is 7; allowed: a number in 0..1".

A table is what JSON can hold of a value, `{"kind": "DQN", ...its fields}`; a tuple is a list there. Reading a
table is strict: what is not known is refused by the place where it stands. `cprl.values.custom` has Custom,
something of the user's own by its name, `cprl.values.departed` what values no longer have,
`cprl.values.arrays` the types of numpy arrays.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import partial
from math import isfinite
from types import FunctionType, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from cprl.values.custom import OWN_METRICS as OWN_METRICS
from cprl.values.custom import Custom as Custom
from cprl.values.custom import custom_of as custom_of
from cprl.values.custom import custom_targets as custom_targets
from cprl.values.custom import described as described
from cprl.values.custom import live_targets as live_targets
from cprl.values.custom import made as made
from cprl.values.custom import refuse_live as refuse_live
from cprl.values.custom import refuse_other_keys as refuse_other_keys
from cprl.values.custom import refuse_targets
from cprl.values.custom import shown as shown
from cprl.values.custom import source_of as source_of
from cprl.values.custom import trust as trust
from cprl.values.custom import trusted as trusted
from cprl.values.custom import trusting as trusting
from cprl.values.custom import words_of_metric as words_of_metric
from cprl.values.departed import KINDS_THAT_LEFT
from cprl.values.departed import without_departed as without_departed

T = TypeVar("T")

MOST_INT32: Final = 2**31 - 1
MOST_INT64: Final = 2**63 - 1
MOST_NUMBER: Final = 1e30
"""The largest number that is allowed where nothing else bounds it; its products still fit into float32."""

KINDS: Final[dict[str, type[Any]]] = {"Custom": Custom}
"""The classes that a table can hold, by the name that stands in it as "kind"; they register themselves."""

_MOST_ENTRIES: Final = 2**22


class Range(NamedTuple):
    """Numbers from `low` to `high`, both included."""

    low: float
    high: float

    def __call__(self, value: Any) -> bool:
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        return f"in {_bound(self.low)}..{_bound(self.high)}"


class Where(NamedTuple):
    """What a function accepts of the annotated type, and all that is allowed in words."""

    fits: Callable[[Any], bool]
    allowed: str

    def __call__(self, value: Any) -> bool:
        return self.fits(value)

    def __str__(self) -> str:
        return self.allowed


Natural = Annotated[int, Range(0, MOST_INT32)]
Positive = Annotated[int, Range(1, MOST_INT32)]
Steps = Annotated[int, Range(1, MOST_INT64)]
"""An integer from 1, as large as a count of steps can get."""
Share = Annotated[float, Range(0, 1)]
Seed = Annotated[int, Range(0, 2**64 - 1)]
"""The seed of a random generator."""
PositiveShare = Annotated[float, Where(lambda value: 0 < value <= 1, "a number above 0, at most 1")]
Odd = Annotated[int, Where(lambda value: 1 <= value <= MOST_INT32 and value % 2 == 1, "an odd integer >= 1")]


_MOST_NAME: Final = 200


def _is_directory_name(name: str) -> bool:
    is_one = name.isprintable() and not set(name) & set("/\\") and name == name.strip(" ").rstrip(".")
    return is_one and 0 < len(name.encode()) <= _MOST_NAME


DirectoryName = Annotated[
    str,
    Where(
        _is_directory_name,
        f"the name of a directory, up to {_MOST_NAME} bytes of printable text, without slashes",
    ),
]
"""A text that can be a part of a directory's name, wherever a run is copied to."""
AgentIndices = Annotated[
    tuple[Natural, ...],
    Where(
        lambda agents: len(agents) > 0 and list(agents) == sorted(set(agents)),
        "ascending agent indices, at least one",
    ),
]


class Value:
    """The base of frozen dataclasses whose fields are checked by their annotations when they are made.

    A subclass may be given, as arguments of the class, `stored`: whether a table can hold its values, of
    cprl's classes only; and `called`: what it is called in messages, by default its name.

    Raises:
        ValueError: for a field that its annotation does not allow; names the field and what is allowed.
    """

    _called: str = ""

    def __init_subclass__(cls, *, stored: bool = True, called: str = "", **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        cls._called = called or cls.__name__
        if stored and cls.__module__.startswith("cprl."):
            KINDS[cls.__name__] = cls

    def __post_init__(self) -> None:
        for name, hint in hints_of(type(self)).items():
            place = f"{self._called}.{name}"
            object.__setattr__(self, name, checked(place, getattr(self, name), hint))

    def to_config(self) -> dict[str, Any]:
        """Return the fields as JSON can hold them, see `cprl.values.to_config`."""
        names = hints_of(type(self))
        return {name: to_config(getattr(self, name), f"{self._called}.{name}") for name in names}


_HINTS: Final[dict[Any, dict[str, Any]]] = {}


def hints_of(kind: Any) -> dict[str, Any]:
    """Return the annotations of the fields that a dataclass is made from, in their order."""
    if kind not in _HINTS:
        hints = get_type_hints(kind, include_extras=True)
        _HINTS[kind] = {field.name: hints[field.name] for field in fields(kind) if field.init}
    return _HINTS[kind]


class _UnfitError(Exception):
    """A value is not of a type."""


def checked(name: str, value: Any, hint: Any) -> Any:
    """Return a value of an annotated type as plain Python.

    Raises:
        ValueError: for a value of another type; names it and says what is allowed.
    """
    try:
        return _converted(value, hint)
    except _UnfitError:
        raise _refused(name, value, hint) from None


def _refused(name: str, value: Any, hint: Any) -> ValueError:
    """The error for a value that is not of an annotated type; of a tuple of objects it names the entry."""
    inner = get_args(hint)
    if get_origin(hint) is tuple and inner[-1:] == (Ellipsis,) and isinstance(value, list | tuple):
        options = get_args(inner[0]) or inner[:1]
        if any(isinstance(option, type) and option not in _PLAIN_TYPES for option in options):
            place = next((place for place, entry in enumerate(value) if not fits(entry, inner[0])), None)
            if place is not None:
                return _refused(f"{name}[{place}]", value[place], inner[0])
    is_object = not isinstance(value, (*_SIMPLE, Value, Custom))
    if is_object and Custom in (*get_args(hint), hint):
        return ValueError(_not_stored(value, name))
    return refusal(name, value, words(hint))


_SIMPLE: Final = (str, bytes, int, float, complex, tuple, list, dict, set, range, NoneType, type)


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of an annotated type; whole numbers are floats too, True is no number."""
    try:
        _converted(value, hint)
    except _UnfitError:
        return False
    return True


def _converted(value: Any, hint: Any) -> Any:
    """A value of an annotated type as plain Python; raises `_UnfitError` for others."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin is Annotated:
        value = _converted(value, inner[0])
        if not all(check(value) for check in inner[1:] if isinstance(check, Range | Where)):
            raise _UnfitError
        return value
    if origin in (Union, UnionType):
        for option in inner:
            try:
                return _converted(value, option)
            except _UnfitError:
                pass
        raise _UnfitError
    if origin is tuple:
        return _tuple(_plain(value), inner)
    if origin is Literal or hint in _PLAIN_TYPES:
        value = _plain(value)
    if origin is Literal:
        if any(value == option and type(value) is type(option) for option in inner):
            return value
        raise _UnfitError
    if hint is int:
        return _integer(value)
    if hint is float:
        return _number(value)
    if hint is Custom:
        value = handed_over(value)
    if isinstance(value, type) or not isinstance(value, origin or hint):
        raise _UnfitError
    return value


def handed_over(value: Any) -> Any:
    """Return a class or function of the user's own, or a `functools.partial` of one, as a `Custom`, see
    `custom_of`; anything else, such as a class of cprl's values, as it is."""
    named = value.func if isinstance(value, partial) else value
    return value if KINDS.get(getattr(named, "__name__", "")) is named else custom_of(value)


_PLAIN_TYPES: Final = frozenset({int, float, bool, str, NoneType})


def _tuple(value: Any, inner: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple | range) or value[_MOST_ENTRIES:]:
        raise _UnfitError
    if inner[-1:] == (Ellipsis,):
        return tuple(_converted(entry, inner[0]) for entry in value)
    if len(value) != len(inner):
        raise _UnfitError
    return tuple(_converted(entry, hint) for entry, hint in zip(value, inner, strict=True))


def _plain(value: Any) -> Any:
    """Arrays as lists, scalars of numpy and torch as Python's; anything else as it is."""
    if isinstance(value, str):
        return str.__str__(value)  # a recipe holds no text of another class
    if not isinstance(value, type) and callable(getattr(value, "tolist", None)):
        try:
            return value.tolist()
        except Exception:  # a tensor without values, sparse or on "meta"
            raise _UnfitError from None
    return value


def _integer(value: Any) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value)
    raise _UnfitError


def _number(value: Any) -> float:
    try:
        number = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
    except OverflowError:
        number = None
    if number is None or not isfinite(number):
        raise _UnfitError
    return number


def words(hint: Any) -> str:
    """Return an annotated type in words, for messages."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        checks = [check for check in inner[1:] if isinstance(check, Range | Where)]
        said = [check for check in checks if isinstance(check, Where)]
        return str(said[0]) if said else " ".join([words(inner[0]), *map(str, checks)])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(words, inner)))
    if origin is Literal:
        return ", ".join(map(repr, inner))
    if origin is tuple:
        return f"({', '.join('...' if entry is Ellipsis else words(entry) for entry in inner)})"
    return _WORDS.get(hint) or f"a {getattr(hint, '__name__', hint)}"


_WORDS: Final = {
    int: "an integer",
    float: "a number",
    bool: "True or False",
    str: "a text",
    NoneType: "None",
    Custom: 'a Custom("module:Class", arguments={...})',
}


def _bound(bound: float) -> str:
    if isinstance(bound, int):
        bits = (bound + 1).bit_length() - 1
        return f"2**{bits} - 1" if bits > 20 and bound + 1 == 2**bits else str(bound)
    return f"{bound:g}"


def refusal(name: str, value: object, allowed: str) -> ValueError:
    return ValueError(f"{name} is {shown(value)}; allowed: {allowed}")


def meant(name: object, known: Iterable[str]) -> str:
    """Return " (did you mean ...?)" where a name is close to one that is known, else an empty text."""
    close = get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


@contextmanager
def _not_too_deep(where: str) -> Iterator[None]:
    try:
        yield
    except RecursionError:
        raise ValueError(f"{where} is nested too deeply") from None


def to_config(value: object, where: str = "value") -> Any:
    """Return a value as JSON can hold it: tables, lists, texts, numbers, booleans and None.

    Raises:
        ValueError: for what is neither of `KINDS` nor of JSON, with its place and what to write instead.
    """
    with _not_too_deep(where):
        return _config(value, where)


def _config(value: object, where: str) -> Any:
    if isinstance(value, Custom):
        table = {"kind": "Custom", "target": value.target, "arguments": dict(value.arguments)}
        return {**table, "live": value.live} if value.live else table
    if is_dataclass(value) and KINDS.get(type(value).__name__) is type(value):
        entries = {name: getattr(value, name) for name in hints_of(type(value))}
        table = {name: _config(entry, f"{where}.{name}") for name, entry in entries.items()}
        return {"kind": type(value).__name__, **table}
    if isinstance(value, Value) and not type(value).__module__.startswith("cprl."):
        names = hints_of(type(value))
        entries = {name: _config(getattr(value, name), f"{where}.{name}") for name in names}
        return _config(replace(custom_of(type(value)), arguments=entries), where)
    if isinstance(value, tuple | list):
        return [_config(entry, f"{where}[{place}]") for place, entry in enumerate(value)]
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, float) and not isfinite(value):
        raise ValueError(f"{where} is {value}; allowed: a finite number")
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)
    raise ValueError(_not_stored(value, where))


def _not_stored(value: object, where: str) -> str:
    kind = type(value)
    what, one = f"a {kind.__name__}", "a class or function of your own"
    allowed = f"{one} itself, or a functools.partial of it with keyword arguments"
    if isinstance(value, type | FunctionType):
        what = "a class" if isinstance(value, type) else "a function"
        allowed = 'Custom("module:name", arguments={...}) of a class or function at the top of a module'
    elif isinstance(value, partial) and handed_over(value) is value and not value.args:
        name = getattr(value.func, "__name__", "name")
        return f"{where} is a partial, which a recipe cannot hold; allowed: {name}(...)"
    elif isinstance(value, partial):
        allowed = f"a functools.partial of {one} with keyword arguments alone"
    elif kind.__module__ not in ("builtins", "__main__") and "<" not in kind.__qualname__:
        allowed = f'{allowed}, e.g. Custom("{kind.__module__}:{kind.__qualname__}", arguments={{...}})'
    return f"{where} is {what}, which a recipe cannot hold; allowed: values of cprl, or {allowed}"


def from_config(table: object, where: str = "value") -> Any:
    """Return the value that `to_config` gave; lists become tuples. Nothing is imported.

    Raises:
        ValueError: for what is not known, with its place; for code of the user's own that this process
            does not trust, see `cprl.trust`.
    """
    with _not_too_deep(where):
        refuse_targets(table)
        return _value(table, where)


def build(kind: type[T], table: object, where: str) -> T:
    """Return a dataclass out of the table of its fields, as `from_config`; missing ones take defaults."""
    with _not_too_deep(where):
        refuse_targets(table)
        return _built(kind, table, where)


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
    if isinstance(name, str) and name in KINDS_THAT_LEFT:
        raise ValueError(f"{where}.kind is {name!r}, which cprl no longer has: {KINDS_THAT_LEFT[name]}")
    if not isinstance(name, str) or name not in KINDS:
        raise ValueError(
            f"{where}.kind is {shown(name)}{meant(name, KINDS)}; allowed: {', '.join(sorted(KINDS))}"
            if "kind" in table
            else f'{where} is a table without "kind"; allowed: {", ".join(sorted(KINDS))}'
        )
    return _built(KINDS[name], {key: entry for key, entry in table.items() if key != "kind"}, where)


def _built(kind: type[T], table: object, where: str) -> T:
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} is {shown(table)}; allowed: a table of the fields of {kind.__name__}")
    hints = hints_of(kind)
    for name in table:
        if name not in hints:
            raise ValueError(
                f"{where}.{name} is no field of {kind.__name__}{meant(name, hints)}; it has "
                f"{', '.join(hints)}"
            )
    entries: dict[str, Any] = dict(table)
    if kind is Custom:  # whose arguments are a table already
        if isinstance(table.get("arguments"), Mapping):
            entries["arguments"] = _with_new_fields(table["arguments"], f"{where}.arguments")
    else:
        entries = {name: _value(entry, f"{where}.{name}") for name, entry in table.items()}
        entries = {name: checked(f"{where}.{name}", entry, hints[name]) for name, entry in entries.items()}
    required = [field for field in fields(kind) if field.default is MISSING]  # type: ignore[arg-type]
    required = [field for field in required if field.init and field.default_factory is MISSING]
    lacking = [field.name for field in required if field.name not in entries]
    if lacking:
        raise ValueError(f"{where} lacks {', '.join(lacking)}, which {kind.__name__} requires")
    try:
        return kind(**entries)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _with_new_fields(arguments: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Arguments of a `Custom` in which values of cprl have the fields, too, that only this version knows."""
    return {
        name: _config(_value(entry, f"{where}.{name}"), where) if is_value(entry) else entry
        for name, entry in arguments.items()
    }


def is_value(entry: object) -> bool:
    return isinstance(entry, Mapping) and isinstance(entry.get("kind"), str) and entry["kind"] in KINDS


_ABSENT: Final = object()


def differences(before: object, now: object, where: str, kind: Any = None) -> list[str]:
    """Return how two tables differ, a sentence for each place.

    A field that the earlier one lacks, and that has its default in the later one, is no difference: a version
    that did not know the field did what its default says.

    Args:
        kind: the dataclass that they are of, where they do not say it themselves.
    """
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if before.get("live") and now.get("live") and before["live"] != now["live"]:
            was, is_now = (", ".join(live_targets({**table, "arguments": {}})) for table in (before, now))
            return [
                f"{where} was {was}, is {is_now} that was defined again; allowed: the same object, or a "
                "class or function at the top of a module"
            ]
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
    was, is_now = ("not there" if entry is _ABSENT else shown(entry) for entry in (before, now))
    return [] if before == now else [f"{where} was {was}, is {is_now}"]


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
    """Return the defaults of the fields of a dataclass that have one, as a table holds them."""
    defaults = {}
    for field in fields(kind):
        if field.init and field.default is not MISSING:
            defaults[field.name] = field.default
        elif field.init and field.default_factory is not MISSING:
            defaults[field.name] = field.default_factory()
    tables = {  # the arguments of a Custom are a table already
        name: value if isinstance(value, Mapping) else to_config(value) for name, value in defaults.items()
    }
    return {name: without_defaults(table) for name, table in tables.items()}


def without_defaults(table: Any, kind: Any = None) -> Any:
    """Return a table without the fields that have their default, and with 1.0 as 1: what checksums are of."""
    if isinstance(table, list):
        return [without_defaults(entry) for entry in table]
    if isinstance(table, float) and table.is_integer():
        return int(table)
    if not isinstance(table, Mapping):
        return table
    if table.get("kind") == "Custom":
        arguments = table.get("arguments", {})
        shorter = {name: without_defaults(own) if is_value(own) else own for name, own in arguments.items()}
        return {**table, "arguments": shorter}
    kind = KINDS.get(str(table.get("kind"))) if kind is None else kind
    defaults = {} if kind is None else defaults_of(kind)
    entries = {name: without_defaults(entry) for name, entry in table.items()}
    return {name: entry for name, entry in entries.items() if name not in defaults or entry != defaults[name]}
