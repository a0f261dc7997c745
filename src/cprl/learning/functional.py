"""Loss modules of TorchRL's as functions of their weights, and their weights by name."""

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.acting.lanes import LaneQNetwork

MakeLoss = Callable[[nn.Module], LossModule]
"""A per-agent loss out of a network; see `cprl.learning.dqn.dqn_loss`."""

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
        loss.in_keys  # noqa: B018  (made when first asked for, which a compiler would see as a change)
        loss.value_estimator  # noqa: B018
        self._names = tuple(params_of(loss, targets=True))
        for name in self._names:
            del loss._modules[name]
            loss.__dict__[name] = None
        self.module = loss

    def __call__(self, own: Weights, targets: Weights, batch: TensorDict) -> Tensor:
        """The loss of each transition, [L, b], or [b] under vmap."""
        flat = {**own, **targets}
        for name in self._names:
            mine = f"{name}:"
            group = {key.removeprefix(mine): flat[key] for key in flat if key.startswith(mine)}
            setattr(self.module, name, TensorDict(group, []).unflatten_keys("."))
        losses = total(self.module(batch))
        for name in self._names:
            setattr(self.module, name, None)
        return losses


def promise_targets(loss: LossModule) -> None:
    """TorchRL warns of targets that no updater of its own replaces; here `copy_to_targets` does."""
    for name in loss._has_update_associated:
        loss._has_update_associated[name] = True


def total(out: TensorDictBase) -> Tensor:
    """The sum of all entries that TorchRL calls a loss."""
    losses = [value for key, value in out.items() if key.startswith("loss")]
    summed: Tensor = sum(losses[1:], losses[0])
    return summed


def params_of(loss: LossModule, *, targets: bool = False) -> dict[str, TensorDictParams]:
    """The groups of weights of a loss by name, without those of targets unless asked for."""
    groups = {name: child for name, child in loss._modules.items() if isinstance(child, TensorDictParams)}
    return {name: group for name, group in groups.items() if targets or not name.startswith("target_")}


def flat(groups: dict[str, TensorDictParams]) -> Weights:
    """Copies of all weights of some groups, by group:name."""
    return {
        f"{name}:{key}": value.detach().clone()
        for name, group in groups.items()
        for key, value in group.flatten_keys(".").items()
    }


def weights_of(network: nn.Module, own: Weights) -> Weights:
    """The network's weights by its own names, the same tensors as in the loss."""
    found = {}
    for name, _ in network.named_parameters():
        matching = [value for key, value in own.items() if key.endswith(f".{name}")]
        if len(matching) != 1:
            raise ValueError(f"{len(matching)} weights of the loss are called {name}; one is wanted")
        found[name] = matching[0]
    return found


def stacked(
    networks: Sequence[nn.Module], make_loss: MakeLoss, *, lane_axis: bool
) -> tuple[LossModule, Weights]:
    """A loss, and copies of its weights with the lanes' axis in front, by group:name."""
    if lane_axis:
        losses = [make_loss(LaneQNetwork(networks))]  # type: ignore[arg-type]
    else:
        losses = [make_loss(network) for network in networks]
    for loss in losses:
        promise_targets(loss)
    each = [flat(params_of(loss, targets=True)) for loss in losses]
    if lane_axis:
        return losses[0], each[0]
    return losses[0], {name: torch.stack([one[name] for one in each]) for name in each[0]}
