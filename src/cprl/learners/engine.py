"""Engines: one update step for many independent learners, each with a TorchRL loss module.

`FunctionalEngine` updates all lanes together in one compiled step: it stacks networks along a lane axis if it
can, else it applies `torch.vmap` to the loss. `ListEngine` runs a plain list of loss modules. It is the
reference, and the fallback for losses that work with neither. `SharedEngine` is for agents that share a
network. `cprl.learners.trial` chooses.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any, Final, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.learners.ring import FIELDS, Horizon, Ring, sampled
from cprl.learners.settings import Optimizer
from cprl.networks.agent import parts_of
from cprl.networks.finite import all_finite, finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.system.compat import forget_cached_weights, promise_targets, refuse_updaters, updated_weights
from cprl.system.compiling import Compiled

MakeLoss = Callable[[nn.Module], LossModule]
"""Makes one agent's loss from its network."""

Weights = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class UpdateRule:
    """How a gradient changes weights: the optimiser, clipping, and how targets follow."""

    optimizer: Optimizer = "adam"
    """The name of the optimiser of `torch.optim`."""
    learning_rate: float
    adam_eps: float = 1e-8
    """The optimiser's epsilon, if it has one."""
    loss_share: float = 1.0
    """A factor of each loss."""
    max_grad_norm: float | None = None
    """The norm to which each lane's gradient is clipped; None for no clipping."""
    tau: float | None = None
    """The fraction by which targets move towards the weights after each update; None for hard updates by
    `copy_to_targets` alone."""

    @classmethod
    def of(cls, settings: Any, *, loss_share: float = 1.0) -> "UpdateRule":
        """That of the hyperparameters of an agent, as far as they say."""
        names = ("optimizer", "learning_rate", "adam_eps", "max_grad_norm", "tau")
        said = {name: getattr(settings, name) for name in names if hasattr(settings, name)}
        return cls(**said, loss_share=loss_share)


COMPILED_STEPS: Final = 16
"""The longest sequences whose update is compiled: torch unrolls their turns, and takes seconds for each."""

_NO_UPDATER: Final = (
    "a SoftUpdate or HardUpdate was built on the {}; the engine has weights of its own, which it would not "
    "change: leave it out, and set tau or target_every_episodes"
)


class FunctionalLoss:
    """A TorchRL loss module as a function of its weights that returns one loss per transition.

    TorchRL stores the weights of a loss in `TensorDictParams` of the module. During a call plain TensorDicts
    replace them, which both `torch.func` and `torch.compile` accept.
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


def own_targets(loss: LossModule) -> None:
    """Marks the targets of a loss as updated, by the engine, so that TorchRL does not warn."""
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
    params: Weights
    """The trained weights."""
    targets: Weights
    """Tensors that gradients do not change: target weights and buffers."""
    names: Mapping[str, str]
    """The names in the loss of those parameters of the network that are among its weights."""


def stacked(networks: Sequence[nn.Module], make_loss: MakeLoss, *, lane_axis: bool) -> Stacked:
    """One loss for the networks of all lanes; the weights are copied."""
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

    def output(of_lane: Weights, *seen: Tensor) -> Any:
        return torch.func.functional_call(network, of_lane, seen)

    return torch.vmap(output)(weights, *inputs)


BETA_1, BETA_2 = 0.9, 0.999
"""Adam's decay rates (Kingma and Ba 2015, torch's defaults)."""
ADAMW_DECAY: Final = 0.01
"""AdamW's weight decay (Loshchilov and Hutter 2019, torch's default)."""
RMSPROP_ALPHAS: Final = {"rmsprop": 0.99, "keras_rmsprop": 0.9}
"""RMSprop's decay rate: torch's default, and that of Keras 2.2.4."""

WITH_MEAN: Final = ("adam", "adamw")
"""Optimisers with a running mean of gradients."""
WITH_SQUARE: Final = ("adam", "adamw", *RMSPROP_ALPHAS)
"""Optimisers with a running mean of squared gradients."""


def torch_optimizer(
    rule: UpdateRule, parameters: Iterable[Tensor], *, fused: bool | None = True
) -> torch.optim.Optimizer:
    """The optimiser of one lane; `fused` where torch has such a form of it, None for torch's default."""
    name, rate, eps = rule.optimizer, rule.learning_rate, rule.adam_eps
    if name in RMSPROP_ALPHAS:
        return torch.optim.RMSprop(parameters, lr=rate, eps=eps, alpha=RMSPROP_ALPHAS[name])
    if name == "sgd":
        return torch.optim.SGD(parameters, lr=rate, fused=fused)
    kind = torch.optim.Adam if name == "adam" else torch.optim.AdamW
    return kind(parameters, lr=rate, eps=eps, fused=fused)


