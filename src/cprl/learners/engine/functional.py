"""Loss modules of TorchRL's as functions of their weights, and their weights by name."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import A2CLoss, LossModule, PPOLoss, ReinforceLoss

from cprl.networks.stacked import stack_lanes

MakeLoss = Callable[[nn.Module], LossModule]
"""A per-agent loss out of a network; see `cprl.learners.single.dqn_loss`."""

Weights = dict[str, Tensor]


class FunctionalLoss:
    """A loss module of TorchRL's as a function of its weights, one loss for each transition.

    TorchRL keeps a loss's weights in `TensorDictParams` of the module; here plain TensorDicts take their
    place during a call, which both `torch.func` and `torch.compile` accept.

    Args:
        loss: the module; its own weights are taken out.
    """

    def __init__(self, loss: LossModule) -> None:
        loss.reduction = "none"
        if hasattr(loss, "scalar_output_mode"):
            loss.scalar_output_mode = "exclude"  # numbers that are no loss, and of no transition
        # Made when first asked for, which a compiler would see as a change; a loss may have neither.
        getattr(loss, "in_keys", None)
        with suppress(NotImplementedError):
            getattr(loss, "value_estimator", None)
        self._groups = {name: group.batch_size for name, group in groups_of(loss).items()}
        self._singles = tuple(loss._parameters)
        for name in self._groups:
            del loss._modules[name]
            loss.__dict__[name] = None
        for name in self._singles:
            del loss._parameters[name]
            loss.__dict__[name] = None
        self.module = loss

    def __call__(self, own: Weights, fixed: Weights, batch: TensorDict) -> Tensor:
        """The loss of each transition, [L, b], or [b] under vmap; one alone where the loss gives no more."""
        flat = {**own, **fixed}
        for name, size in self._groups.items():
            mine = f"{name}:"
            group = {key.removeprefix(mine): flat[key] for key in flat if key.startswith(mine)}
            setattr(self.module, name, TensorDict(group, size).unflatten_keys("."))
        for name in self._singles:
            setattr(self.module, name, own[name])
        if not torch.compiler.is_compiling():
            self.module.__dict__.pop("_cache", None)  # of what some losses make of their weights
        losses = total(self.module(batch))
        for name in (*self._groups, *self._singles):
            setattr(self.module, name, None)
        return losses


def refuse_on_policy(loss: LossModule) -> None:
    """Raises a ValueError for a loss that is right only for what the present policy has just done."""
    if isinstance(loss, A2CLoss | PPOLoss | ReinforceLoss):
        raise ValueError(
            f"{type(loss).__name__} learns from what the present policy has just done, not from a replay "
            "buffer; what fits is RolloutLearner, or cprl.learning.PPO, A2C or Reinforce in a population"
        )


def promise_targets(loss: LossModule) -> None:
    """TorchRL warns of targets that no updater of its own replaces; here `copy_to_targets` does."""
    for name in loss._has_update_associated:
        loss._has_update_associated[name] = True


def total(out: TensorDictBase) -> Tensor:
    """The sum of all entries that TorchRL calls a loss."""
    losses = [value for key, value in out.items() if key.startswith("loss")]
    summed: Tensor = sum(losses[1:], losses[0])
    return summed


def groups_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights of a loss by name, those of targets among them."""
    return {name: child for name, child in loss._modules.items() if isinstance(child, TensorDictParams)}


def targets_of(loss: LossModule) -> dict[str, TensorDictParams]:
    """The groups of weights that have targets, by name."""
    groups = groups_of(loss)
    return {name: group for name, group in groups.items() if f"target_{name}" in groups}


def _named(loss: LossModule) -> Weights:
    """All weights of a loss, the tensors themselves, by group:name; single ones by their name."""
    grouped = {
        f"{group}:{key}": value
        for group, weights in groups_of(loss).items()
        for key, value in weights.flatten_keys(".").items()
    }
    return {**grouped, **loss._parameters}


def weights_of(loss: LossModule) -> Weights:
    """Copies of all weights of a loss, those of targets among them, by name."""
    return {name: value.detach().clone() for name, value in _named(loss).items()}


class Stacked(NamedTuple):
    """A loss of many lanes, and its weights with the lanes' axis in front, by name."""

    loss: LossModule
    own: Weights
    """What learns."""
    fixed: Weights
    """What does not: the weights of targets, and buffers."""
    names: Mapping[str, str]
    """Of the network's parameters that are among the loss's weights: their names there."""


def stacked(networks: Sequence[nn.Module], make_loss: MakeLoss, *, lane_axis: bool) -> Stacked:
    """One loss for the networks of all lanes, whose weights are copied.

    Raises:
        ValueError: with a lane axis, for networks that cannot have one, for a loss with weights of its own,
            which all lanes would share, and for one that stacks networks itself, in front of the lanes.
    """
    made = [stack_lanes(networks)] if lane_axis else list(networks)
    losses = [make_loss(network) for network in made]
    if lane_axis and losses[0]._parameters:
        raise ValueError(f"all agents would share the loss's {', '.join(losses[0]._parameters)}")
    if lane_axis and any(group.batch_size for group in groups_of(losses[0]).values()):
        raise ValueError("the loss stacks networks in front of the lanes' axis")
    for loss in losses:
        promise_targets(loss)
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
