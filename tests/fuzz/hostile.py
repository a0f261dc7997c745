"""Values that fit nowhere, or only by accident: numbers at limits, odd texts, foreign objects."""

from collections import OrderedDict
from decimal import Decimal
from enum import Enum
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from hypothesis import strategies as st

LIMITS: Final = (
    *(0, 1, -1, 2, 255, 256, 1000, -(2**31), 2**31 - 2, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53 + 1),
    *(2**63 - 1, 2**63, -(2**63), -(2**63) - 1, 2**64 - 2, 2**64 - 1, 2**64, 10**30, -(10**400)),
)
"""Whole numbers at which a type or a size ends."""

FLOATS: Final = (
    *(float("nan"), float("inf"), float("-inf"), 5e-324, -5e-324, 1e-310, 2.2e-308, 1.8e308, -1.8e308),
    *(0.0, -0.0, 1.0, 1.9, 0.5, 1 - 2**-53, 1 + 2**-52, -1e-9, 1e-10, 1e9, 3e38, 3.5e38, 2.0**63, 2.0**64),
)

TEXTS: Final = (
    *(
        "",
        " ",
        "\x00",
        "a\x00b",
        "\ud800",
        "\udfff x",
        "é",
        "\U0001d538",
        "\u202e",
        "\n",
        "-",
        "--",
        "a/b",
        "../..",
        ".",
    ),
    *(
        "None",
        "True",
        "nan",
        "1",
        "1.5",
        "cpu",
        "cuda:99",
        "meta",
        "adam",
        "final",
        "__class__",
        "a" * 70_000,
    ),
    *("os:getcwd", "module:Class", ":", "a:", ":b", "1/visits", "window", "rgb", "random", "self", "serve"),
)


class Colour(Enum):
    """Foreign members."""

    RED = 1


class MyInt(int):
    """An integer by another name."""


class MyText(str):
    """A text by another name."""

    __slots__ = ()


class Nothing:
    """Knows nothing, and shows a repr that holds no address."""

    def __repr__(self) -> str:
        return "Nothing()"


def nested(depth: int, kind: type) -> Any:
    """A list or tuple in a list or tuple, so many deep."""
    value: Any = kind()
    for _ in range(depth):
        value = kind((value,))
    return value


def nested_table(depth: int) -> dict[str, Any]:
    """A table in a table, so many deep."""
    value: dict[str, Any] = {}
    for _ in range(depth):
        value = {"a": value}
    return value


def itself() -> list[Any]:
    """A list that holds itself."""
    value: list[Any] = []
    value.append(value)
    return value


_MAKERS: Final = (
    lambda: None,
    lambda: True,
    lambda: False,
    lambda: b"",
    lambda: b"\xff\x00",
    lambda: bytearray(3),
    lambda: [],
    lambda: (),
    lambda: {},
    lambda: set(),
    lambda: frozenset({1}),
    lambda: range(3),
    lambda: [None],
    lambda: [[]],
    lambda: [[], [1]],
    lambda: [1, "a", None],
    lambda: (1, (2, (3,))),
    lambda: {"kind": "DQN"},
    lambda: {0: 1},
    lambda: OrderedDict(a=1),
    lambda: nested(300, tuple),
    lambda: nested(100_000, list),
    lambda: nested_table(5_000),
    itself,
    Nothing,
    lambda: Nothing,
    lambda: object,
    lambda: len,
    lambda: lambda: 0,
    lambda: Ellipsis,
    lambda: NotImplemented,
    lambda: 1j,
    lambda: Decimal("NaN"),
    lambda: Decimal("0.1"),
    lambda: Fraction(1, 3),
    lambda: Colour.RED,
    lambda: MyInt(3),
    lambda: MyText("random"),
    lambda: Path("x"),
    lambda: Path("a\x00b"),
    lambda: np.float64("nan"),
    lambda: np.float64(0.5),
    lambda: np.float32(0.1),
    lambda: np.float16(1),
    lambda: np.longdouble("1e4000"),
    lambda: np.int64(3),
    lambda: np.uint8(255),
    lambda: np.bool_(True),
    lambda: np.str_("random"),
    lambda: np.datetime64("NaT"),
    lambda: np.array(3),
    lambda: np.array([]),
    lambda: np.zeros((2, 3)),
    lambda: np.arange(4, dtype=np.int8),
    lambda: np.array([None, "a"], dtype=object),
    lambda: np.array(["a", "b"]),
    lambda: np.array([[1, 2], [3, 4]], dtype=np.complex64),
    lambda: np.ma.masked,
    lambda: torch.tensor(1),
    lambda: torch.tensor(float("nan")),
    lambda: torch.zeros(0),
    lambda: torch.zeros(2, 3, dtype=torch.bfloat16),
    lambda: torch.ones(2, 3, 4, dtype=torch.bool),
    lambda: torch.zeros(2, 2, dtype=torch.complex64),
    lambda: torch.zeros(3, device="meta"),
    lambda: torch.eye(3).to_sparse(),
    lambda: torch.device("cpu"),
    lambda: torch.nn.Linear(1, 1),
    lambda: torch.float32,
    lambda: np.float32,
    lambda: int,
)


def numbers() -> st.SearchStrategy[Any]:
    """Whole numbers and floating-point numbers, at limits and between."""
    return st.one_of(
        st.sampled_from(LIMITS),
        st.sampled_from(FLOATS),
        st.integers(-(2**70), 2**70),
        st.floats(allow_subnormal=False),
    )


def texts() -> st.SearchStrategy[str]:
    """Texts, lone surrogates and NUL among them."""
    return st.one_of(st.sampled_from(TEXTS), st.text(st.characters(codec=None), max_size=20))


def scalars() -> st.SearchStrategy[Any]:
    """Numbers, texts, None and switches."""
    return st.one_of(numbers(), texts(), st.sampled_from((None, True, False)))


def objects() -> st.SearchStrategy[Any]:
    """Anything else, made anew for each case."""
    return st.sampled_from(_MAKERS).map(lambda make: make())


def values() -> st.SearchStrategy[Any]:
    """Any of these, and containers of them."""
    inner = st.one_of(scalars(), objects())
    return st.one_of(
        scalars(),
        objects(),
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.lists(scalars(), max_size=3).map(lambda own: (tuple(own), tuple(own))),
        st.dictionaries(st.text(max_size=5), inner, max_size=3),
    )