def change_weights(
    rule: UpdateRule,
    weights: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    step_size: Tensor,
    scale: Tensor,
) -> None:
    """One step of all lanes, in place.

    Args:
        weights: [L, ...] each.
        gradients: of each weight; clipped by their norm if the rule says so.
        means: running means of gradients; empty if the optimiser has none.
        squares: running means of squared gradients, likewise.
        step_size: Adam's learning rate with bias correction.
        scale: the bias correction of the root of Adam's `squares`.
    """
    if rule.max_grad_norm is not None:
        gradients = shortened(gradients, rule.max_grad_norm)
    name, rate, eps = rule.optimizer, rule.learning_rate, rule.adam_eps
    if name in WITH_MEAN:
        for weight, slope, mean, square in zip(weights, gradients, means, squares, strict=True):
            if name == "adamw":
                weight.mul_(1 - rate * ADAMW_DECAY)
            mean.mul_(BETA_1).add_(slope, alpha=1 - BETA_1)
            square.mul_(BETA_2).addcmul_(slope, slope, value=1 - BETA_2)
            weight.sub_(step_size * mean / (square.sqrt() * scale + eps))
    elif name in RMSPROP_ALPHAS:
        alpha = RMSPROP_ALPHAS[name]
        for weight, slope, square in zip(weights, gradients, squares, strict=True):
            square.mul_(alpha).addcmul_(slope, slope, value=1 - alpha)
            weight.sub_(rate * slope / (square.sqrt() + eps))
    else:
        for weight, slope in zip(weights, gradients, strict=True):
            weight.sub_(slope, alpha=rate)


def shortened(gradients: Sequence[Tensor], longest: float) -> list[Tensor]:
    """Gradients [L, ...] of all weights, scaled down for lanes whose gradient norm exceeds `longest`."""
    squares = [slope.reshape(len(slope), -1).square().sum(1) for slope in gradients]
    norms = torch.stack(squares).sum(0).sqrt()
    scales = (longest / (norms + 1e-6)).clamp(max=1.0)
    return [slope * scales.reshape(-1, *[1] * (slope.ndim - 1)) for slope in gradients]


class Engine(ABC):
    """Updates L lanes at once."""

    def update(self, ring: Ring) -> Tensor:
        """Samples from a ring, updates every lane once and returns their losses, float [L]."""
        return self.update_from(ring.sample())

    @abstractmethod
    def update_from(self, batch: TensorDict) -> Tensor:
        """Updates every lane once from a batch, [L, b], and returns their losses, float [L]."""

    @abstractmethod
    def copy_to_targets(self, which: Tensor) -> None:
        """Copies the weights of the marked lanes, bool [L], to their targets."""

    @abstractmethod
    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """The outputs of the networks with their current weights: [L, k, ...] to [L, k, ...]; of recurrent
        ones also their states.

        Args:
            observation: k observations of each lane.
            recurrent: what recurrent networks read besides, likewise: see `cprl.networks.recurrent`.
            part: which of an agent's networks, see `cprl.networks.agent.parts_of`; the first one acts.
        """

    @abstractmethod
    def network_state(self, lane: int) -> Weights:
        """Copies of the current weights of one lane, as the state dict of its acting network."""

    @abstractmethod
    def weights(self, lane: int) -> Weights:
        """Copies of all weights of one lane, including targets, by their names in the loss."""

    @abstractmethod
    def finite(self) -> Tensor:
        """Whether the weights, targets and optimiser state of each lane are finite, bool [L] on the CPU."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """The full state except the buffer; the tensors themselves, not copies."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""


