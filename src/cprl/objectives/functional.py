"""A TorchRL loss as a function of its weights: their names, their targets, and what the loss returns."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import torch
from tensordict import TensorDict, is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.system.compat import forget_cached_weights, promise_targets, refuse_updaters, updated_weights

Weights = dict[str, Tensor]

_NO_UPDATER: Final = (
    "a SoftUpdate or HardUpdate was built on the {}; the learner has weights of its own, which it would not "
    "change: leave it out, and set tau or target_every_episodes"
)


_KEPT: Final = bool | int | float | Tensor


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
        self._singles = tuple(single_weights(loss))
        for name in (*self._groups, *self._singles):
            delattr(loss, name)
            setattr(loss, name, None)
        refuse_updaters(loss, _NO_UPDATER.format(type(loss).__name__))
        self.module = loss

    def __call__(self, params: Weights, targets: Weights, batch: TensorDict) -> Tensor:
        """The loss of each transition, [L, b], or [b] under vmap; a single number if the loss reduces it."""
        flat = {**params, **targets}
        for name, size in self._groups.items():
            prefix = f"{name}:"
            group = {key.removeprefix(prefix): flat[key] for key in flat if key.startswith(prefix)}
            setattr(self.module, name, TensorDict(group, size).unflatten_keys("."))
        for name in self._singles:
            setattr(self.module, name, params[name])
        if not torch.compiler.is_compiling():
            forget_cached_weights(self.module)
        losses = total(self.module(batch), self.module)
        for name in (*self._groups, *self._singles):
            setattr(self.module, name, None)
        return losses

    def kept(self) -> dict[str, Any]:
        """What the loss keeps from call to call: buffers, and attributes that are numbers or tensors."""
        return {"buffers": dict(self.module.named_buffers()), "attributes": attributes_of(self.module)}

    def keep(self, kept: Mapping[str, Any]) -> None:
        """Continues with what `kept` returned."""
        for name, buffer in self.module.named_buffers():
            buffer.copy_(kept["buffers"][name])
        set_attributes(self.module, kept["attributes"])


def make_lazy_parts(loss: LossModule) -> None:
    """Makes what a loss creates at first access, which would look like a change by a call."""
    getattr(loss, "in_keys", None)
    with suppress(NotImplementedError):  # a loss may have none
        getattr(loss, "value_estimator", None)


def attributes_of(loss: LossModule) -> dict[str, Any]:
    """The attributes of a loss that are numbers or tensors, which it may change from call to call."""
    return {name: value for name, value in vars(loss).items() if isinstance(value, _KEPT)}


def set_attributes(loss: LossModule, attributes: Mapping[str, Any]) -> None:
    """Sets what `attributes_of` returned."""
    for name, value in attributes.items():
        setattr(loss, name, value.clone() if isinstance(value, Tensor) else value)


def own_targets(loss: LossModule) -> None:
    """Marks the targets of a loss as updated, by the learner, so that TorchRL does not warn."""
    if any(f"target_{name}_params" in groups_of(loss) for name in updated_weights(loss)):
        raise ValueError(_NO_UPDATER.format(type(loss).__name__))
    promise_targets(loss)


def total(out: Any, loss: LossModule) -> Tensor:
    """The sum of all entries that TorchRL calls a loss."""
    entries = dict(out.items()) if is_tensor_collection(out) else {}
    losses = [value for name, value in entries.items() if name.startswith("loss")]
    if not losses:
        kind = type(loss)
        has = f" with the entries {sorted(entries)}" if entries else ""
        raise ValueError(
            f"the loss {kind.__module__}:{kind.__qualname__} returns a {type(out).__name__}{has}; allowed: "
            'a TensorDict with entries whose names begin with "loss"'
        )
    summed: Tensor = sum(losses[1:], losses[0])
    return summed


def groups_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights of a loss by name, including targets."""
    named = loss.named_modules(remove_duplicate=False)
    return {name: group for name, group in named if isinstance(group, TensorDictParams) and "." not in name}


def single_weights(loss: LossModule) -> dict[str, nn.Parameter]:
    """The weights of a loss that are in no group, by name; `LossModule.named_parameters` omits some."""
    return dict(nn.Module.named_parameters(loss, recurse=False, remove_duplicate=False))


def targets_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights that have targets, by name."""
    groups = groups_of(loss)
    return {name: group for name, group in groups.items() if f"target_{name}" in groups}


def named_weights(loss: LossModule) -> Weights:
    """All weights of a loss, not copied, by "group:name"; weights in no group by their name."""
    grouped = {
        f"{group}:{key}": value
        for group, weights in groups_of(loss).items()
        for key, value in weights.flatten_keys(".").items()
    }
    return {**grouped, **single_weights(loss)}


def weights_of(loss: LossModule) -> Weights:
    """Copies of all weights of a loss, including targets, by name."""
    return {name: value.detach().clone() for name, value in named_weights(loss).items()}
