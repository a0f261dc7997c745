"""Values: frozen dataclasses whose annotations say what each field allows, and the tables that keep them.

    gamma: Annotated[float, Range(0, 1)] = 0.995

The annotation is the only place that states a field's range. Constructors, recipes, command lines, studies
and tests all use it. `Value` checks fields and stores them as plain Python: lists and arrays as tuples,
numpy's numbers as Python's, whole numbers of a float field as floats. A refusal is a ValueError of one form:
"DQNSettings.gamma is 7; allowed: a number in 0..1".

A table is what JSON can hold of a value, `{"kind": "DQN", ...its fields}`; a tuple is a list there. Reading a
table is strict: unknown entries are refused, and the message names their place. `cprl.values.custom` has
Custom, user code by its name, `cprl.values.array_types` the types of numpy arrays.
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
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from cprl.values.custom import (
    METRIC_WORDS as METRIC_WORDS,
    Custom as Custom,
    custom_of as custom_of,
    custom_targets as custom_targets,
    describe_customs as describe_customs,
    instantiate as instantiate,
    live_targets as live_targets,
    metric_words as metric_words,
    refuse_live as refuse_live,
    refuse_other_keys as refuse_other_keys,
    refuse_targets,
    short_repr as short_repr,
    source_of as source_of,
    trust as trust,
    trusted as trusted,
    trusting as trusting,
)

T = TypeVar("T")

MOST_INT32: Final = 2**31 - 1
MOST_INT64: Final = 2**63 - 1
MOST_NUMBER: Final = 1e30
"""The default upper bound of numbers; products of such numbers still fit into float32."""

KINDS: Final[dict[str, type[Any]]] = {"Custom": Custom}
"""The classes whose values a table can hold, by their "kind" in the table; subclasses of `Value` register
themselves."""

_MOST_ENTRIES: Final = 2**22


class Range(NamedTuple):
    """Numbers from `low` to `high`, both included."""

    low: float
    high: float

    def __call__(self, value: Any) -> bool:
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        return f"in {_format_bound(self.low)}..{_format_bound(self.high)}"


class Where(NamedTuple):
    """A check of a value by a function, with words for what it allows."""

    accepts: Callable[[Any], bool]
    allowed: str

    def __call__(self, value: Any) -> bool:
        return self.accepts(value)

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
"""A text that can be part of a directory's name on any system."""
AgentIndices = Annotated[
    tuple[Natural, ...],
    Where(
        lambda agents: len(agents) > 0 and list(agents) == sorted(set(agents)),
        "ascending agent indices, at least one",
    ),
]


class Value:
    """The base of frozen dataclasses whose fields are checked by their annotations when they are made.

    A subclass may be given, as arguments of the class, `stored`: whether a table can hold its values, for
    classes of cprl only; and `called`: its name in messages, by default that of the class.

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
            field_name = f"{self._called}.{name}"
            object.__setattr__(self, name, checked(field_name, getattr(self, name), hint))

    def to_config(self) -> dict[str, Any]:
        """Return the fields as JSON can hold them, see `cprl.values.to_config`."""
        names = hints_of(type(self))
        return {name: to_config(getattr(self, name), f"{self._called}.{name}") for name in names}


_HINTS_BY_CLASS: Final[dict[Any, dict[str, Any]]] = {}


def hints_of(kind: Any) -> dict[str, Any]:
    """Return the annotation of each field that the constructor of a dataclass takes, in order."""
    if kind not in _HINTS_BY_CLASS:
        hints = get_type_hints(kind, include_extras=True)
        _HINTS_BY_CLASS[kind] = {field.name: hints[field.name] for field in fields(kind) if field.init}
    return _HINTS_BY_CLASS[kind]


class _TypeMismatchError(Exception):
    """A value does not match a type."""


def checked(name: str, value: Any, hint: Any) -> Any:
    """Return a value that matches an annotated type, as plain Python.

    Raises:
        ValueError: for any other value; the message names it and says what is allowed.
    """
    try:
        return _convert(value, hint)
    except _TypeMismatchError:
        raise _type_error(name, value, hint) from None


def _type_error(name: str, value: Any, hint: Any) -> ValueError:
    """Return the error for a value that does not match an annotated type; for a tuple of objects it names the
    entry."""
    inner = get_args(hint)
    if get_origin(hint) is tuple and inner[-1:] == (Ellipsis,) and isinstance(value, list | tuple):
        options = get_args(inner[0]) or inner[:1]
        if any(isinstance(option, type) and option not in _PLAIN_TYPES for option in options):
            for index, entry in enumerate(value):
                if not matches_type(entry, inner[0]):
                    return _type_error(f"{name}[{index}]", entry, inner[0])
    is_object = not isinstance(value, (*_SIMPLE_TYPES, Value, Custom))
    if is_object and Custom in (*get_args(hint), hint):
        return ValueError(_not_stored(value, name))
    return refusal(name, value, describe_type(hint))


_SIMPLE_TYPES: Final = (str, bytes, int, float, complex, tuple, list, dict, set, range, NoneType, type)


def matches_type(value: Any, hint: Any) -> bool:
    """Return whether a value matches an annotated type; an integer is a float too, and True is no number."""
    try:
        _convert(value, hint)
    except _TypeMismatchError:
        return False
    return True


def _convert(value: Any, hint: Any) -> Any:
    """Return a value that matches an annotated type, as plain Python; raise `_TypeMismatchError` for
    others."""
    if hint is Any:
        return value
    if hint is int:
        return _to_int(_to_plain(value))
    if hint is float:
        return _to_float(_to_plain(value))
    origin = get_origin(hint)
    inner = get_args(hint)
    if origin is Annotated:
        return _to_annotated(value, *inner)
    if origin in (Union, UnionType):
        return _to_first_match(value, inner)
    if origin is tuple:
        return _to_tuple(_to_plain(value), inner)
    if origin is Literal:
        return _to_literal(_to_plain(value), inner)
    if hint in _PLAIN_TYPES:
        value = _to_plain(value)
    if hint is Custom:
        value = as_custom(value)
    if isinstance(value, type) or not isinstance(value, origin or hint):
        raise _TypeMismatchError
    return value


def as_custom(value: Any) -> Any:
    """Return a class or function of the user, or a `functools.partial` of one, as a `Custom`, see
    `custom_of`; return anything else, such as a class of cprl's values, unchanged."""
    target = value.func if isinstance(value, partial) else value
    return value if KINDS.get(getattr(target, "__name__", "")) is target else custom_of(value)


