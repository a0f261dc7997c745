"""Find the state that a user's loss keeps from one call to the next, by comparing it around two calls.

Such state has to be stored for each lane and in checkpoints, or refused: else lanes would share it, and a
resumed training would differ.
"""

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from tensordict import is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.objectives.functional import named_weights

_CHANGED_BY_TORCH: Final = frozenset({*vars(nn.Module()), "_cache"})
"""Attributes of modules that torch and TorchRL themselves change in a call."""
_NUMBERS: Final = bool | int | float
"""The types of plain numbers."""


class _Entry(NamedTuple):
    """A buffer or an attribute of a loss, with its content at the time it was read."""

    value: Any
    """The object itself, which later calls may change."""
    is_buffer: bool
    content: Any
    """A copy of what the object holds, compared by ==, see `_content`."""

    def can_become(self, after: "_Entry") -> bool:
        """Return whether a learner can store the change from this entry to another, for each lane."""
        value = after.value
        if (
            self.is_buffer
            and after.is_buffer
            and isinstance(value, Tensor)
            and isinstance(self.value, Tensor)
        ):
            return self.value.shape == value.shape and self.value.dtype == value.dtype
        return isinstance(value, _NUMBERS | Tensor) and not after.is_buffer


_NO_ENTRY: Final = _Entry(None, False, None)
"""In place of an entry that does not exist before or after a call."""


def changed_state(loss: LossModule, call: Callable[[], Any]) -> list[str]:
    """Return the names of the state that two calls of a loss change.

    These are buffers, and attributes of the loss itself that are numbers or tensors; the learner stores them
    for each lane. Every attribute and buffer of the loss and its submodules is compared, with its content:
    the numbers of arrays, the elements of containers, the state of other objects as pickle would store it.
    State elsewhere, in classes, globals, functions and files, is not found. Weights and targets are left out,
    since the learner itself changes them.

    Args:
        call: calls the loss.

    Raises:
        ValueError: if anything else changes, or a buffer is new or changes its size.
    """
    state = _state_of(loss)
    changed = set()
    for _ in range(2):
        state_before = state
        call()
        state = _state_of(loss)
        for name in sorted(state_before.keys() | state.keys()):
            before = state_before.get(name, _NO_ENTRY)
            after = state.get(name, _NO_ENTRY)
            if before.content == after.content:
                continue
            is_of_submodule = "." in name
            if (is_of_submodule and not after.is_buffer) or not before.can_become(after):
                kind = "buffer that comes or grows" if after.is_buffer else type(after.value).__name__
                raise ValueError(
                    f"the loss {type(loss).__name__} keeps its {name}, a {kind}, from call to call, which no "
                    "checkpoint has; allowed: buffers of one size, and attributes of the loss itself that "
                    "are numbers or tensors"
                )
            changed.add(name)
    return sorted(changed)


def _state_of(loss: LossModule) -> dict[str, _Entry]:
    """Return the buffers and attributes of a loss and its submodules, by name."""
    modules = dict(loss.named_modules())
    # Modules count as met: each is compared under its own name, and not wherever an attribute refers to it.
    met_modules = {id(module): (number, module) for number, module in enumerate(modules.values())}
    weights = {value.data_ptr() for value in named_weights(loss).values()}
    state = {}
    for path, module in modules.items():
        if any(isinstance(modules[outer], TensorDictParams) for outer in _outer_paths(path)):
            continue  # weights
        attributes = {name: value for name, value in vars(module).items() if name not in _CHANGED_BY_TORCH}
        buffers = dict(module.named_buffers(recurse=False, remove_duplicate=False))
        for name, value in {**attributes, **buffers}.items():
            content = _content(value, weights, dict(met_modules))
            state[f"{path}.{name}".removeprefix(".")] = _Entry(value, name in buffers, content)
    return state


def _outer_paths(path: str) -> list[str]:
    """Return the names of a module and of all modules that contain it, e.g. "a" and "a.b" for "a.b"."""
    names = path.split(".")
    return [".".join(names[:depth]) for depth in range(1, len(names) + 1)]


def _content(value: Any, weights: set[int], met: dict[int, tuple[int, Any]]) -> Any:
    """Return the content of a value, recursively, in a form that is compared by ==.

    Args:
        weights: the addresses of the learner's weights, which are left out.
        met: the objects that were met before, by id, each with its number; an object that is met again, such
            as one that contains itself, is replaced by its number.
    """
    if value is None or isinstance(value, str | bytes):
        return value
    if isinstance(value, _NUMBERS | complex):
        return repr(value)  # NaN equals itself
    if id(value) in met:
        return met[id(value)][0]
    met[id(value)] = len(met), value
    if isinstance(value, Tensor):
        plain = value.detach()
        is_left_out = plain.is_meta or plain.layout != torch.strided or plain.data_ptr() in weights
        numbers = None if is_left_out else plain.cpu().flatten().view(torch.uint8).numpy().tobytes()
        return plain.shape, plain.dtype, numbers
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value.shape, value.dtype, value.tobytes()
    if isinstance(value, TensorDictParams):
        return None
    if isinstance(value, dict) or is_tensor_collection(value):
        return [(_content(name, weights, met), _content(item, weights, met)) for name, item in value.items()]
    if isinstance(value, list | tuple):
        return [_content(item, weights, met) for item in value]
    if isinstance(value, set | frozenset):
        return value.copy()
    try:
        rebuild, *state = value.__reduce_ex__(2)
    except Exception:  # pickle does not take classes, functions and others, and an object may raise anything
        return id(value)
    parts = [list(part) if isinstance(part, Iterator) else part for part in state]
    return getattr(rebuild, "__qualname__", ""), [_content(part, weights, met) for part in parts]