class ListEngine(Engine):
    """A TorchRL loss module and a `torch.optim` optimiser for each lane; lanes are updated one by one.

    Args:
        networks: the lanes' networks; they are trained in place.
        target_networks: networks with the initial target weights; by default targets start as copies.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
    ) -> None:
        self._rule = rule
        self.parts = [list(parts_of(network).values()) for network in networks]
        self.losses = [make_loss(network) for network in networks]
        for loss in self.losses:
            own_targets(loss)
        self._start_targets(target_networks or (), make_loss)
        self.optimizers = [torch_optimizer(rule, loss.parameters()) for loss in self.losses]

    def _start_targets(self, networks: Sequence[nn.Module], make_loss: MakeLoss) -> None:
        for loss, network in zip(self.losses, networks, strict=False):
            for name, values in targets_of(make_loss(network)).items():
                getattr(loss, f"target_{name}").data.copy_(values.data)

    def update_from(self, batch: TensorDict) -> Tensor:
        return torch.stack([self.learn(lane, batch[lane]) for lane in range(len(self.losses))])

    def learn(self, lane: int, batch: TensorDictBase) -> Tensor:
        """One step of an optimiser on a batch of one lane, [b]; returns the loss, 0-d."""
        loss = total(self.losses[lane](batch), self.losses[lane]).mean() * self._rule.loss_share
        self.optimizers[lane].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._rule.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.losses[lane].parameters(), self._rule.max_grad_norm)
        self.optimizers[lane].step()
        if self._rule.tau is not None:
            for weight, target in _with_targets(self.losses[lane]):
                target.data.lerp_(weight.data, self._rule.tau)
        return loss.detach()

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        return stacked_outputs([parts[part] for parts in self.parts], observation, *recurrent)

    def copy_to_targets(self, which: Tensor) -> None:
        for lane in which.nonzero().flatten().tolist():
            for weight, target in _with_targets(self.losses[lane]):
                target.data.copy_(weight.data)

    def network_state(self, lane: int) -> Weights:
        return {name: value.detach().clone() for name, value in self.parts[lane][0].state_dict().items()}

    def weights(self, lane: int) -> Weights:
        return weights_of(self.losses[lane])

    def finite(self) -> Tensor:
        pairs = zip(self.losses, self.optimizers, strict=True)
        return torch.tensor([is_finite(loss, optimizer) for loss, optimizer in pairs])

    def state_dict(self) -> dict[str, Any]:
        return {
            "losses": [dict(loss.state_dict()) for loss in self.losses],
            "adams": [optimizer.state_dict() for optimizer in self.optimizers],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for loss, weights in zip(self.losses, state["losses"], strict=True):
            loss.load_state_dict(weights)
        for optimizer, moments in zip(self.optimizers, state["adams"], strict=True):
            optimizer.load_state_dict(moments)


def stacked_outputs(networks: Sequence[nn.Module], *inputs: Tensor) -> Any:
    """The outputs of several networks: [l, k, ...] to [l, k, ...]; of recurrent ones also their states."""
    given = [network(*seen) for network, *seen in zip(networks, *inputs, strict=True)]
    if isinstance(given[0], tuple):
        return tuple(torch.stack(each) for each in zip(*given, strict=True))
    return torch.stack(given)


def is_finite(loss: LossModule, optimizer: torch.optim.Optimizer) -> bool:
    moments = [value for state in optimizer.state.values() for value in state.values()]
    weights: list[Any] = list(loss.state_dict().values())
    return all_finite(value for value in (*weights, *moments) if isinstance(value, Tensor))


def _with_targets(loss: LossModule) -> list[tuple[TensorDictParams, TensorDictParams]]:
    """The groups of weights of a loss that have targets, each paired with its targets."""
    return [(values, getattr(loss, f"target_{name}")) for name, values in targets_of(loss).items()]


class FunctionalEngine(Engine):
    """Updates all lanes in one step: gathering a batch, TorchRL's loss, its gradient and the optimiser.

    With a lane axis the loss returns one number per transition. These are averaged over the batch and summed
    over lanes, so that each lane's gradient depends on its own loss alone.

    Args:
        networks: the lanes' networks, of one architecture; their weights are copied.
        target_networks: networks with the initial target weights; by default targets start as copies.
        lane_axis: whether the networks are stacked along a lane axis; else the loss is vmapped.
        flat: with a lane axis, whether the loss gets the transitions of all lanes flat, [L x b].
        compile: whether torch compiles the step. If compilation fails, the engine warns once and runs the
            step uncompiled.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
        lane_axis: bool,
        flat: bool = False,
        compile: bool = True,
    ) -> None:
        loss, self.params, self.targets, names = stacked(networks, make_loss, lane_axis=lane_axis)
        if target_networks is not None:
            others = stacked(target_networks, make_loss, lane_axis=lane_axis).params
            self.targets |= {name: others[_source(name)] for name in self.targets if _source(name) in others}
        self._mean, self._square = (
            {
                name: torch.zeros_like(value)
                for name, value in self.params.items()
                if rule.optimizer in have_it
            }
            for have_it in (WITH_MEAN, WITH_SQUARE)
        )
        self.loss = FunctionalLoss(loss)
        network = stack_lanes(networks) if lane_axis else deepcopy(networks[0])
        self._parts = list(parts_of(network).items())
        self._shared = {name: self.params[key] for name, key in names.items() if key in self.params}
        if lane_axis:  # acts with the same tensors that updates change
            for name, parameter in network.named_parameters():
                if name in self._shared:
                    parameter.requires_grad_(False).data = self._shared[name]
        self._names, self._target_names = tuple(self.params), tuple(self.targets)
        groups = self.params, self.targets, self._mean, self._square
        self._tensors = [list(group.values()) for group in groups]
        self.steps = 0
        kind = next(iter(self.params.values()))
        self._scalars = kind.new_zeros(()), kind.new_zeros(())
        self._rule, self._vmapped, self._flat = rule, not lane_axis, flat
        self._is_warm = not compile
        self._compiled = Compiled(FunctionalEngine._step, what="updates run", changes=(7,), enabled=compile)
        self._compiled_on = Compiled(
            FunctionalEngine._step_on, what="updates run", changes=(6,), enabled=compile
        )

    def update(self, ring: Ring) -> Tensor:
        if ring.sequence_steps > 1:
            return self.update_from(ring.sample())
        index = ring.draw()
        self.steps += 1
        noise = None if ring.noise is None else ring.noise.next()
        if not self._is_warm:
            self._warm_up(sampled(ring.fields, index, ring.rows, ring.horizon, noise))
        fields, form = [*ring.fields.values()], _form(ring, index, noise)
        arguments = fields, ring.rows, ring.horizon, index, *self._adam_scalars(), self._tensors, noise
        losses: Tensor = self._compiled(form, self, *arguments)
        return losses

    def update_from(self, batch: TensorDict) -> Tensor:
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
        size.fill_(self._rule.learning_rate / (1 - BETA_1**self.steps))
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
        params, targets, means, squares = tensors
        gradients, losses = self._gradients(params, targets, batch)
        change_weights(self._rule, params, gradients, means, squares, step_size=step_size, scale=scale)
        if self._rule.tau is not None:
            for name, target in zip(self._target_names, targets, strict=True):
                if _source(name) in self._names:
                    target.lerp_(params[self._names.index(_source(name))], self._rule.tau)
        return losses

    def _gradients(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[list[Tensor], Tensor]:
        """The gradients of the trained weights, and each lane's loss."""
        gradient = torch.func.grad(self._lane_losses, has_aux=True)
        if self._vmapped:
            gradient = torch.vmap(gradient)
        gradients, losses = gradient(params, targets, batch)
        return gradients, losses

    def _lane_losses(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """The sum of the losses of all lanes, to differentiate, and each lane's loss; under vmap there is one
        lane."""
        by_name = (
            dict(zip(self._names, params, strict=True)),
            dict(zip(self._target_names, targets, strict=True)),
        )
        each = self.loss(*by_name, batch.reshape(-1) if self._flat else batch)
        if self._flat:
            each = each.reshape(batch.batch_size)
        losses = (each.mean() if self._vmapped else each.flatten(1).mean(-1)) * self._rule.loss_share
        return losses.sum(), losses

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        name, network = self._parts[part]
        if not self._vmapped:
            return network(observation, *recurrent)
        return vmapped(network, self._of_part(name), observation, *recurrent)

    def _of_part(self, name: str) -> Weights:
        """The weights of one of an agent's networks, by their names in that network."""
        prefix = f"{name}." if name else ""
        return {
            key.removeprefix(prefix): value for key, value in self._shared.items() if key.startswith(prefix)
        }

    def copy_to_targets(self, which: Tensor) -> None:
        for name, target in self.targets.items():
            if _source(name) in self.params:
                target[which] = self.params[_source(name)][which]

    def network_state(self, lane: int) -> Weights:
        name, network = self._parts[0]
        if not self._vmapped:
            return lane_state(network, lane)
        buffers = {key: value.clone() for key, value in network.named_buffers()}
        return {**{key: value[lane].clone() for key, value in self._of_part(name).items()}, **buffers}

    def weights(self, lane: int) -> Weights:
        everything = {**self.params, **self.targets}
        return {
            name: (value[lane] if self._vmapped or _source(name) in self.params else value).clone()
            for name, value in everything.items()
        }

    def finite(self) -> Tensor:
        lanes, every = len(self._tensors[0][0]), [value for group in self._tensors for value in group]
        return finite_lanes([value for value in every if value.ndim and len(value) == lanes])

    def state_dict(self) -> dict[str, Any]:
        return {
            "own": self.params,
            "targets": self.targets,
            "mean": self._mean,
            "square": self._square,
            "steps": self.steps,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        # Copies into the existing tensors, which the compiled step refers to.
        groups = {"own": self.params, "targets": self.targets, "mean": self._mean, "square": self._square}
        for group, tensors in groups.items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; allowed: {sorted(tensors)}"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])
        self.steps = int(state["steps"])


def _source(name: str) -> str:
    return name.removeprefix("target_")


def _form(ring: Ring, index: Tensor, noise: Tensor | None) -> tuple[object, ...]:
    """The shapes and dtypes for which a step is compiled; the engine's own tensors never change theirs."""
    sizes = ring.rows, ring.horizon, index.shape, None if noise is None else noise.shape
    return (*sizes, *((field.shape, field.dtype) for field in ring.fields.values()))


class SharedEngine(Engine):
    """Presents an engine of R networks, each shared by S agents, as an engine of L = R x S lanes.

    A network learns from the transitions of all its agents in one batch, S x b of them. The loss of a lane is
    that of its network.
    """

    def __init__(self, engine: Engine, agents: int) -> None:
        self.engine, self._agents = engine, agents

    def update_from(self, batch: TensorDict) -> Tensor:
        lanes, *sizes = batch.batch_size
        if "is_init" in batch:  # each sequence stays one
            *sequences, steps = sizes
            sizes = [prod(sequences), steps]
        together = batch.reshape(lanes // self._agents, self._agents * sizes[0], *sizes[1:])
        return self.engine.update_from(together).repeat_interleave(self._agents)

    def copy_to_targets(self, which: Tensor) -> None:
        # Agents that share a network are marked together.
        self.engine.copy_to_targets(which.view(-1, self._agents)[:, 0])

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        return self._by_network(partial(self.engine.outputs, part=part), observation, *recurrent)

    def network_state(self, lane: int) -> Weights:
        return self.engine.network_state(lane // self._agents)

    def weights(self, lane: int) -> Weights:
        return self.engine.weights(lane // self._agents)

    def finite(self) -> Tensor:
        return self.engine.finite().repeat_interleave(self._agents)

    def state_dict(self) -> dict[str, Any]:
        return self.engine.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.engine.load_state_dict(state)

    def _by_network(self, outputs: Callable[..., Any], observation: Tensor, *recurrent: Tensor) -> Any:
        """[L, k, ...] to [L, k, ...], through a function of [R, S x k, ...], or of recurrent networks of
        [R, S, k, ...]."""
        if recurrent:
            inputs = [seen.reshape(-1, self._agents, *seen.shape[1:]) for seen in (observation, *recurrent)]
            return tuple(output.flatten(0, 1) for output in outputs(*inputs))
        lanes, size = observation.shape[:2]
        by_network = observation.reshape(lanes // self._agents, self._agents * size, *observation.shape[2:])
        given: Tensor = outputs(by_network)
        return given.reshape(lanes, size, *given.shape[2:])


def is_list(engine: object) -> bool:
    """Whether an engine updates one loss after the other, uncompiled."""
    return isinstance(engine.engine if isinstance(engine, SharedEngine) else engine, ListEngine)
