"""Checks of what users hand in, with one form of message: "X is <what came>; allowed: <what fits>".

A class of values keeps a table of checks by field and calls `check_fields`; a function calls `checked` for an
argument. Whatever does not fit is a ValueError. A TypeError is left for a call that Python itself refuses,
e.g. with an unknown keyword.
"""

import reprlib
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Final, NamedTuple

MOST_INT32: Final = 2**31 - 1
MOST_INT64: Final = 2**63 - 1
MOST_SEED: Final = 2**64 - 1
MOST_NUMBER: Final = 1e30
"""The largest number that is allowed where nothing else bounds it; its products still fit into float32."""

MOST_NESTED: Final = 64
"""Tables and lists within each other that a recipe may hold."""

_MOST_NESTED_VALUE: Final = 3
_MOST_ENTRIES: Final = 2**22


class _Repr(reprlib.Repr):
    """Short, and without what objects say of themselves: by their class."""

    def repr_instance(self, x: Any, level: int) -> str:
        if isinstance(x, type):
            return f"the class {x.__name__}"
        plain_kinds = type(None), bool, float, complex, bytes, range
        return super().repr_instance(x, level) if type(x) in plain_kinds else f"a {type(x).__name__}"


_REPR: Final = _Repr()
_REPR.maxlevel, _REPR.maxtuple, _REPR.maxlist, _REPR.maxstring, _REPR.maxother = 4, 20, 20, 120, 120


class Check(NamedTuple):
    """What is allowed, as a function of a value that `plain` gave, and in words."""

    fits: Callable[[Any], bool]
    allowed: str


def checked(name: str, value: Any, check: Check) -> Any:
    """A value as `plain` gives it, if it fits."""
    value = plain(value)
    if not check.fits(value):
        raise ValueError(f"{name} is {shown(value)}; allowed: {check.allowed}")
    return value


def check_arguments(checks: Mapping[str, Check], **arguments: Any) -> None:
    """Checks arguments of a function by name."""
    for name, value in arguments.items():
        checked(name, value, checks[name])


def check_fields(value: Any, checks: Mapping[str, Check], where: str = "") -> None:
    """Checks the fields of a frozen dataclass, and stores each as `plain` gives it.

    Args:
        checks: by field. A field without one, of a subclass of the user's own, is left as it is.
        where: what the dataclass is called in messages; by default its class.
    """
    where = where or type(value).__name__
    for field in fields(value):
        name = field.name
        if name in checks:
            object.__setattr__(value, name, checked(f"{where}.{name}", getattr(value, name), checks[name]))


def plain(value: Any, nested: int = 0) -> Any:
    """Lists, ranges and arrays as nested tuples, numpy scalars as Python's numbers, else the value as it is;
    what is nested deeper than any value of ours stays, so that no check lets it pass."""
    if isinstance(value, str):
        return str.__str__(value)  # a recipe holds no text of another class
    if not isinstance(value, type) and callable(getattr(value, "tolist", None)):
        try:
            value = value.tolist()
        except Exception:  # a tensor without values, sparse or on "meta"
            return value
    if not isinstance(value, list | tuple | range) or nested > _MOST_NESTED_VALUE or value[_MOST_ENTRIES:]:
        return value
    return tuple(plain(entry, nested + 1) for entry in value)


def shown(value: object) -> str:
    """A value as a message shows it, on one line and not at its full length; an object by its class."""
    try:
        return " ".join(_REPR.repr(value).split())
    except Exception:  # a user's object may raise anything, and an integer may have too many digits
        return f"a {type(value).__name__} that cannot be shown"


def check_nesting(value: object, where: str) -> None:
    """Refuses tables and lists that are nested too deeply, or hold too much, to be read one in the other."""
    level, entries = {id(value): (value, 1)}, 0  # each once, with how often it stands at this depth
    for _ in range(MOST_NESTED):
        inner: dict[int, tuple[object, int]] = {}
        for own, times in level.values():
            if isinstance(own, Mapping | list | tuple):
                held = list(own.values() if isinstance(own, Mapping) else own)
                entries += times * len(held)
                for entry in held:
                    inner[id(entry)] = entry, times + inner.get(id(entry), (None, 0))[1]
        if entries > _MOST_ENTRIES:
            raise ValueError(f"{where} has more than {_MOST_ENTRIES:,} entries; allowed: fewer")
        if not inner:
            return
        level = inner
    raise ValueError(f"{where} is nested more than {MOST_NESTED} deep; allowed: up to {MOST_NESTED}")


def is_count(value: Any, low: int, high: int = MOST_INT32) -> bool:
    """Whether a value is an integer in low..high; True and False are not."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def is_number(value: Any, low: float, high: float) -> bool:
    """Whether a value is a number in low..high, both finite; True and False are not, nor is NaN."""
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


def is_bool(value: Any) -> bool:
    """Whether a value is True or False."""
    return isinstance(value, bool)


def is_table(value: Any, is_allowed: Callable[[Any], bool]) -> bool:
    """Whether a value is a tuple of equally long, non-empty tuples whose entries are all allowed."""
    if not isinstance(value, tuple) or not value or not all(isinstance(row, tuple) for row in value):
        return False
    return len({len(row) for row in value}) == 1 and all(row and all(map(is_allowed, row)) for row in value)


def _is_directory_name(value: Any) -> bool:
    """Whether a text can be a part of a directory's name, wherever the run is copied to."""
    if not isinstance(value, str) or not value or not value.isprintable() or set(value) & set("/\\"):
        return False
    return len(value.encode()) <= _MOST_NAME and value == value.strip(" ").rstrip(".")


_MOST_NAME: Final = 200
DIRECTORY_NAME: Final = Check(
    _is_directory_name,
    f"the name of a directory, up to {_MOST_NAME} bytes of printable text, without slashes",
)
SWITCH: Final = Check(is_bool, "True or False")


def count(low: int, high: int = MOST_INT32) -> Check:
    """An integer in low..high."""
    return Check(lambda value: is_count(value, low, high), f"an integer in {low}..{power(high)}")


def number(low: float, high: float) -> Check:
    """A number in low..high."""
    return Check(lambda value: is_number(value, low, high), f"a number in {low:g}..{high:g}")


def one_of(*names: str) -> Check:
    """One of these texts."""
    return Check(lambda value: isinstance(value, str) and value in names, ", ".join(map(repr, names)))


def instance(kind: Any, allowed: str) -> Check:
    """An instance of a class, or of one of several; no class, although one has what a protocol asks for."""
    return Check(lambda value: isinstance(value, kind) and not isinstance(value, type), allowed)


def tuple_of(check: Check, at_least: int = 0) -> Check:
    """A tuple or list of what another check allows."""
    some = f"{at_least} or more entries" if at_least else "entries"
    return Check(
        lambda value: isinstance(value, tuple) and len(value) >= at_least and all(map(check.fits, value)),
        f"a tuple of {some}, each {check.allowed}",
    )


def either(*checks: Check) -> Check:
    """What any of these checks allows."""
    return Check(lambda value: any(c.fits(value) for c in checks), " or ".join(c.allowed for c in checks))


TEXT: Final = Check(lambda value: isinstance(value, str), "a text")


NONE: Final = Check(lambda value: value is None, "None")


def power(most: int) -> str:
    """A bound as people write it: 2**31 - 1 rather than its digits."""
    bits = (most + 1).bit_length() - 1
    return f"2**{bits} - 1" if bits > 20 and most + 1 == 2**bits else str(most)
