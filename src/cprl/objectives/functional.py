"""TorchRL losses as functions of their weights, so that one loss can be computed with the weights of many
lanes."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import torch
from tensordict import TensorDict, is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.system.compat.torchrl import (
    forget_cached_weights,
    promise_targets,
    refuse_updaters,
    updated_weights,
)

Weights = dict[str, Tensor]
"""The weights of a loss or a network by name."""

_NO_UPDATER: Final = (
    "a SoftUpdate or HardUpdate was built on the {}; the learner has weights of its own, which it would not "
    "change: leave it out, and set tau or target_every_episodes"
)


STATE_TYPES: Final = bool | int | float | Tensor
"""The types of attributes of a loss that count as its state."""


class FunctionalLoss:
    """A TorchRL loss module as a function of its weights that returns one loss per transition.

    TorchRL stores the weights of a loss in `TensorDictParams` of the module. During a call plain TensorDicts
    replace them, which both `torch.func` and `torch.compile` accept.
    """

    def __init__(self, loss: LossModule) -> None:
        loss.reduction = "none"
        if hasattr(loss, "scalar_output_mode"):
            loss.scalar_output_mode = "exclude"  # drops scalars that are not losses of transitions
        make_lazy_parts(loss)
        self._groups = {name: group.batch_size for name, group in groups_of(loss).items()}
        """The batch sizes of the groups of weights, by the attribute that holds the group."""
        self._single_names = tuple(single_weights(loss))
        """The attributes that hold weights in no group."""
        for name in (*self._groups, *self._single_names):
            delattr(loss, name)
            setattr(loss, name, None)
        refuse_updaters(loss, _NO_UPDATER.format(type(loss).__name__))
        self.module = loss

    def __call__(self, weights: Weights, batch: TensorDict) -> Tensor:
        """Return the loss of each transition, [L, b], or [b] under vmap; one number if the loss averages it.

        Args:
            weights: all weights of the loss, named as by `named_weights`.
        """
        for name, size in self._groups.items():
            prefix = f"{name}:"
            group = {key.removeprefix(prefix): weights[key] for key in weights if key.startswith(prefix)}
            setattr(self.module, name, TensorDict(group, size).unflatten_keys("."))
        for name in self._single_names:
            setattr(self.module, name, weights[name])
        if not torch.compiler.is_compiling():
            forget_cached_weights(self.module)
        losses = total(self.module(batch), self.module)
        for name in (*self._groups, *self._single_names):
            setattr(self.module, name, None)
        return losses

    def call_state(self) -> dict[str, Any]:
        """Return the state that the loss keeps from one call to the next: its buffers, and its attributes
        that are numbers or tensors."""
        return {"buffers": dict(self.module.named_buffers()), "attributes": attributes_of(self.module)}

    def load_call_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `call_state` returned."""
        for name, buffer in self.module.named_buffers():
            buffer.copy_(state["buffers"][name])
        set_attributes(self.module, state["attributes"])


def make_lazy_parts(loss: LossModule) -> None:
    """Make the attributes that a loss creates at first access, so that they do not look like changes by a
    call."""
    getattr(loss, "in_keys", None)
    with suppress(NotImplementedError):  # a loss may have no value estimator
        getattr(loss, "value_estimator", None)


def attributes_of(loss: LossModule) -> dict[str, Any]:
    """Return the attributes of a loss that are numbers or tensors, which it may change from call to call."""
    return {name: value for name, value in vars(loss).items() if isinstance(value, STATE_TYPES)}


def set_attributes(loss: LossModule, attributes: Mapping[str, Any]) -> None:
    """Set the attributes of a loss to those that `attributes_of` returned."""
    for name, value in attributes.items():
        copy = value.clone() if isinstance(value, Tensor) else value
        setattr(loss, name, copy)


def mark_targets_updated(loss: LossModule) -> None:
    """Tell TorchRL that the learner updates the targets of a loss, so that it does not warn.

    Raises:
        ValueError: if the loss already has an updater of TorchRL's.
    """
    if any(f"target_{name}_params" in groups_of(loss) for name in updated_weights(loss)):
        raise ValueError(_NO_UPDATER.format(type(loss).__name__))
    promise_targets(loss)


def total(out: Any, loss: LossModule) -> Tensor:
    """Return the sum of all losses in the output of a loss module: the entries that begin with "loss".

    Raises:
        ValueError: if the output has no such entry.
    """
    entries = dict(out.items()) if is_tensor_collection(out) else {}
    losses = [value for name, value in entries.items() if name.startswith("loss")]
    if not losses:
        kind = type(loss)
        has = f" with the entries {sorted(entries)}" if entries else ""
        raise ValueError(
            f"the loss {kind.__module__}:{kind.__qualname__} returns a {type(out).__name__}{has}; allowed: "
            'a TensorDict with entries whose names begin with "loss"'
        )
    return sum(losses[1:], losses[0])


def groups_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """Return the groups of weights of a loss by name, including targets."""
    modules = loss.named_modules(remove_duplicate=False)
    return {name: group for name, group in modules if isinstance(group, TensorDictParams) and "." not in name}


def single_weights(loss: LossModule) -> dict[str, nn.Parameter]:
    """Return the weights of a loss that are in no group, by name; `LossModule.named_parameters` omits
    some of them."""
    return dict(nn.Module.named_parameters(loss, recurse=False, remove_duplicate=False))


def targets_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """Return the groups of weights that have targets, by name."""
    groups = groups_of(loss)
    return {name: group for name, group in groups.items() if f"target_{name}" in groups}


def named_weights(loss: LossModule) -> Weights:
    """Return all weights of a loss, not copied, by name: "group:name", or "name" for weights in no group."""
    grouped = {
        f"{group}:{key}": value
        for group, weights in groups_of(loss).items()
        for key, value in weights.flatten_keys(".").items()
    }
    return {**grouped, **single_weights(loss)}


def weights_of(loss: LossModule) -> Weights:
    """Return copies of all weights of a loss, including targets, by name."""
    return {name: value.detach().clone() for name, value in named_weights(loss).items()}
