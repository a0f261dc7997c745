"""Tuples of arrays whose annotations say dtype and shape, once: allocated here, and cut into worlds.

`taken: Annotated[Ints, "B Q N", STEPS]` is int32 with an axis for each word: a letter, whose length whoever
allocates it says, or a number. An axis B is the first one, of worlds; without it an array is a parameter.
`STATE` and `STEPS` mark what is part of the state of a world, `DERIVED` what is computed from the state; what
is not marked holds nothing between turns.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import (
    Annotated,
    Any,
    Final,
    NamedTuple,
    TypeAlias,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

Ints: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]
Floats: TypeAlias = NDArray[np.float32]
Numbers: TypeAlias = NDArray[np.float64]
Longs: TypeAlias = NDArray[np.int64]

STATE: Final = "state"
STEPS: Final = "state, up to Rules.episode_steps"
DERIVED: Final = "derived"

Tuple = TypeVar("Tuple", bound=tuple[Any, ...])
Form = tuple[tuple[int, ...], type[np.generic]]
"""The shape and dtype of an array."""


class Field(NamedTuple):
    """What the annotation of an array says."""

    axes: tuple[str, ...]
    dtype: type[np.generic]
    lasts: str = ""
    """`STATE`, `STEPS`, `DERIVED` or nothing."""

    @property
    def is_of_worlds(self) -> bool:
        return self.axes[:1] == ("B",)


@cache
def _fields(kind: Any) -> Mapping[str, Any]:
    """The `Field` of each array of a tuple; of whatever else it holds the annotation."""
    hints = get_type_hints(kind, include_extras=True)
    for name, hint in hints.items():
        if get_origin(hint) is Annotated:
            array, axes, *lasts = get_args(hint)
            hints[name] = Field(tuple(axes.split()), get_args(get_args(array)[1])[0], *lasts)
    return hints


def forms_of(kind: Any, **sizes: int) -> dict[str, Form]:
    """The shape and dtype of each array of a tuple; `sizes`: the length of each axis by its letter."""
    return {
        name: (tuple(sizes[axis] if axis in sizes else int(axis) for axis in field.axes), field.dtype)
        for name, field in _fields(kind).items()
    }


def filled(kind: type[Tuple], values: Mapping[str, Any], **sizes: int) -> Tuple:
    """Allocate a tuple of arrays, with some values, as arrays, lists or numbers, and else zero.

    Args:
        sizes: see `forms_of`; the axes of values need none.
    """
    fields, entries = _fields(kind), {}
    for name, field in fields.items():
        if not isinstance(field, Field):
            entries[name] = field(values[name])
        elif name in values:
            entries[name] = np.ascontiguousarray(values[name], field.dtype)
            sizes |= dict(zip(field.axes, entries[name].shape, strict=True))
    for name, field in fields.items():
        if name not in entries:
            shape = [sizes[axis] if axis in sizes else int(axis) for axis in field.axes]
            entries[name] = np.zeros(shape, field.dtype)
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


def lasting(arrays: Any, *kinds: str) -> Iterator[tuple[str, Any, str]]:
    """The name of each array of a tuple, and of the tuples in it, that lasts, the array, and what its
    annotation says of that; `kinds`: of these only."""
    kind: Any = type(arrays)
    for name, entry in zip(arrays._fields, arrays, strict=True):
        field = _fields(kind)[name]
        if isinstance(entry, tuple):
            yield from lasting(entry, *kinds)
        elif isinstance(field, Field) and field.lasts in kinds:
            yield name, entry, field.lasts


def slicer(kind: type[Tuple], *, every: bool = False) -> Callable[[Tuple, int], Tuple]:
    """Return a function that takes world b out of a tuple of arrays, sharing their memory; what has no axis
    of worlds stays, unless `every` says that all have one in front of those of their annotations.

    It is written out field by field, so that the rules can call it: Numba compiles no loop over a tuple whose
    entries differ in type.
    """
    names: dict[str, Any] = {"__name__": __name__, "kind": kind}
    entries = ", ".join(
        f"arrays.{name}[b]"
        if every or (isinstance(field, Field) and field.is_of_worlds)
        else f"arrays.{name}"
        for name, field in _fields(kind).items()
    )
    exec(f"def one_{kind.__name__.lower()}(arrays, b):\n    return kind({entries})\n", names)
    function: Callable[[Tuple, int], Tuple] = names[f"one_{kind.__name__.lower()}"]
    return function
