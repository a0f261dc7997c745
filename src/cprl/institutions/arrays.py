"""Tuples of arrays whose annotations say dtype and shape, once: allocated here, and cut into worlds.

`taken: Annotated[Int32, "B Q N", STEPS]` is int32 with an axis for each word: a letter, whose length whoever
allocates it says, or a number. An axis B is the first one, of worlds; without it an array is a parameter.
`Kept` marks what is part of the state of a world, e.g. `STATE` and `STEPS`, and `DERIVED` what is computed
from the state; what is not marked holds nothing between turns.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import (
    Annotated,
    Any,
    Final,
    NamedTuple,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from cprl.values import MOST_INT32


class Kept(NamedTuple):
    """That an array is part of the state of a world, and what is in it."""

    low: int = 0
    """The smallest entry."""
    high: int | str = MOST_INT32
    """The largest entry; a name is that of a number of the game, see `cprl.commons.state.numbers`."""
    cleared: bool = True
    """Whether all entries are 0 when an episode begins."""


STATE: Final = Kept()
STEPS: Final = Kept(high="episode_steps")
DERIVED: Final = "derived"

Tuple = TypeVar("Tuple", bound=tuple[Any, ...])
Form = tuple[tuple[int, ...], type[np.generic]]
"""The shape and dtype of an array."""


class Field(NamedTuple):
    """What the annotation of an array says."""

    axes: tuple[str, ...]
    dtype: type[np.generic]
    lasts: Kept | str = ""
    """How it is kept, `DERIVED`, or nothing."""

    @property
    def is_of_worlds(self) -> bool:
        return self.axes[:1] == ("B",)


@cache
def _fields(kind: Any) -> Mapping[str, Any]:
    """Return the `Field` of each array of a tuple; of whatever else it holds the annotation."""
    hints = get_type_hints(kind, include_extras=True)
    for name, hint in hints.items():
        if get_origin(hint) is Annotated:
            array, axes, *lasts = get_args(hint)
            hints[name] = Field(tuple(axes.split()), get_args(get_args(array)[1])[0], *lasts)
    return hints


def forms_of(kind: Any, **sizes: int) -> dict[str, Form]:
    """Return the shape and dtype of each array of a tuple; `sizes`: the length of each axis by its letter."""
    return {name: (_shape(field, sizes), field.dtype) for name, field in _fields(kind).items()}


def _shape(field: Field, sizes: Mapping[str, int]) -> tuple[int, ...]:
    return tuple(sizes[axis] if axis in sizes else int(axis) for axis in field.axes)


def filled(kind: type[Tuple], values: Mapping[str, Any], **sizes: int) -> Tuple:
    """Allocate a tuple of arrays, with some values, as arrays, lists or numbers, and else zero.

    Args:
        sizes: see `forms_of`; the axes of values need none.
    """
    fields, entries = _fields(kind), {}
    for name, field in fields.items():
        if _tuple_in(field) is not None:
            entries[name] = values[name]
        elif not isinstance(field, Field):
            entries[name] = field(values[name])
        elif name in values:
            entries[name] = np.ascontiguousarray(values[name], field.dtype)
            sizes |= dict(zip(field.axes, entries[name].shape, strict=True))
    for name, field in fields.items():
        if name not in entries:
            entries[name] = np.zeros(_shape(field, sizes), field.dtype)
    made: Tuple = cast(Any, kind)(**{name: entries[name] for name in fields})
    return made


def changed(arrays: Tuple, change: Callable[[Any, bool], Any]) -> Tuple:
    """Return a tuple, with the tuples in it, whose arrays a function of the array and of whether it has an
    axis of worlds gives."""
    entries = []
    for name, entry in zip(arrays._fields, arrays, strict=True):  # type: ignore[attr-defined]
        field = _fields(type(arrays))[name]
        if isinstance(entry, tuple):
            entries.append(changed(entry, change))
        elif hasattr(entry, "dtype"):
            entries.append(change(entry, isinstance(field, Field) and field.is_of_worlds))
        else:
            entries.append(entry)
    made: Tuple = cast(Any, type(arrays))(*entries)
    return made


def lasting(arrays: Any, *, derived: bool = False) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name of each array of a tuple, and of the tuples in it, that is part of the state of a world,
    the array, and its `Kept`; with `derived` also what is computed from the state, with `DERIVED`."""
    kind: Any = type(arrays)
    for name, entry in zip(arrays._fields, arrays, strict=True):
        field = _fields(kind)[name]
        if isinstance(entry, tuple):
            yield from lasting(entry, derived=derived)
        elif isinstance(field, Field) and (isinstance(field.lasts, Kept) or (derived and field.lasts)):
            yield name, entry, field.lasts


def names_kept(kind: Any) -> list[str]:
    """Return the names of the arrays of a kind of tuple that are part of the state of a world."""
    fields = _fields(kind).items()
    return [name for name, field in fields if isinstance(field, Field) and isinstance(field.lasts, Kept)]


class Sliced(NamedTuple):
    """What the function of a `slicer` does with each entry of a kind of tuple: takes world b out of it, True,
    or leaves it, False; or does with each entry of the tuple that it is."""

    parts: tuple[Any, ...]


def slicer(kind: Any, *, every: bool = False) -> Callable[[Any, int], Any]:
    """Return a function that takes world b out of a tuple of arrays, and of the tuples in it, sharing their
    memory; what has no axis of worlds stays, unless `every` says that all have one in front of those of their
    annotations. Of a tuple that may be None it takes None.

    It is written out field by field, so that the rules can call it: Numba compiles no loop over a tuple whose
    entries differ in type.
    """
    names: dict[str, Any] = {"__name__": __name__, "kind": kind}
    entries = []
    parts: list[Any] = []
    for name, field in _fields(kind).items():
        entry = f"arrays.{name}"
        inner = _tuple_in(field)
        if inner is not None:
            one: Any = slicer(inner, every=every)
            names[f"one_{name}"] = one
            entry = f"one_{name}({entry}, b)"
            parts.append(one.sliced)
        elif every or (isinstance(field, Field) and field.is_of_worlds):
            entry += "[b]"
            parts.append(True)
        else:
            parts.append(False)
        entries.append(entry)
    name = f"one_{kind.__name__.lower()}"
    lines = f"def {name}(arrays, b):", "if arrays is None: return None", f"return kind({', '.join(entries)})"
    exec("\n    ".join(lines), names)
    function: Any = names[name]
    function.sliced = Sliced(tuple(parts))
    return cast(Callable[[Any, int], Any], function)


def is_record(kind: Any) -> bool:
    """Return whether something is a kind of named tuple."""
    return isinstance(kind, type) and hasattr(kind, "_fields")


def _tuple_in(field: Any) -> type[Any] | None:
    """Return the kind of tuple that an annotation names, also one that may be None; None for another."""
    return next(filter(is_record, (field, *get_args(field))), None)
