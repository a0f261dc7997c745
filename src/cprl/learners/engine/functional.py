"""TorchRL's loss modules as functions of their weights, and their weights by name."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import torch
from tensordict import TensorDict, is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.networks.stacked import stack_lanes
from cprl.system.compat import forget_cached_weights, promise_targets, refuse_updaters, updated_weights

MakeLoss = Callable[[nn.Module], LossModule]
"""Makes one agent's loss from its network; see `cprl.learners.single.dqn_loss`."""

Weights = dict[str, Tensor]

_NO_UPDATER: Final = (
    "a SoftUpdate or HardUpdate was built on the {}; the engine has weights of its own, which it would not "
    "change: leave it out, and set tau or target_every_episodes"
)


class FunctionalLoss:
    """A TorchRL loss module as a function of its weights that returns one loss per transition.

    TorchRL stores the weights of a loss in `TensorDictParams` of the module. During a call plain TensorDicts
    replace them, which both `torch.func` and `torch.compile` accept.

    Args:
        loss: the module; its own weights are removed from it.
    """

    def __init__(self, loss: LossModule) -> None:
        loss.reduction = "none"
        if hasattr(loss, "scalar_output_mode"):
            loss.scalar_output_mode = "exclude"  # drops scalars that are not losses of transitions
        # Created lazily at first access, which a compiler would see as a change; a loss may have neither.
        getattr(loss, "in_keys", None)
        with suppress(NotImplementedError):
            getattr(loss, "value_estimator", None)
        self._groups = {name: group.batch_size for name, group in groups_of(loss).items()}
        self._singles = tuple(_single_weights(loss))
        for name in (*self._groups, *self._singles):
            delattr(loss, name)
            setattr(loss, name, None)
        refuse_updaters(loss, _NO_UPDATER.format(type(loss).__name__))
        self.module = loss

    def __call__(self, own: Weights, fixed: Weights, batch: TensorDict) -> Tensor:
        """The loss of each transition, [L, b], or [b] under vmap; a single number if the loss reduces it."""
        flat = {**own, **fixed}
        for name, size in self._groups.items():
            mine = f"{name}:"
            group = {key.removeprefix(mine): flat[key] for key in flat if key.startswith(mine)}
            setattr(self.module, name, TensorDict(group, size).unflatten_keys("."))
        for name in self._singles:
            setattr(self.module, name, own[name])
        if not torch.compiler.is_compiling():
            forget_cached_weights(self.module)
        losses = total(self.module(batch), self.module)
        for name in (*self._groups, *self._singles):
            setattr(self.module, name, None)
        return losses


def own_targets(loss: LossModule) -> None:
    """Marks the targets of a loss as updated, by the engine, so that TorchRL does not warn.

    Raises:
        ValueError: if the loss already has a `SoftUpdate` or `HardUpdate`, which would have no effect.
    """
    if any(f"target_{name}_params" in groups_of(loss) for name in updated_weights(loss)):
        raise ValueError(_NO_UPDATER.format(type(loss).__name__))
    promise_targets(loss)


def total(out: Any, loss: LossModule) -> Tensor:
    """The sum of all entries that TorchRL calls a loss.

    Args:
        out: what the loss returned.
        loss: named in the error.

    Raises:
        ValueError: if it is no TensorDict, or has no such entry.
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
    summed: Tensor = sum(losses[1:], losses[0])
    return summed


def groups_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights of a loss by name, including targets."""
    named = loss.named_modules(remove_duplicate=False)
    return {name: own for name, own in named if isinstance(own, TensorDictParams) and "." not in name}


def _single_weights(loss: LossModule) -> dict[str, nn.Parameter]:
    """The weights of a loss that are in no group, by name; `LossModule.named_parameters` omits some."""
    return dict(nn.Module.named_parameters(loss, recurse=False, remove_duplicate=False))


def targets_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights that have targets, by name."""
    groups = groups_of(loss)
    return {name: group for name, group in groups.items() if f"target_{name}" in groups}


def _named(loss: LossModule) -> Weights:
    """All weights of a loss, not copied, by "group:name"; weights in no group by their name."""
    grouped = {
        f"{group}:{key}": value
        for group, weights in groups_of(loss).items()
        for key, value in weights.flatten_keys(".").items()
    }
    return {**grouped, **_single_weights(loss)}


def weights_of(loss: LossModule) -> Weights:
    """Copies of all weights of a loss, including targets, by name."""
    return {name: value.detach().clone() for name, value in _named(loss).items()}


class Stacked(NamedTuple):
    """A loss of many lanes and its weights by name, with the lane axis first."""

    loss: LossModule
    own: Weights
    """The trained weights."""
    fixed: Weights
    """Tensors that gradients do not change: target weights and buffers."""
    names: Mapping[str, str]
    """The names in the loss of those parameters of the network that are among its weights."""


def stacked(networks: Sequence[nn.Module], make_loss: MakeLoss, *, lane_axis: bool) -> Stacked:
    """One loss for the networks of all lanes; the weights are copied.

    Raises:
        ValueError: with a lane axis: if the networks cannot be stacked, if the loss has weights of its own,
            which all lanes would share, or if the loss adds an axis of its own before the lane axis.
    """
    made = [stack_lanes(networks)] if lane_axis else list(networks)
    losses = [make_loss(network) for network in made]
    if lane_axis and (shared := _single_weights(losses[0])):
        raise ValueError(f"all agents would share the weights {', '.join(shared)} of the loss")
    if lane_axis and any(group.batch_size for group in groups_of(losses[0]).values()):
        raise ValueError("the loss stacks networks along an axis before the lane axis")
    for loss in losses:
        own_targets(loss)
    named = _named(losses[0])
    where = {value.data_ptr(): name for name, value in named.items()}
    names = {
        name: where[weight.data_ptr()]
        for name, weight in made[0].named_parameters()
        if weight.data_ptr() in where
    }
    learns = [name for name, value in named.items() if value.requires_grad]
    each = [weights_of(loss) for loss in losses]
    weights = each[0] if lane_axis else {name: torch.stack([one[name] for one in each]) for name in each[0]}
    return Stacked(
        losses[0],
        {name: weights[name] for name in learns},
        {name: value for name, value in weights.items() if name not in learns},
        names,
    )


def vmapped(network: nn.Module, weights: Weights, *inputs: Tensor) -> Any:
    """The outputs of a network with the weights of each lane."""

    def output(own: Weights, *seen: Tensor) -> Any:
        return torch.func.functional_call(network, own, seen)

    return torch.vmap(output)(weights, *inputs)
