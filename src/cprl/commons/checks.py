"""Checks of arguments, with messages of one form: "x is ...; allowed: ..."."""

from collections.abc import Iterable, Sequence
from math import isfinite
from numbers import Real
from operator import index
from typing import Any, Final

import numpy as np
import psutil
from numpy.typing import NDArray

HIGHEST_SEED: Final = 2**64 - 1
_LONGEST: Final = 120
"""The largest number of characters of a value in a message."""


def shown(value: object) -> str:
    """A value as text for a message, shortened where it is long."""
    try:
        text = repr(value)
    except Exception:  # e.g. an integer of more digits than Python prints
        return f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}... ({type(value).__name__})"


def refusal(name: str, value: object, allowed: str) -> ValueError:
    """The error for a value that is not allowed."""
    return ValueError(f"{name} is {shown(value)}; allowed: {allowed}")


def as_integer(value: Any) -> int | None:
    """An integer of Python, numpy or torch as an int; None for anything else, bools and floats included."""
    if type(value) is int:
        return value
    if isinstance(value, bool) or "bool" in str(getattr(value, "dtype", "")):
        return None
    if len(getattr(value, "shape", ())) > 0:
        return None
    try:
        return index(value)
    except TypeError:
        return None


def integer(name: str, value: Any, low: int, high: int | None = None, *, allowed: str = "") -> int:
    """An integer from `low` to `high`, both included; no number is rounded.

    Raises:
        ValueError: For anything else.
    """
    found = as_integer(value)
    if found is None or found < low or (high is not None and found > high):
        limits = f"an integer >= {low}" if high is None else f"an integer from {low} to {high:,}"
        raise refusal(name, value, allowed or limits)
    return found


def seed(value: Any, name: str = "seed") -> int:
    """A seed, 0 to 2**64 - 1; raises a ValueError for anything else."""
    return integer(name, value, 0, HIGHEST_SEED, allowed="an integer from 0 to 2**64 - 1")


def is_number(value: Any, low: float, high: float) -> bool:
    """Whether a value is a finite real number from `low` to `high`."""
    real = isinstance(value, Real) and not isinstance(value, bool)
    return real and low <= value <= high and isfinite(value)


def number(name: str, value: Any, *, low: float, high: float, above: bool = False, allowed: str) -> float:
    """A finite number from `low` to `high`; `above`: without `low` itself.

    Raises:
        ValueError: For anything else.
    """
    if not is_number(value, low, high) or (above and value <= low):
        raise refusal(name, value, allowed)
    return float(value)


def choice(name: str, value: Any, allowed: Iterable[str]) -> None:
    """Raises a ValueError unless a value is one of these words."""
    names = tuple(allowed)
    if not isinstance(value, str) or value not in names:
        raise refusal(name, value, ", ".join(names))


def switch(name: str, value: Any) -> None:
    """Raises a ValueError unless a value is True or False."""
    if not isinstance(value, bool):
        raise refusal(name, value, "True or False")


def instance(name: str, value: Any, kind: type | tuple[type, ...], allowed: str) -> None:
    """Raises a ValueError unless a value has the type."""
    if not isinstance(value, kind):
        raise refusal(name, value, allowed)


def listed(name: str, value: Any, allowed: str) -> tuple[Any, ...]:
    """The items of a sequence, set, array or iterator as a tuple; text is none.

    Raises:
        ValueError: For anything else.
    """
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
    """Numbers as a float64 array; text, which numpy reads as numbers, is refused.

    Raises:
        ValueError: If they are anything else, or nested lists of unequal lengths.
    """
    try:
        found = np.asarray(values)
        if found.dtype.kind in "biuf":
            return found.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        pass
    raise refusal(name, values, "an array of numbers")


def memory(what: str, needed: int, *, free: int | None = None, advice: str) -> None:
    """Checks memory before it is allocated.

    Args:
        what: What takes the memory, e.g. "worlds is 1,000,000; their arrays".
        needed: Bytes.
        free: Bytes that are free; None for those of this machine's main memory.
        advice: What to change.

    Raises:
        MemoryError: If there is too little.
    """
    free = psutil.virtual_memory().available if free is None else free
    if needed > free:
        raise MemoryError(
            f"{what} take {needed / 2**30:.2f} GiB; {free / 2**30:.2f} GiB are free; allowed: {advice}"
        )
