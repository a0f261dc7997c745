"""Find the state that a user's loss keeps from one call to the next, by comparing it around two calls.

Such state has to be stored for each lane and in checkpoints, or refused: else lanes would share it, and a
resumed training would differ.
"""

from collections.abc import Callable
from io import BytesIO
from pickle import Pickler
from types import FunctionType
from typing import Any, Final

import torch
from tensordict import is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.objectives.functional import STATE_TYPES, named_weights

_CHANGED_BY_TORCH: Final = frozenset({*vars(nn.Module()), "_cache"})
"""Attributes of modules that torch and TorchRL themselves change in a call."""


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
    sizes = _buffer_sizes(loss)
    contents = _contents(loss)
    changed = set()
    for _ in range(2):
        contents_before = contents
        call()
        contents = _contents(loss)
        names = contents_before.keys() | contents.keys()
        changed |= {name for name in names if contents_before.get(name) != contents.get(name)}
    new_sizes = _buffer_sizes(loss)
    for name in sorted(changed):
        if name in new_sizes:
            kind = "buffer that comes or grows"
            is_stored = sizes.get(name) == new_sizes[name]
        else:
            value = _state_of(loss).get(name)
            kind = type(value).__name__
            is_stored = "." not in name and isinstance(value, STATE_TYPES)
        if not is_stored:
            raise ValueError(
                f"the loss {type(loss).__name__} keeps its {name}, a {kind}, from call to call, which no "
                "checkpoint has; allowed: buffers of one size, and attributes of the loss itself that "
                "are numbers or tensors"
            )
    return sorted(changed)


def _buffer_sizes(loss: LossModule) -> dict[str, tuple[torch.Size, torch.dtype]]:
    """Return the shape and the dtype of each buffer of a loss and its submodules, by name."""
    buffers = loss.named_buffers(remove_duplicate=False)
    return {name: (buffer.shape, buffer.dtype) for name, buffer in buffers}


def _state_of(loss: LossModule) -> dict[str, Any]:
    """Return the buffers and attributes of a loss and its submodules, by name."""
    modules = dict(loss.named_modules())
    groups = tuple(f"{path}." for path, module in modules.items() if isinstance(module, TensorDictParams))
    state = {}
    for path, module in modules.items():
        if f"{path}.".startswith(groups):
            continue  # weights
        attributes = {name: value for name, value in vars(module).items() if name not in _CHANGED_BY_TORCH}
        buffers = dict(module.named_buffers(recurse=False, remove_duplicate=False))
        for name, value in {**attributes, **buffers}.items():
            state[f"{path}.{name}".removeprefix(".")] = value
    return state


def _contents(loss: LossModule) -> dict[str, bytes]:
    """Return what the buffers and attributes of a loss and its submodules hold, by name, see `_content`."""
    # Each module is compared under its own name, and not wherever an attribute refers to it.
    module_ids = {id(module) for module in loss.modules()}
    weights = {value.data_ptr() for value in named_weights(loss).values()}
    return {name: _content(value, module_ids, weights) for name, value in _state_of(loss).items()}


def _content(value: Any, module_ids: set[int], weights: set[int]) -> bytes:
    """Return what a value holds, recursively, as bytes that are equal if the contents are."""
    file = BytesIO()
    _ContentPickler(file, module_ids, weights).dump(value)
    return file.getvalue()


class _ContentPickler(Pickler):
    """Pickles what an object holds: the numbers of its tensors, but those of weights, and the state of all
    other objects; those that pickle refuses, such as functions, count by their identity.

    Args:
        module_ids: the ids of modules that are left out.
        weights: the addresses of the learner's weights, which are left out.
    """

    def __init__(self, file: BytesIO, module_ids: set[int], weights: set[int]) -> None:
        super().__init__(file)
        self._module_ids = module_ids
        self._weights = weights

    def persistent_id(self, value: Any) -> Any:
        """Return what is written in place of an object; None to write the object."""
        if isinstance(value, TensorDictParams | type | FunctionType) or id(value) in self._module_ids:
            return id(value)
        if is_tensor_collection(value):
            return dict(value.items())
        if not isinstance(value, Tensor):
            return None
        plain = value.detach()
        is_left_out = plain.is_meta or plain.layout != torch.strided or plain.data_ptr() in self._weights
        numbers = None if is_left_out else plain.cpu().flatten().view(torch.uint8).numpy().tobytes()
        return tuple(plain.shape), str(plain.dtype), numbers

    def reducer_override(self, value: Any) -> Any:
        """Return how an object is rebuilt of its state; for one that pickle refuses, of its identity."""
        try:
            reduced = value.__reduce_ex__(2)
        except Exception:  # of a user's object, which may raise anything
            reduced = None
        return reduced if isinstance(reduced, tuple) else (int, (id(value),))
