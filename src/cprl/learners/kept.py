"""What a loss keeps from call to call."""

from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from tensordict import is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.objectives.functional import named_weights

_OF_TORCH: Final = frozenset({*vars(nn.Module()), "_cache"})
"""Attributes of modules that torch and TorchRL themselves change at a call."""
_NUMBERS: Final = bool | int | float


class _Kept(NamedTuple):
    """A buffer or an attribute, with what is in it now."""

    value: Any
    is_buffer: bool
    inside: Any

    def becomes(self, after: "_Kept") -> bool:
        """Whether a learner can store what comes after it for each lane."""
        before, value = self.value, after.value
        if self.is_buffer and after.is_buffer and isinstance(before, Tensor) and isinstance(value, Tensor):
            return before.shape == value.shape and before.dtype == value.dtype
        return isinstance(value, _NUMBERS | Tensor) and not after.is_buffer


_NOTHING: Final = _Kept(None, False, None)


def kept_by(loss: LossModule, call: Callable[[], Any]) -> list[str]:
    """Return the names of what two calls change of a loss, and its learner stores for each lane: buffers, and
    attributes of the loss itself that are numbers or tensors.

    Every attribute and buffer of the loss and its submodules is compared, with what is in it: the numbers of
    arrays, the elements of containers, the state of other objects as pickle would take it. Not seen is what
    is elsewhere: in classes, globals, functions and files. Weights and targets are the learner's own.

    Args:
        call: calls the loss.

    Raises:
        ValueError: if anything else changes, or a buffer comes or grows.
    """
    now, changed = _state_of(loss), set()
    for _ in range(2):
        call()
        before, now = now, _state_of(loss)
        for name in sorted(before.keys() | now.keys()):
            was, then = before.get(name, _NOTHING), now.get(name, _NOTHING)
            if was.inside == then.inside:
                continue
            if ("." in name and not then.is_buffer) or not was.becomes(then):
                kind = "buffer that comes or grows" if then.is_buffer else type(then.value).__name__
                raise ValueError(
                    f"the loss {type(loss).__name__} keeps its {name}, a {kind}, from call to call, which no "
                    "checkpoint has; allowed: buffers of one size, and attributes of the loss itself that "
                    "are numbers or tensors"
                )
            changed.add(name)
    return sorted(changed)


def _state_of(loss: LossModule) -> dict[str, _Kept]:
    """The buffers and attributes of a loss and its submodules, by name."""
    modules = dict(loss.named_modules())
    # Another module is looked at under its own name, wherever it is referred to.
    everyone = {id(each): (place, each) for place, each in enumerate(modules.values())}
    weights = {value.data_ptr() for value in named_weights(loss).values()}
    state = {}
    for path, module in modules.items():
        if any(isinstance(modules[above], TensorDictParams) for above in _with_owners(path)):
            continue
        named = {name: value for name, value in vars(module).items() if name not in _OF_TORCH}
        for name, value in {**named, **module._buffers}.items():
            is_buffer, inside = name in module._buffers, _inside(value, weights, dict(everyone))
            state[f"{path}.{name}".removeprefix(".")] = _Kept(value, is_buffer, inside)
    return state


def _with_owners(path: str) -> list[str]:
    """A module's name, and those of the modules in which it is, but for the loss."""
    parts = path.split(".")
    return [".".join(parts[:size]) for size in range(1, len(parts) + 1)]


def _inside(value: Any, weights: set[int], seen: dict[int, tuple[int, Any]]) -> Any:
    """What is in a value, to be compared by ==.

    Args:
        weights: where those of the learner are stored, which are left out.
        seen: what was met before, by id.
    """
    if value is None or isinstance(value, str | bytes):
        return value
    if isinstance(value, _NUMBERS | complex):
        return repr(value)  # NaN equals itself
    if id(value) in seen:
        return seen[id(value)][0]
    seen[id(value)] = len(seen), value
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
        return [(_inside(name, weights, seen), _inside(each, weights, seen)) for name, each in value.items()]
    if isinstance(value, list | tuple):
        return [_inside(each, weights, seen) for each in value]
    if isinstance(value, set | frozenset):
        return value.copy()
    try:
        made, *state = value.__reduce_ex__(2)
    except Exception:  # classes, functions and others that pickle does not take, or an object's own
        return id(value)
    parts = [list(part) if isinstance(part, Iterator) else part for part in state]
    return getattr(made, "__qualname__", ""), [_inside(part, weights, seen) for part in parts]