_PLAIN_TYPES: Final = frozenset({int, float, bool, str, NoneType})


def _to_annotated(value: Any, hint: Any, *checks: Any) -> Any:
    """Return a value that matches a type and passes the checks of its annotation."""
    value = _convert(value, hint)
    if not all(check(value) for check in checks if isinstance(check, Range | Where)):
        raise _TypeMismatchError
    return value


def _to_first_match(value: Any, options: tuple[Any, ...]) -> Any:
    """Return a value as the first type of a union that it matches."""
    for option in options:
        try:
            return _convert(value, option)
        except _TypeMismatchError:
            pass
    raise _TypeMismatchError


def _to_literal(value: Any, options: tuple[Any, ...]) -> Any:
    """Return a value that equals one of the options, and has its type: True is not 1."""
    if any(value == option and type(value) is type(option) for option in options):
        return value
    raise _TypeMismatchError


def _to_tuple(value: Any, inner: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a sequence as a tuple whose entries match the types of a tuple's annotation."""
    if not isinstance(value, list | tuple | range) or value[_MOST_ENTRIES:]:
        raise _TypeMismatchError
    if inner[-1:] == (Ellipsis,):
        return tuple(_convert(entry, inner[0]) for entry in value)
    if len(value) != len(inner):
        raise _TypeMismatchError
    return tuple(_convert(entry, hint) for entry, hint in zip(value, inner, strict=True))


def _to_plain(value: Any) -> Any:
    """Return an array as a list, a scalar of numpy or torch as Python's; return anything else unchanged."""
    if type(value) in _PLAIN_TYPES:
        return value
    if isinstance(value, str):
        return str.__str__(value)  # turns a subclass of str into str
    if not isinstance(value, type) and callable(getattr(value, "tolist", None)):
        try:
            return value.tolist()
        except Exception:  # a tensor without values, sparse or on "meta"
            raise _TypeMismatchError from None
    return value


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number, which True is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _to_int(value: Any) -> int:
    """Return an integer, which True is not."""
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value)
    raise _TypeMismatchError


def _to_float(value: Any) -> float:
    """Return a finite number as a float."""
    try:
        number = float(value) if is_number(value) else None
    except OverflowError:
        number = None
    if number is None or not isfinite(number):
        raise _TypeMismatchError
    return number


def describe_type(hint: Any) -> str:
    """Return an annotated type in words, for messages."""
    origin = get_origin(hint)
    inner = get_args(hint)
    if origin is Annotated:
        checks = [check for check in inner[1:] if isinstance(check, Range | Where)]
        in_words = [check for check in checks if isinstance(check, Where)]
        return str(in_words[0]) if in_words else " ".join([describe_type(inner[0]), *map(str, checks)])
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(map(describe_type, inner)))
    if origin is Literal:
        return ", ".join(map(repr, inner))
    if origin is tuple:
        return f"({', '.join('...' if entry is Ellipsis else describe_type(entry) for entry in inner)})"
    return _TYPE_WORDS.get(hint) or f"a {getattr(hint, '__name__', hint)}"


