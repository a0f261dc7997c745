"""Tuples of arrays whose annotations say dtype and shape, once: allocated here, and cut into worlds.

`taken: Annotated[Ints, "B Q N"]` is int32 with an axis for each word: a letter, whose length whoever
allocates it says, or a number. Where there is an axis B, it is the first one, of worlds.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_type_hints

import numpy as np

Tuple = TypeVar("Tuple", bound=tuple[Any, ...])
Form = tuple[tuple[int, ...], type[np.generic]]
"""The shape and dtype of an array."""


@cache
def _annotations(kind: Any) -> Mapping[str, tuple[tuple[str, ...], type[np.generic]]]:
    """The axes and dtype of each array of a tuple."""
    hints = {name: get_args(hint) for name, hint in get_type_hints(kind, include_extras=True).items()}
    return {
        name: (tuple(axes.split()), get_args(get_args(array)[1])[0]) for name, (array, axes) in hints.items()
    }


def forms_of(kind: Any, **sizes: int) -> dict[str, Form]:
    """The shape and dtype of each array of a tuple; `sizes`: the length of each axis by its letter."""
    return {
        name: (tuple(sizes[axis] if axis in sizes else int(axis) for axis in axes), dtype)
        for name, (axes, dtype) in _annotations(kind).items()
    }


def zeros(kind: type[Tuple], **sizes: int) -> Tuple:
    """Allocate a tuple of arrays, all zero; `sizes`: see `forms_of`."""
    arrays = [np.zeros(shape, dtype) for shape, dtype in forms_of(kind, **sizes).values()]
    made: Tuple = cast(Any, kind)(*arrays)
    return made


def slicer(kind: type[Tuple]) -> Callable[[Tuple, int], Tuple]:
    """Return a function that takes world b out of a tuple of arrays [B, ...], sharing their memory.

    It is written out field by field, so that the rules can call it: Numba compiles no loop over a tuple whose
    arrays differ in type.
    """
    names: dict[str, Any] = {"__name__": __name__, "kind": kind}
    entries = ", ".join(f"arrays.{name}[b]" for name in _annotations(kind))
    exec(f"def one_{kind.__name__.lower()}(arrays, b):\n    return kind({entries})\n", names)
    function: Callable[[Tuple, int], Tuple] = names[f"one_{kind.__name__.lower()}"]
    return function
