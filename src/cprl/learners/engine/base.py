"""One update of many independent learners: what it is, and the plain way.

Each lane has a loss module of TorchRL's that a recipe names. `cprl.learners.engine.compiled` runs the
lanes as one: with a lane axis in the network where it is ours, else by `torch.vmap` over the user's loss.
`ListEngine` runs a plain list of loss modules, for losses with which neither works, and as the reference.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data.replay_buffers import ReplayBuffer

from cprl.learners.engine.functional import MakeLoss, Weights, promise_targets, targets_of, total, weights_of
from cprl.networks.agent import parts_of


class Engine(Protocol):
    """One update of L lanes."""

    def update(self, buffer: ReplayBuffer) -> Tensor:
        """Samples from a `LaneStorage`, updates every lane once, and returns the loss of each, float [L]."""

    def update_from(self, batch: TensorDict) -> Tensor:
        """The same from a batch, [L, b]."""

    def copy_to_targets(self, which: Tensor) -> None:
        """Replaces the target weights of the marked lanes, bool [L], by their weights."""

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """What the networks give by their present weights: [L, k, ...] to [L, k, ...].

        Args:
            observation: of each lane.
            part: which of an agent's networks, see `cprl.networks.mlp.parts_of`; the first acts.
        """

    def network_state(self, lane: int) -> Weights:
        """Copies of the present weights of one lane, as the state dict of its acting network."""

    def weights(self, lane: int) -> Weights:
        """Copies of all weights of one lane, targets too, by the names in the loss."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next update depends on, but for the buffer; own tensors, not copies."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the update of that state was."""


class ListEngine:
    """A loss module of TorchRL's and a `torch.optim.Adam` for each lane, one after the other.

    Args:
        networks: of the lanes; they are trained in place.
        make_loss: a lane's loss out of its network.
        target_networks: where targets start; by default as copies.
        learning_rate: Adam's step size.
        adam_eps: Adam's epsilon.
        loss_share: by which each loss is multiplied.
        max_grad_norm: to which each lane's gradient is shortened, if it is longer; None for never.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        *,
        target_networks: Sequence[nn.Module] | None = None,
        learning_rate: float,
        adam_eps: float = 1e-8,
        loss_share: float = 1.0,
        max_grad_norm: float | None = None,
    ) -> None:
        self._parts = [list(parts_of(network).values()) for network in networks]
        self._max_norm = max_grad_norm
        self.losses = [make_loss(network) for network in networks]
        for loss in self.losses:
            promise_targets(loss)
        self._share = loss_share
        for loss, network in zip(self.losses, target_networks or (), strict=False):
            for name, values in targets_of(make_loss(network)).items():
                getattr(loss, f"target_{name}").data.copy_(values.data)
        self._adams = [
            torch.optim.Adam(loss.parameters(), lr=learning_rate, eps=adam_eps, fused=True)
            for loss in self.losses
        ]

    def update(self, buffer: ReplayBuffer) -> Tensor:
        """See `Engine`."""
        return self.update_from(buffer.sample())

    def update_from(self, batch: TensorDict) -> Tensor:
        """See `Engine`."""
        return torch.stack([self._learn(lane, batch[lane]) for lane in range(len(self.losses))])

    def _learn(self, lane: int, batch: TensorDict) -> Tensor:
        loss = total(self.losses[lane](batch)).mean() * self._share
        self._adams[lane].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._max_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.losses[lane].parameters(), self._max_norm)
        self._adams[lane].step()
        return loss.detach()

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """See `Engine`."""
        return torch.stack([own[part](seen) for own, seen in zip(self._parts, observation, strict=True)])

    def copy_to_targets(self, which: Tensor) -> None:
        """See `Engine`."""
        for lane in which.nonzero().flatten().tolist():
            loss = self.losses[lane]
            for name, values in targets_of(loss).items():
                getattr(loss, f"target_{name}").data.copy_(values.data)

    def network_state(self, lane: int) -> Weights:
        """See `Engine`."""
        return {name: value.detach().clone() for name, value in self._parts[lane][0].state_dict().items()}

    def weights(self, lane: int) -> Weights:
        """See `Engine`."""
        return weights_of(self.losses[lane])

    def state_dict(self) -> dict[str, Any]:
        """See `Engine`."""
        return {
            "losses": [dict(loss.state_dict()) for loss in self.losses],
            "adams": [adam.state_dict() for adam in self._adams],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Engine`."""
        for loss, own in zip(self.losses, state["losses"], strict=True):
            loss.load_state_dict(own)
        for adam, own in zip(self._adams, state["adams"], strict=True):
            adam.load_state_dict(own)
