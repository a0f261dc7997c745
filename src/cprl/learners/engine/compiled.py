"""FunctionalEngine: updates many independent learners in one compiled step."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cprl.learners.buffer.gather import FIELDS, Horizon, sampled
from cprl.learners.buffer.sampler import LaneBuffer
from cprl.learners.buffer.storage import LaneStorage
from cprl.learners.engine.functional import FunctionalLoss, MakeLoss, Weights, stacked, vmapped
from cprl.learners.engine.optimizers import BETA_1, BETA_2, WITH_MEAN, WITH_SQUARE, change_weights, shortened
from cprl.learners.settings import Optimizer
from cprl.networks.agent import parts_of
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.system.compiling import Compiled


class FunctionalEngine:
    """Updates all lanes in one step: gathering a batch, TorchRL's loss, its gradient and the optimiser.

    With a lane axis the loss returns one number per transition. These are averaged over the batch and summed
    over lanes, so that each lane's gradient depends on its own loss alone.

    Args:
        networks: the lanes' networks, of one architecture; their weights are copied.
        make_loss: makes a lane's loss from its network.
        target_networks: networks with the initial target weights; by default targets start as copies.
        optimizer: the name of the optimiser of `torch.optim`.
        learning_rate: its step size.
        adam_eps: its epsilon, if it has one.
        loss_share: a factor of each loss.
        max_grad_norm: the norm to which each lane's gradient is clipped; None for no clipping.
        tau: the fraction by which targets move towards the weights after each update; None for hard updates
            by `copy_to_targets` alone.
        lane_axis: whether the networks are stacked along a lane axis; else the loss is vmapped.
        flat: with a lane axis, whether the loss gets the transitions of all lanes flat, [L x b].
        compile: whether torch compiles the step. If compilation fails, the engine warns once and runs the
            step uncompiled.
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
        lane_axis: bool,
        flat: bool = False,
        compile: bool = True,
    ) -> None:
        loss, self.own, self.fixed, names = stacked(networks, make_loss, lane_axis=lane_axis)
        if target_networks is not None:
            others = stacked(target_networks, make_loss, lane_axis=lane_axis).own
            self.fixed |= {name: others[_source(name)] for name in self.fixed if _source(name) in others}
        self._mean, self._square = (
            {name: torch.zeros_like(value) for name, value in self.own.items() if optimizer in kept_by}
            for kept_by in (WITH_MEAN, WITH_SQUARE)
        )
        self.loss = FunctionalLoss(loss)
        self._one, network = networks[0], stack_lanes(networks) if lane_axis else deepcopy(networks[0])
        self._parts = list(parts_of(network).items())
        self._shared = {name: self.own[key] for name, key in names.items() if key in self.own}
        if lane_axis:  # acts with the same tensors that updates change
            for name, parameter in network.named_parameters():
                if name in self._shared:
                    parameter.requires_grad_(False).data = self._shared[name]
        self._names, self._fixed_names = tuple(self.own), tuple(self.fixed)
        groups = self.own, self.fixed, self._mean, self._square
        self._tensors = [list(group.values()) for group in groups]
        self.steps = 0
        kind = next(iter(self.own.values()))
        self._scalars = kind.new_zeros(()), kind.new_zeros(())
        self._optimizer, self._tau = optimizer, tau
        self._learning_rate, self._adam_eps, self._share = learning_rate, adam_eps, loss_share
        self._max_norm = max_grad_norm
        self._vmapped, self._flat = not lane_axis, flat
        self._is_warm = not compile
        self._compiled = Compiled(FunctionalEngine._step, what="updates run", changes=(7,), enabled=compile)
        self._compiled_on = Compiled(
            FunctionalEngine._step_on, what="updates run", changes=(6,), enabled=compile
        )

    def update(self, buffer: LaneBuffer) -> Tensor:
        """See `Engine`."""
        storage: LaneStorage = buffer.storage
        if buffer.has_transforms or storage.sequence_steps > 1:
            return self.update_from(buffer.sample())
        index = buffer.sampler.draw(storage)
        self.steps += 1
        noise = None if buffer.noise is None else buffer.noise.next()
        if not self._is_warm:
            self._warm_up(sampled(storage.fields, index, storage.rows, storage.horizon, noise))
        fields, form = [*storage.fields.values()], _form(storage, index, noise)
        arguments = fields, storage.rows, storage.horizon, index, *self._adam_scalars(), self._tensors, noise
        losses: Tensor = self._compiled(form, self, *arguments)
        return losses

    def update_from(self, batch: TensorDict) -> Tensor:
        """See `Engine`."""
        self.steps += 1
        if not self._is_warm:
            self._warm_up(batch.clone())
        entries = sorted(batch.items(True, True), key=lambda entry: str(entry[0]))
        names, columns = tuple(name for name, _ in entries), [column for _, column in entries]
        form = names, batch.batch_size, *((column.shape, column.dtype) for column in columns)
        arguments = names, tuple(batch.batch_size), columns, *self._adam_scalars()
        losses: Tensor = self._compiled_on(form, self, *arguments, self._tensors)
        return losses

    def _warm_up(self, batch: TensorDict) -> None:
        """Calls TensorDict once before compilation: it fills a cache at first use, which compiled code would
        refill at each call."""
        self._gradients(self._tensors[0], self._tensors[1], batch)
        self._is_warm = True

    def _adam_scalars(self) -> tuple[Tensor, Tensor]:
        """Adam's two bias corrections, computed once here instead of once per weight in the graph."""
        size, scale = self._scalars
        size.fill_(self._learning_rate / (1 - BETA_1**self.steps))
        scale.fill_((1 - BETA_2**self.steps) ** -0.5)
        return size, scale

    def _step(
        self,
        fields: list[Tensor],
        rows: int,
        horizon: Horizon | None,
        index: Tensor,
        step_size: Tensor,
        scale: Tensor,
        tensors: list[list[Tensor]],
        noise: Tensor | None,
    ) -> Tensor:
        """One step. Tensors are passed in lists: the guards of compiled code find a dict's entry by counting
        through its keys, which takes longer than all computation of one lane."""
        batch = sampled(dict(zip(FIELDS, fields, strict=True)), index, rows, horizon, noise)
        return self._change(batch, step_size, scale, tensors)

    def _step_on(
        self,
        names: tuple[Any, ...],
        size: tuple[int, ...],
        columns: list[Tensor],
        step_size: Tensor,
        scale: Tensor,
        tensors: list[list[Tensor]],
    ) -> Tensor:
        """One step on a batch; its entries are in the order of their names."""
        batch = TensorDict({}, batch_size=size)
        for name, column in zip(names, columns, strict=True):
            batch.set(name, column)
        return self._change(batch, step_size, scale, tensors)

    def _change(
        self, batch: TensorDict, step_size: Tensor, scale: Tensor, tensors: list[list[Tensor]]
    ) -> Tensor:
        """Computes gradients, changes the weights in place and returns each lane's loss."""
        own, fixed, means, squares = tensors
        gradients, losses = self._gradients(own, fixed, batch)
        if self._max_norm is not None:
            gradients = shortened(gradients, self._max_norm)
        change_weights(
            self._optimizer,
            own,
            gradients,
            means,
            squares,
            step_size=step_size,
            scale=scale,
            learning_rate=self._learning_rate,
            eps=self._adam_eps,
        )
        if self._tau is not None:
            for name, target in zip(self._fixed_names, fixed, strict=True):
                if _source(name) in self._names:
                    target.lerp_(own[self._names.index(_source(name))], self._tau)
        return losses

    def _gradients(
        self, own: list[Tensor], fixed: list[Tensor], batch: TensorDict
    ) -> tuple[list[Tensor], Tensor]:
        """The gradients of the trained weights, and each lane's loss."""
        gradient = torch.func.grad(self._lane_losses, has_aux=True)
        if self._vmapped:
            gradient = torch.vmap(gradient)
        gradients, losses = gradient(own, fixed, batch)
        return gradients, losses

    def _lane_losses(
        self, own: list[Tensor], fixed: list[Tensor], batch: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """The sum of the losses of all lanes, to differentiate, and each lane's loss; under vmap there is one
        lane."""
        by_name = (
            dict(zip(self._names, own, strict=True)),
            dict(zip(self._fixed_names, fixed, strict=True)),
        )
        each = self.loss(*by_name, batch.reshape(-1) if self._flat else batch)
        if self._flat:
            each = each.reshape(batch.batch_size)
        losses = (each.mean() if self._vmapped else each.flatten(1).mean(-1)) * self._share
        return losses.sum(), losses

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """See `Engine`."""
        name, network = self._parts[part]
        if not self._vmapped:
            return network(observation, *recurrent)
        return vmapped(network, self._of_part(name), observation, *recurrent)

    def first(self, lanes: int) -> Callable[..., Any]:
        """See `Engine`."""
        name, network = self._parts[0]
        if self._vmapped:
            weights = {key: value[:lanes] for key, value in self._of_part(name).items()}
            return partial(vmapped, network, weights)
        fewer, *_ = parts_of(stack_lanes([self._one] * lanes)).values()
        for own, of_all in zip(fewer.parameters(), network.parameters(), strict=True):
            own.requires_grad_(False).data = of_all.data[:lanes]  # the same memory, which updates change
        return fewer

    def _of_part(self, name: str) -> Weights:
        """The weights of one of an agent's networks, by their names in that network."""
        mine = f"{name}." if name else ""
        return {key.removeprefix(mine): value for key, value in self._shared.items() if key.startswith(mine)}

    def copy_to_targets(self, which: Tensor) -> None:
        """See `Engine`."""
        for name, fixed in self.fixed.items():
            if _source(name) in self.own:
                fixed[which] = self.own[_source(name)][which]

    def network_state(self, lane: int) -> Weights:
        """See `Engine`."""
        name, network = self._parts[0]
        if not self._vmapped:
            return lane_state(network, lane)
        buffers = {key: value.clone() for key, value in network.named_buffers()}
        return {**{key: value[lane].clone() for key, value in self._of_part(name).items()}, **buffers}

    def weights(self, lane: int) -> Weights:
        """See `Engine`."""
        everything = {**self.own, **self.fixed}
        return {
            name: (value[lane] if self._vmapped or _source(name) in self.own else value).clone()
            for name, value in everything.items()
        }

    def finite(self) -> Tensor:
        """See `Engine`."""
        lanes, every = len(self._tensors[0][0]), [value for group in self._tensors for value in group]
        return finite_lanes([value for value in every if value.ndim and len(value) == lanes])

    def state_dict(self) -> dict[str, Any]:
        """See `Engine`."""
        return {
            "own": self.own,
            "targets": self.fixed,
            "mean": self._mean,
            "square": self._square,
            "steps": self.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Engine`; copies into the existing tensors, which the compiled step refers to."""
        groups = {"own": self.own, "targets": self.fixed, "mean": self._mean, "square": self._square}
        for group, tensors in groups.items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; allowed: {sorted(tensors)}"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])
        self.steps = int(state["steps"])


def _source(name: str) -> str:
    """The name of the weight that a target copies."""
    return name.removeprefix("target_")


def _form(storage: LaneStorage, index: Tensor, noise: Tensor | None) -> tuple[object, ...]:
    """The shapes and dtypes for which a step is compiled; the engine's own tensors never change theirs."""
    sizes = storage.rows, storage.horizon, index.shape, None if noise is None else noise.shape
    return (*sizes, *((field.shape, field.dtype) for field in storage.fields.values()))