_TYPE_WORDS: Final = {
    int: "an integer",
    float: "a number",
    bool: "True or False",
    str: "a text",
    NoneType: "None",
    Custom: 'a Custom("module:Class", arguments={...})',
}


def _format_bound(bound: float) -> str:
    """Return a bound as text; a large power of 2 as "2**31 - 1"."""
    if isinstance(bound, int):
        bits = (bound + 1).bit_length() - 1
        return f"2**{bits} - 1" if bits > 20 and bound + 1 == 2**bits else str(bound)
    return f"{bound:g}"


def refusal(name: str, value: object, allowed: str) -> ValueError:
    """Return the error for a value that is not allowed; the message says what is allowed."""
    return ValueError(f"{name} is {short_repr(value)}; allowed: {allowed}")


def did_you_mean(name: object, known: Iterable[str]) -> str:
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
        ValueError: for anything else than values of `KINDS` and of JSON; the message says where it stands and
            what to write instead.
    """
    with _not_too_deep(where):
        return _to_table(value, where)


def _to_table(value: object, where: str) -> Any:
    kind = type(value)
    if kind in _PLAIN_TYPES and kind is not float:
        return value
    if isinstance(value, float):
        if isfinite(value):
            return float(value)
        raise ValueError(f"{where} is {value}; allowed: a finite number")
    if isinstance(value, Custom):
        table = {"kind": "Custom", "target": value.target, "arguments": dict(value.arguments)}
        return {**table, "live": value.live} if value.live else table
    is_stored = is_dataclass(value) and KINDS.get(kind.__name__) is kind
    if is_stored or (isinstance(value, Value) and not kind.__module__.startswith("cprl.")):
        entries = {name: _to_table(getattr(value, name), f"{where}.{name}") for name in hints_of(kind)}
        if is_stored:
            return {"kind": kind.__name__, **entries}
        return _to_table(replace(custom_of(kind), arguments=entries), where)
    if isinstance(value, tuple | list):
        return [_to_table(entry, f"{where}[{index}]") for index, entry in enumerate(value)]
    for plain in (int, str):
        if isinstance(value, plain):
            return plain(value)
    raise ValueError(_not_stored(value, where))


def _not_stored(value: object, where: str) -> str:
    kind = type(value)
    what = f"a {kind.__name__}"
    allowed = "a class or function of your own itself, or a functools.partial of it with keyword arguments"
    if isinstance(value, type | FunctionType):
        what = "a class" if isinstance(value, type) else "a function"
        allowed = 'Custom("module:name", arguments={...}) of a class or function at the top of a module'
    elif isinstance(value, partial) and as_custom(value) is value and not value.args:
        name = getattr(value.func, "__name__", "name")
        return f"{where} is a partial, which a recipe cannot hold; allowed: {name}(...)"
    elif isinstance(value, partial):
        allowed = "a functools.partial of a class or function of your own with keyword arguments alone"
    elif kind.__module__ not in ("builtins", "__main__") and "<" not in kind.__qualname__:
        allowed = f'{allowed}, e.g. Custom("{kind.__module__}:{kind.__qualname__}", arguments={{...}})'
    return f"{where} is {what}, which a recipe cannot hold; allowed: values of cprl, or {allowed}"


def from_config(table: object, where: str = "value") -> Any:
    """Return the value that `to_config` gave; lists become tuples. Nothing is imported.

    Raises:
        ValueError: for anything unknown, by its place; for user code that this process does not trust, see
            `cprl.trust`.
    """
    with _not_too_deep(where):
        refuse_targets(table)
        return _from_table(table, where)


def build(kind: type[T], table: object, where: str) -> T:
    """Return a dataclass from the table of its fields, read like `from_config`; missing fields take
    defaults."""
    with _not_too_deep(where):
        refuse_targets(table)
        return _from_fields(kind, table, where)


def _from_table(table: object, where: str) -> Any:
    if isinstance(table, float) and not isfinite(table):
        raise ValueError(f"{where} is {table}; allowed: a finite number")
    if table is None or isinstance(table, bool | int | float | str):
        return table
    if isinstance(table, list | tuple):
        return tuple(_from_table(entry, f"{where}[{index}]") for index, entry in enumerate(table))
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} is a {type(table).__name__}, which JSON does not have")
    name = table.get("kind")
    if not isinstance(name, str) or name not in KINDS:
        problem = f".kind is {short_repr(name)}{did_you_mean(name, KINDS)}"
        if "kind" not in table:
            problem = ' is a table without "kind"'
        raise ValueError(f"{where}{problem}; allowed: {', '.join(sorted(KINDS))}")
    return _from_fields(KINDS[name], {key: entry for key, entry in table.items() if key != "kind"}, where)


def _from_fields(kind: type[T], table: object, where: str) -> T:
    if not isinstance(table, Mapping):
        raise ValueError(f"{where} is {short_repr(table)}; allowed: a table of the fields of {kind.__name__}")
    hints = hints_of(kind)
    for name in table:
        if name not in hints:
            raise ValueError(
                f"{where}.{name} is no field of {kind.__name__}{did_you_mean(name, hints)}; it has "
                f"{', '.join(hints)}"
            )
    entries: dict[str, Any] = dict(table)
    if kind is Custom:  # its arguments are a table already
        if isinstance(table.get("arguments"), Mapping):
            entries["arguments"] = _with_new_fields(table["arguments"], f"{where}.arguments")
    else:
        entries = {name: _from_table(entry, f"{where}.{name}") for name, entry in table.items()}
        entries = {name: checked(f"{where}.{name}", entry, hints[name]) for name, entry in entries.items()}
    known = {**_default_values(kind), **entries}
    lacking = [name for name in hints if name not in known]
    if lacking:
        raise ValueError(f"{where} lacks {', '.join(lacking)}, which {kind.__name__} requires")
    try:
        return kind(**entries)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _with_new_fields(arguments: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the arguments of a `Custom`; values of cprl among them get the fields that an earlier version
    lacked."""
    return {
        name: _to_table(_from_table(entry, f"{where}.{name}"), where) if is_value(entry) else entry
        for name, entry in arguments.items()
    }


