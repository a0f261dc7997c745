"""FunctionalUpdate: one update of many independent learners as one compiled step."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data.replay_buffers import ReplayBuffer

from cprl.acting.compiling import Compiled
from cprl.acting.lanes import LaneQNetwork
from cprl.learning.functional import FunctionalLoss, MakeLoss, Weights, stacked, weights_of
from cprl.learning.storage import FIELDS, LaneStorage, gather

BETA_1, BETA_2 = 0.9, 0.999
"""Adam's decay rates (Kingma and Ba 2015, the defaults of torch)."""


class FunctionalUpdate:
    """All lanes at once: gathering, TorchRL's loss, its gradient and Adam as one step, compiled if wanted.

    Where a loss sees the lane axis it stays ordinary: it is asked for one loss for each transition, which
    is averaged over the batch and summed over lanes, so that each lane's gradient is exactly its own.

    Args:
        networks: of the lanes, of one form; their weights are copied.
        make_loss: a lane's loss out of its network.
        target_networks: where targets start; by default as copies.
        learning_rate: Adam's step size.
        adam_eps: Adam's epsilon.
        loss_share: by which each loss is multiplied.
        lane_axis: whether the networks are stacked into a `LaneQNetwork`, else the loss is vmapped.
        compile: whether the step is compiled by torch; where that fails a warning says so once, and the
            step runs as it is.
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
        lane_axis: bool,
        compile: bool = True,
    ) -> None:
        self._network = LaneQNetwork(networks) if lane_axis else deepcopy(networks[0])  # type: ignore[arg-type]
        loss, weights = stacked(networks, make_loss, lane_axis=lane_axis)
        self.own = {name: value for name, value in weights.items() if not name.startswith("target_")}
        self.targets = {name: value for name, value in weights.items() if name.startswith("target_")}
        if target_networks is not None:
            _, others = stacked(target_networks, make_loss, lane_axis=lane_axis)
            self.targets = {name: others[name.removeprefix("target_")] for name in self.targets}
        self._mean = {name: torch.zeros_like(value) for name, value in self.own.items()}
        self._square = {name: torch.zeros_like(value) for name, value in self.own.items()}
        self.loss = FunctionalLoss(loss)
        self._shared = weights_of(self._network, self.own)
        if lane_axis:  # acts by the very tensors that learning changes
            for name, parameter in self._network.named_parameters():
                parameter.requires_grad_(False).data = self._shared[name]
        self._names, self._target_names = tuple(self.own), tuple(self.targets)
        groups = self.own, self.targets, self._mean, self._square
        self._tensors = [list(group.values()) for group in groups]
        self.steps = 0
        self._learning_rate, self._adam_eps, self._share = learning_rate, adam_eps, loss_share
        self._vmapped = not lane_axis
        self._is_warm = not compile
        self._compiled = Compiled(FunctionalUpdate._step, what="updates run", enabled=compile)

    def learn(self, buffer: ReplayBuffer) -> Tensor:
        """See `Update`."""
        storage: LaneStorage = buffer.storage
        index = buffer.sampler.draw(storage)
        self.steps += 1
        if not self._is_warm:
            # TensorDict fills a table of its own at first use; compiled code would fill it again each time.
            self._gradients(self._tensors[0], self._tensors[1], gather(storage.fields, index, storage.rows))
            self._is_warm = True
        arguments = [*storage.fields.values()], storage.rows, index, *self._adam_scalars()
        losses: Tensor = self._compiled(_form(storage, index), self, *arguments, self._tensors)
        return losses

    def _adam_scalars(self) -> tuple[Tensor, Tensor]:
        """Adam's two bias corrections, computed here once instead of for every weight in the graph."""
        kind = next(iter(self.own.values()))
        size = self._learning_rate / (1 - BETA_1**self.steps)
        scale = (1 - BETA_2**self.steps) ** -0.5
        return kind.new_tensor(size), kind.new_tensor(scale)

    def _step(
        self,
        fields: list[Tensor],
        rows: int,
        index: Tensor,
        step_size: Tensor,
        scale: Tensor,
        tensors: list[list[Tensor]],
    ) -> Tensor:
        """One step. Tensors come in lists: compiled code finds each of a dict by counting through its keys,
        which takes longer than all that one lane has to compute."""
        own, targets, means, squares = tensors
        batch = gather(dict(zip(FIELDS, fields, strict=True)), index, rows)
        gradients, losses = self._gradients(own, targets, batch)
        for weight, slope, mean, square in zip(own, gradients, means, squares, strict=True):
            mean.mul_(BETA_1).add_(slope, alpha=1 - BETA_1)
            square.mul_(BETA_2).addcmul_(slope, slope, value=1 - BETA_2)
            weight.sub_(step_size * mean / (square.sqrt() * scale + self._adam_eps))
        return losses

    def _gradients(
        self, own: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[list[Tensor], Tensor]:
        """By each of the own weights, and each lane's loss."""
        gradient = torch.func.grad(self._lane_losses, has_aux=True)
        if self._vmapped:
            gradient = torch.vmap(gradient)
        gradients, losses = gradient(own, targets, batch)
        return gradients, losses

    def _lane_losses(
        self, own: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """The sum over lanes, for its gradient, and each lane's loss; under vmap there is one lane."""
        by_name = (
            dict(zip(self._names, own, strict=True)),
            dict(zip(self._target_names, targets, strict=True)),
        )
        losses = self.loss(*by_name, batch).mean(-1) * self._share
        return losses.sum(), losses

    def outputs(self, observation: Tensor) -> Tensor:
        """See `Update`."""

        if not self._vmapped:
            given: Tensor = self._network(observation)
            return given

        def output(weights: Weights, seen: Tensor) -> Tensor:
            one: Tensor = torch.func.functional_call(self._network, weights, (seen,))
            return one

        return torch.vmap(output)(self._shared, observation)

    def copy_to_targets(self, which: Tensor) -> None:
        """See `Update`."""
        for name, target in self.targets.items():
            target[which] = self.own[name.removeprefix("target_")][which]

    def network_state(self, lane: int) -> Weights:
        """See `Update`."""
        if isinstance(self._network, LaneQNetwork):
            return self._network.lane_state(lane)
        return {name: value[lane].clone() for name, value in self._shared.items()}

    def weights(self, lane: int) -> Weights:
        """See `Update`."""
        return {name: value[lane].clone() for name, value in {**self.own, **self.targets}.items()}

    def state_dict(self) -> dict[str, Any]:
        """See `Update`."""
        return {
            "own": self.own,
            "targets": self.targets,
            "mean": self._mean,
            "square": self._square,
            "steps": self.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Update`; copies into the tensors that a compiled step knows."""
        groups = {"own": self.own, "targets": self.targets, "mean": self._mean, "square": self._square}
        for group, tensors in groups.items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; {sorted(tensors)} is wanted"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])
        self.steps = int(state["steps"])


def _form(storage: LaneStorage, index: Tensor) -> tuple[object, ...]:
    """What the compiled step takes for granted of its arguments; its own tensors never change their form."""
    return storage.rows, index.shape, *((field.shape, field.dtype) for field in storage.fields.values())
