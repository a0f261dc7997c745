"""Named tuples of arrays: allocate them from their annotations, and take single worlds out of them.

The annotation of a field says the dtype, the axes and the role of its array. For example,
`taken: Annotated[Int32, "B Q N", STEPS]` is an int32 array with three axes. An axis is a letter, whose length
is given when the array is allocated, a number, its length, or the name of a field `name: int` of the tuple.

The axis B of worlds comes first; an array without it is a parameter of the game. The role is an `InState`,
such as `IN_STATE` or `STEPS`, for an array that is part of a world's state, and `DERIVED` for an array that
follows from the state. An array without a role holds nothing between two turns.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Final, NamedTuple, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from cprl.values import MOST_INT32
from cprl.values.array_types import is_record


class InState(NamedTuple):
    """The role of an array that is part of the state of a world, with the range of its entries."""

    low: int = 0
    """The smallest entry."""
    high: int | str = MOST_INT32
    """The largest entry: a number, or the name of one that depends on the game, see
    `cprl.commons.state.largest_entries`."""
    cleared: bool = True
    """Whether all entries are 0 when an episode begins."""


IN_STATE: Final = InState()
"""The role of a state array whose entries have no upper limit but that of int32."""
STEPS: Final = InState(high="episode_steps")
"""The role of a state array that counts turns, or something that happens at most once per turn."""
DERIVED: Final = "derived"
"""The role of an array that follows from the state."""

Tuple = TypeVar("Tuple", bound=tuple[Any, ...])
Form = tuple[tuple[int, ...], type[np.generic]]
"""The shape and dtype of an array."""


class Field(NamedTuple):
    """The annotation of an array in a named tuple, taken apart."""

    axes: tuple[str, ...]
    """The letter or name, or the length as text, of each axis."""
    dtype: type[np.generic]
    role: InState | str = ""
    """An `InState`, `DERIVED`, or "" without a role."""

    @property
    def has_worlds(self) -> bool:
        """Return whether the array has the axis B of worlds."""
        return self.axes[:1] == ("B",)


@cache
def _fields(kind: Any) -> Mapping[str, Any]:
    """Return the `Field` of each array in a class of named tuples, and the annotation of other fields."""
    hints = get_type_hints(kind, include_extras=True)
    for name, hint in hints.items():
        if get_origin(hint) is Annotated:
            array, axes, *role = get_args(hint)
            hints[name] = Field(tuple(axes.split()), get_args(get_args(array)[1])[0], *role)
    return hints


def forms_of(kind: Any, **sizes: int) -> dict[str, Form]:
    """Return the shape and dtype of each array of a named tuple, by name.

    Args:
        kind: the class of the named tuple.
        sizes: the length of each axis by its letter.
    """
    return {name: (_shape(field, sizes), field.dtype) for name, field in _fields(kind).items()}


def _shape(field: Field, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Return the shape of an array, from the length of each axis by its letter."""
    return tuple(sizes[axis] if axis in sizes else int(axis) for axis in field.axes)


def filled(kind: type[Tuple], values: Mapping[str, Any], **sizes: int) -> Tuple:
    """Make a named tuple of arrays from the given values; arrays without a value are zero.

    Args:
        kind: the class of the named tuple.
        values: arrays, lists or numbers by name. Fields that are no arrays, e.g. tuples, need a value.
        sizes: the length of each axis by its letter. Axes whose lengths follow from `values` need none.
    """
    fields = _fields(kind)
    entries = {}
    for name, field in fields.items():
        if _tuple_in(field) is not None:
            entries[name] = values[name]
        elif not isinstance(field, Field):
            entries[name] = field(values[name])
            if field is int:
                sizes[name] = entries[name]
        elif name in values:
            entries[name] = np.ascontiguousarray(values[name], field.dtype)
            sizes |= dict(zip(field.axes, entries[name].shape, strict=True))
    for name, field in fields.items():
        if name not in entries:
            entries[name] = np.zeros(_shape(field, sizes), field.dtype)
    arrays: Tuple = cast(Any, kind)(**entries)
    return arrays


def map_arrays(arrays: Tuple, change: Callable[[Any, bool], Any]) -> Tuple:
    """Return a copy of a named tuple, and of the tuples in it, in which each array is replaced.

    Args:
        arrays: the named tuple.
        change: called as `change(array, has_worlds)`, where `has_worlds` says whether the array has the axis
            of worlds; returns the new array.
    """
    entries = []
    for name, entry in zip(arrays._fields, arrays, strict=True):  # type: ignore[attr-defined]
        field = _fields(type(arrays))[name]
        if isinstance(entry, tuple):
            entries.append(map_arrays(entry, change))
        elif hasattr(entry, "dtype"):
            entries.append(change(entry, isinstance(field, Field) and field.has_worlds))
        else:
            entries.append(entry)
    result: Tuple = cast(Any, type(arrays))(*entries)
    return result


def state_arrays(arrays: Any, *, derived: bool = False) -> Iterator[tuple[str, Any, Any]]:
    """Yield (name, array, role) for each array of the state in a named tuple, and in the tuples in it.

    The role is an `InState`. With `derived`, also yield the arrays whose role is `DERIVED`.
    """
    kind: Any = type(arrays)
    for name, entry in zip(arrays._fields, arrays, strict=True):
        field = _fields(kind)[name]
        if isinstance(entry, tuple):
            yield from state_arrays(entry, derived=derived)
        elif isinstance(field, Field) and (isinstance(field.role, InState) or (derived and field.role)):
            yield name, entry, field.role


def slicer(kind: Any, *, all_sliced: bool = False) -> Callable[[Any, int], Any]:
    """Make a function that takes one world out of a named tuple of arrays, and out of the tuples in it.

    The function is called as `one_law(arrays, b)`, b the index of the world, and its result shares the memory
    of the arrays. Entries without the axis of worlds stay as they are. For None it returns None. Its
    attribute `sliced` says what it does with each entry, see `cprl.system.jit.records.by_reference`.

    Args:
        kind: the class of the named tuple.
        all_sliced: whether all arrays have the axis of worlds, in front of the axes of their annotations.
    """
    # The function is written out as source, field by field, so that rules can call it: Numba compiles no loop
    # over a tuple whose entries differ in type.
    names: dict[str, Any] = {"__name__": __name__, "kind": kind}
    entries = []
    sliced_entries: list[Any] = []
    for name, field in _fields(kind).items():
        entry = f"arrays.{name}"
        inner_kind = _tuple_in(field)
        if inner_kind is not None:
            inner_function: Any = slicer(inner_kind, all_sliced=all_sliced)
            names[f"one_{name}"] = inner_function
            entry = f"one_{name}({entry}, b)"
            sliced_entries.append(inner_function.sliced)
        elif all_sliced or (isinstance(field, Field) and field.has_worlds):
            entry += "[b]"
            sliced_entries.append(True)
        else:
            sliced_entries.append(False)
        entries.append(entry)
    function_name = f"one_{kind.__name__.lower()}"
    lines = (
        f"def {function_name}(arrays, b):",
        "if arrays is None: return None",
        f"return kind({', '.join(entries)})",
    )
    exec("\n    ".join(lines), names)
    function: Any = names[function_name]
    function.sliced = tuple(sliced_entries)
    return cast(Callable[[Any, int], Any], function)


def _tuple_in(field: Any) -> type[Any] | None:
    """Return the class of named tuples in an annotation, e.g. `RiverArrays | None`; None without one."""
    return next(filter(is_record, (field, *get_args(field))), None)
