"""The interface of engines, which update many independent learners at once, and the plain list of losses.

Each lane has a TorchRL loss module. `cprl.learners.engine.compiled` updates all lanes together: it stacks
networks along a lane axis if it can, else it applies `torch.vmap` to the loss. `ListEngine` runs a plain list
of loss modules. It is the reference, and the fallback for losses that work with neither.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.learners.buffer.sampler import LaneBuffer
from cprl.learners.engine.functional import MakeLoss, Weights, own_targets, targets_of, total, weights_of
from cprl.learners.engine.optimizers import torch_optimizer
from cprl.learners.settings import Optimizer
from cprl.networks.agent import parts_of
from cprl.networks.finite import all_finite


class Engine(Protocol):
    """Updates L lanes at once."""

    def update(self, buffer: LaneBuffer) -> Tensor:
        """Samples from a buffer, updates every lane once and returns their losses, float [L]."""

    def update_from(self, batch: TensorDict) -> Tensor:
        """Updates every lane once from a batch, [L, b], and returns their losses, float [L]."""

    def copy_to_targets(self, which: Tensor) -> None:
        """Copies the weights of the marked lanes, bool [L], to their targets."""

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """The outputs of the networks with their current weights: [L, k, ...] to [L, k, ...]; of recurrent
        ones also their states.

        Args:
            observation: k observations of each lane.
            recurrent: what recurrent networks read besides, likewise: see `cprl.networks.recurrent`.
            part: which of an agent's networks, see `cprl.networks.agent.parts_of`; the first one acts.
        """

    def first(self, lanes: int) -> Callable[..., Any]:
        """`outputs` of the first l lanes alone: [l, k, ...] to [l, k, ...], with their weights as they are at
        each call; takes the shorter the fewer they are."""

    def network_state(self, lane: int) -> Weights:
        """Copies of the current weights of one lane, as the state dict of its acting network."""

    def weights(self, lane: int) -> Weights:
        """Copies of all weights of one lane, including targets, by their names in the loss."""

    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each lane are finite, bool [L] on the CPU."""

    def state_dict(self) -> dict[str, Any]:
        """The full state except the buffer; the tensors themselves, not copies."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""


class ListEngine:
    """A TorchRL loss module and a `torch.optim` optimiser for each lane; lanes are updated one by one.

    Args:
        networks: the lanes' networks; they are trained in place.
        make_loss: makes a lane's loss from its network.
        target_networks: networks with the initial target weights; by default targets start as copies.
        optimizer: the name of the optimiser of `torch.optim`.
        learning_rate: its step size.
        adam_eps: its epsilon, if it has one.
        tau: the fraction by which targets move towards the weights after each update; None for hard updates
            by `copy_to_targets` alone.
        loss_share: a factor of each loss.
        max_grad_norm: the norm to which each lane's gradient is clipped; None for no clipping.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        *,
        target_networks: Sequence[nn.Module] | None = None,
        optimizer: Optimizer = "adam",
        learning_rate: float,
        adam_eps: float = 1e-8,
        loss_share: float = 1.0,
        max_grad_norm: float | None = None,
        tau: float | None = None,
    ) -> None:
        self._tau = tau
        self._parts = [list(parts_of(network).values()) for network in networks]
        self._max_norm = max_grad_norm
        self.losses = [make_loss(network) for network in networks]
        for loss in self.losses:
            own_targets(loss)
        self._share = loss_share
        for loss, network in zip(self.losses, target_networks or (), strict=False):
            for name, values in targets_of(make_loss(network)).items():
                getattr(loss, f"target_{name}").data.copy_(values.data)
        self._optimizers = [
            torch_optimizer(optimizer, loss.parameters(), learning_rate=learning_rate, eps=adam_eps)
            for loss in self.losses
        ]

    def update(self, buffer: LaneBuffer) -> Tensor:
        """See `Engine`."""
        return self.update_from(buffer.sample())

    def update_from(self, batch: TensorDict) -> Tensor:
        """See `Engine`."""
        return torch.stack([self._learn(lane, batch[lane]) for lane in range(len(self.losses))])

    def _learn(self, lane: int, batch: TensorDict) -> Tensor:
        loss = total(self.losses[lane](batch), self.losses[lane]).mean() * self._share
        self._optimizers[lane].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._max_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.losses[lane].parameters(), self._max_norm)
        self._optimizers[lane].step()
        if self._tau is not None:
            for weight, target in _with_targets(self.losses[lane]):
                target.data.lerp_(weight.data, self._tau)
        return loss.detach()

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """See `Engine`."""
        return stacked_outputs([own[part] for own in self._parts], observation, *recurrent)

    def first(self, lanes: int) -> Callable[..., Any]:
        """See `Engine`."""
        return partial(stacked_outputs, [own[0] for own in self._parts[:lanes]])

    def copy_to_targets(self, which: Tensor) -> None:
        """See `Engine`."""
        for lane in which.nonzero().flatten().tolist():
            for weight, target in _with_targets(self.losses[lane]):
                target.data.copy_(weight.data)

    def network_state(self, lane: int) -> Weights:
        """See `Engine`."""
        return {name: value.detach().clone() for name, value in self._parts[lane][0].state_dict().items()}

    def weights(self, lane: int) -> Weights:
        """See `Engine`."""
        return weights_of(self.losses[lane])

    def finite(self) -> Tensor:
        """See `Engine`."""
        pairs = zip(self.losses, self._optimizers, strict=True)
        return torch.tensor([is_finite(loss, optimizer) for loss, optimizer in pairs])

    def state_dict(self) -> dict[str, Any]:
        """See `Engine`."""
        return {
            "losses": [dict(loss.state_dict()) for loss in self.losses],
            "adams": [optimizer.state_dict() for optimizer in self._optimizers],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Engine`."""
        for loss, own in zip(self.losses, state["losses"], strict=True):
            loss.load_state_dict(own)
        for optimizer, own in zip(self._optimizers, state["adams"], strict=True):
            optimizer.load_state_dict(own)


def stacked_outputs(networks: Sequence[nn.Module], *inputs: Tensor) -> Any:
    """The outputs of several networks: [l, k, ...] to [l, k, ...]; of recurrent ones also their states."""
    given = [own(*seen) for own, *seen in zip(networks, *inputs, strict=True)]
    if isinstance(given[0], tuple):
        return tuple(torch.stack(each) for each in zip(*given, strict=True))
    return torch.stack(given)


def is_finite(loss: LossModule, optimizer: torch.optim.Optimizer) -> bool:
    """Whether all weights of a loss, including targets, and its optimiser's state are finite."""
    kept = [value for state in optimizer.state.values() for value in state.values()]
    weights: list[Any] = list(loss.state_dict().values())
    return all_finite(value for value in (*weights, *kept) if isinstance(value, Tensor))


def _with_targets(loss: LossModule) -> list[tuple[TensorDictParams, TensorDictParams]]:
    """The groups of weights of a loss that have targets, each paired with its targets."""
    return [(values, getattr(loss, f"target_{name}")) for name, values in targets_of(loss).items()]
