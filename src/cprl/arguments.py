"""Checks of single arguments, with the messages of `cprl.checks`: "x is ...; allowed: ...".

Each raises a ValueError for what does not fit; none rounds.
"""

from collections.abc import Iterable, Mapping, Sequence
from operator import index
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.checks import is_number, plain, shown

HIGHEST_SEED: Final = 2**64 - 1


def refusal(name: str, value: object, allowed: str) -> ValueError:
    """The error for a value that is not allowed."""
    return ValueError(f"{name} is {shown(value)}; allowed: {allowed}")


def as_integer(value: Any) -> int | None:
    """An integer of Python, numpy or torch as an int; None for anything else, bools and floats included."""
    if type(value) is int:
        return value
    if isinstance(value, bool | type) or "bool" in str(getattr(value, "dtype", "")):
        return None
    if len(getattr(value, "shape", ())) > 0:
        return None
    try:
        return index(value)
    except TypeError:
        return None


def integer(name: str, value: Any, low: int, high: int | None = None, *, allowed: str = "") -> int:
    """An integer from `low` to `high`, both included; no number is rounded."""
    found = as_integer(value)
    if found is None or found < low or (high is not None and found > high):
        limits = f"an integer >= {low}" if high is None else f"an integer from {low} to {high:,}"
        raise refusal(name, value, allowed or limits)
    return found


def seed(value: Any, name: str = "seed") -> int:
    """A seed, 0 to 2**64 - 1; raises a ValueError for anything else."""
    return integer(name, value, 0, HIGHEST_SEED, allowed="an integer from 0 to 2**64 - 1")


def number(name: str, value: Any, *, low: float, high: float, above: bool = False, allowed: str) -> float:
    """A finite number from `low` to `high`; `above`: without `low` itself."""
    found = plain(value)
    if not is_number(found, low, high) or (above and found <= low):
        raise refusal(name, value, allowed)
    return float(found)


def choice(name: str, value: Any, allowed: Iterable[str]) -> None:
    """Raises a ValueError unless a value is one of these words."""
    names = tuple(allowed)
    if not isinstance(value, str) or value not in names:
        raise refusal(name, value, ", ".join(names))


def object_of(name: str, value: Any, kind: Any, allowed: str) -> None:
    """Raises a ValueError unless a value is an instance of a class, or of one of several."""
    if not isinstance(value, kind):
        raise refusal(name, value, allowed)


def listed(name: str, value: Any, allowed: str) -> tuple[Any, ...]:
    """The items of a sequence, set, array or iterator as a tuple; text is none."""
    if isinstance(value, str | bytes):
        raise refusal(name, value, allowed)
    try:
        return tuple(value)
    except TypeError:
        raise refusal(name, value, allowed) from None


def array(name: str, value: Any, shape: Sequence[int], dtype: Any) -> None:
    """Raises a ValueError unless a value is an array of this shape and dtype, on the CPU or a GPU."""
    found = getattr(value, "shape", None), getattr(value, "dtype", None)
    if found[0] != tuple(shape) or found[1] != dtype:
        kind = shown(value) if found[0] is None or found[1] is None else f"{found[1]} {list(found[0])}"
        raise ValueError(f"{name} is {kind}; allowed: {np.dtype(dtype)} {list(shape)}")


def floats(name: str, values: Any) -> NDArray[np.float64]:
    """Numbers as a float64 array; text, which numpy reads as numbers, is refused."""
    try:
        found = np.asarray(values)
        if found.dtype.kind in "biuf":
            return found.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        pass
    raise refusal(name, values, "an array of numbers")


def objects(name: str, value: Any, kind: Any, allowed: str) -> tuple[Any, ...]:
    """The objects of a list or tuple, each an instance of a class; raises a ValueError for anything else."""
    if isinstance(value, Mapping):
        raise refusal(name, value, f"a list of {allowed}")
    found = listed(name, value, f"a list of {allowed}")
    for place, own in enumerate(found):
        object_of(f"{name}[{place}]", own, kind, allowed)
    return found
