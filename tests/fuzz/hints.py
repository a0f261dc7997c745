"""Strategies out of type hints: values that a parameter with this hint can take."""

import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import numpy as np
import torch
from hypothesis import strategies as st

from . import things

_INTS: Final = st.one_of(st.sampled_from((0, 1, 2, 3, 4, 5, 7, 8, 10, 20)), st.integers(0, 100))
_FLOATS: Final = st.one_of(
    st.sampled_from((0.0, 0.1, 0.25, 0.5, 0.9, 1.0, 2.0)), st.floats(0, 1, allow_subnormal=False)
)
_TEXTS: Final = st.sampled_from(("agent_0", "mine", "random", "commons", "equality"))
_SIMPLE: Final[dict[Any, st.SearchStrategy[Any]]] = {
    int: _INTS,
    float: st.one_of(_FLOATS, _INTS),
    bool: st.booleans(),
    str: _TEXTS,
    type(None): st.none(),
    None: st.none(),
    Any: st.one_of(_INTS, _FLOATS, _TEXTS, st.none()),
    object: st.one_of(_INTS, _FLOATS, _TEXTS, st.none()),
}


def of_hint(hint: Any) -> st.SearchStrategy[Any]:
    """Values of a hint; of classes of cprl and of torch examples, made anew where they can change."""
    if isinstance(hint, types.GenericAlias | type(Sequence[int])) or get_origin(hint) is not None:
        return _of_generic(hint)
    try:
        if hint in _SIMPLE:
            return _SIMPLE[hint]
    except TypeError:
        return st.none()
    if isinstance(hint, type):
        examples = things.examples_of(hint)
        if examples is not None:
            return examples
    return st.none()


def _of_generic(hint: Any) -> st.SearchStrategy[Any]:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return st.one_of([of_hint(own) for own in arguments])
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is Annotated:
        return of_hint(arguments[0])
    if origin is tuple:
        if arguments[-1:] == (Ellipsis,):
            return st.lists(of_hint(arguments[0]), max_size=4).map(tuple)
        return st.tuples(*map(of_hint, arguments))
    if origin in (list, Sequence, Iterable):
        return st.lists(of_hint(arguments[0]), max_size=4)
    if origin in (dict, Mapping):
        return st.dictionaries(_keys(arguments[0]), of_hint(arguments[1]), max_size=3)
    if origin is Callable:
        return st.just(things.echo)
    if origin is np.ndarray:
        return things.arrays()
    return st.none()


def _keys(hint: Any) -> st.SearchStrategy[Any]:
    return of_hint(hint).filter(lambda value: getattr(value, "__hash__", None) is not None)


PATHS: Final = st.sampled_from((Path("x"), Path("some/where")))
DEVICES: Final = st.sampled_from(("cpu", torch.device("cpu")))