def is_value(entry: object) -> bool:
    return isinstance(entry, Mapping) and isinstance(entry.get("kind"), str) and entry["kind"] in KINDS


_ABSENT: Final = object()


def describe_changes(before: object, now: object, where: str, kind: Any = None) -> list[str]:
    """Return the differences between two tables, a sentence for each place.

    A field that the earlier table lacks and the later one has at its default is no difference: the version
    that lacked the field did what the default says.

    Args:
        kind: the dataclass that the tables describe, if they have no "kind".
    """
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if before.get("live") and now.get("live") and before["live"] != now["live"]:
            was, is_now = (", ".join(live_targets({**table, "arguments": {}})) for table in (before, now))
            return [
                f"{where} was {was}, is {is_now} that was defined again; allowed: the same object, or a "
                "class or function at the top of a module"
            ]
        if before.get("kind") == now.get("kind"):
            lines = []
            for name in {**before, **now}:
                if not _is_new_default(name, before, now, kind):
                    entry = before.get(name, _ABSENT)
                    lines += describe_changes(entry, now.get(name, _ABSENT), f"{where}.{name}")
            return lines
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        lines = []
        for index, entry in enumerate(before):
            lines += describe_changes(entry, now[index], f"{where}[{index}]")
        return lines
    was, is_now = ("not there" if entry is _ABSENT else short_repr(entry) for entry in (before, now))
    return [] if before == now else [f"{where} was {was}, is {is_now}"]


def _is_new_default(name: str, before: Mapping[str, Any], now: Mapping[str, Any], kind: Any = None) -> bool:
    """Return whether a field is new in the later table and still at its default."""
    if before.get(name) is None and now.get(name) is None:
        return True
    kind = KINDS.get(str(now.get("kind"))) if kind is None else kind
    if name in before or kind is None:
        return False
    defaults = defaults_of(kind)
    return name in defaults and without_defaults(now[name]) == defaults[name]


def _default_values(kind: Any) -> dict[str, Any]:
    defaults = {}
    for field in fields(kind):
        if field.init and field.default is not MISSING:
            defaults[field.name] = field.default
        elif field.init and field.default_factory is not MISSING:
            defaults[field.name] = field.default_factory()
    return defaults


def defaults_of(kind: Any) -> dict[str, Any]:
    """Return the default of each field of a dataclass that has one, as a table holds it."""
    defaults = {}
    for name, value in _default_values(kind).items():
        # The arguments of a Custom are a table already.
        table = value if isinstance(value, Mapping) else to_config(value)
        defaults[name] = without_defaults(table)
    return defaults


def without_defaults(table: Any, kind: Any = None) -> Any:
    """Return a table without the fields at their default, and with 1.0 as 1, for checksums."""
    if isinstance(table, list):
        return [without_defaults(entry) for entry in table]
    if isinstance(table, float) and table.is_integer():
        return int(table)
    if not isinstance(table, Mapping):
        return table
    if table.get("kind") == "Custom":
        arguments = table.get("arguments", {})
        values = {name: without_defaults(entry) for name, entry in arguments.items() if is_value(entry)}
        return {**table, "arguments": {**arguments, **values}}
    kind = KINDS.get(str(table.get("kind"))) if kind is None else kind
    defaults = {} if kind is None else defaults_of(kind)
    entries = {name: without_defaults(entry) for name, entry in table.items()}
    return {name: entry for name, entry in entries.items() if name not in defaults or entry != defaults[name]}
