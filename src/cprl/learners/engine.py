"""Engines: one update step for many independent learners, each with a TorchRL loss module.

`FunctionalEngine` updates all lanes together in one compiled step. `ListEngine` is TorchRL's stock parts, one
lane after the other: what the step is tested against, and the fallback for losses that work in no other way.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from math import prod
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from cprl.learners.ring import FIELDS, Horizon, Ring, gather
from cprl.learners.settings import Optimizer
from cprl.networks.agent import parts_of
from cprl.networks.finite import all_finite, finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives.functional import (
    FunctionalLoss,
    Weights,
    groups_of,
    named_weights,
    own_targets,
    single_weights,
    targets_of,
    total,
    weights_of,
)
from cprl.system.compiling import Compiled

Batching: TypeAlias = Literal["lane_axis", "lane_axis_flat", "vmapped", "list"]
"""How lanes are updated, the fastest way first.

"lane_axis": the networks' parameters have a lane axis, under one ordinary loss; needs networks that stack,
    see `cprl.networks.stacked.stack_lanes`.
"lane_axis_flat": the same, for losses that need a flat batch of transitions, [L x b].
"vmapped": `torch.vmap` of the loss over stacked parameters; works with any network.
"list": a loss module for each lane, one after the other; works with any loss.
"""
WAYS: Final[tuple[Batching, ...]] = ("lane_axis", "lane_axis_flat", "vmapped")
"""Those that update all lanes together."""

MakeLoss = Callable[[nn.Module], LossModule]
"""Makes one agent's loss from its network."""


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
    """Updates the networks of L lanes at once.

    Args:
        sharing: how many consecutive lanes S share a network, which learns from the transitions of all of
            them in one batch, S x b of them. There are L / S networks.
    """

    def __init__(self, sharing: int = 1) -> None:
        self.sharing = sharing

    def update(self, ring: Ring) -> Tensor:
        """Samples from a ring, updates every network once and returns their losses, float [L / S]."""
        return self.update_from(ring.sample())

    def update_from(self, batch: TensorDict) -> Tensor:
        """Updates every network once from a batch, [L, b] or sequences; returns their losses, [L / S]."""
        if self.sharing > 1:
            lanes, *sizes = batch.batch_size
            if "is_init" in batch:  # each sequence stays one
                *sequences, steps = sizes
                sizes = [prod(sequences), steps]
            batch = batch.reshape(lanes // self.sharing, self.sharing * sizes[0], *sizes[1:])
        return self._update(batch)

    def update_at(self, batch: TensorDict, place: Tensor) -> Tensor:
        """Updates every network once from the steps at places [L, ...] of a batch [L, n]; returns their
        losses, [L / S]."""
        return self.update_from(_at(batch, place))

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """The outputs of the networks with their current weights: [L, k, ...] to [L, k, ...]; of recurrent
        ones also their states.

        Args:
            recurrent: what recurrent networks read besides, see `cprl.networks.recurrent`.
            part: which of an agent's networks, see `cprl.networks.agent.parts_of`; the first one acts.
        """
        if self.sharing == 1:
            return self._outputs(part, observation, *recurrent)
        by_network = [
            entry.reshape(-1, self.sharing, *entry.shape[1:]) for entry in (observation, *recurrent)
        ]
        if recurrent:  # the time of sequences stays an axis of its own
            return tuple(given.flatten(0, 1) for given in self._outputs(part, *by_network))
        given: Tensor = self._outputs(part, by_network[0].flatten(1, 2))
        return given.reshape(*observation.shape[:2], *given.shape[2:])

    @abstractmethod
    def _update(self, batch: TensorDict) -> Tensor: ...

    @abstractmethod
    def _outputs(self, part: int, *seen: Tensor) -> Any: ...

    @abstractmethod
    def copy_to_targets(self, which: Tensor) -> None:
        """Copies the weights of the marked networks, bool [L / S], to their targets."""

    @abstractmethod
    def network_state(self, network: int) -> Weights:
        """Copies of the current weights of an acting network, as its state dict."""

    @abstractmethod
    def weights(self, network: int) -> Weights:
        """Copies of all weights of a network, including targets, by their names in the loss."""

    @abstractmethod
    def finite(self) -> Tensor:
        """Whether weights, targets and optimiser state of networks are finite, bool [L / S] on the CPU."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """The full state; the tensors themselves, not copies."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class ListEngine(Engine):
    """TorchRL's stock parts for each network: its loss module, an optimiser of `torch.optim`, and a
    `HardUpdate` or `SoftUpdate` of its targets. Networks are trained in place, one after the other.

    Args:
        target_networks: networks with the initial target weights; by default targets start as copies.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
        sharing: int = 1,
    ) -> None:
        super().__init__(sharing)
        self._rule = rule
        self.parts = [list(parts_of(network).values()) for network in networks]
        self.losses = [make_loss(network) for network in networks]
        for loss in self.losses:
            own_targets(loss)
        self.updaters = [_target_updater(loss, rule.tau) for loss in self.losses]  # makes targets copies
        for loss, network in zip(self.losses, target_networks or (), strict=False):
            for name, values in targets_of(make_loss(network)).items():
                getattr(loss, f"target_{name}").data.copy_(values.data)
        self.optimizers = [torch_optimizer(rule, loss.parameters()) for loss in self.losses]

    def _update(self, batch: TensorDict) -> Tensor:
        return torch.stack([self.learn(network, batch[network]) for network in range(len(self.losses))])

    def learn(self, network: int, batch: TensorDictBase) -> Tensor:
        """One step of an optimiser on a batch of one network, [b]; returns the loss, 0-d."""
        module, updater = self.losses[network], self.updaters[network]
        loss = total(module(batch), module).mean() * self._rule.loss_share
        self.optimizers[network].zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self._rule.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(module.parameters(), self._rule.max_grad_norm)
        self.optimizers[network].step()
        if isinstance(updater, SoftUpdate):
            updater.step()
        return loss.detach()

    def _outputs(self, part: int, *seen: Tensor) -> Any:
        given = [parts[part](*inputs) for parts, *inputs in zip(self.parts, *seen, strict=True)]
        if isinstance(given[0], tuple):
            return tuple(torch.stack(each) for each in zip(*given, strict=True))
        return torch.stack(given)

    def copy_to_targets(self, which: Tensor) -> None:
        for marked, updater in zip(which.tolist(), self.updaters, strict=True):
            if marked and updater is not None:
                updater.step()

    def network_state(self, network: int) -> Weights:
        return {name: value.detach().clone() for name, value in self.parts[network][0].state_dict().items()}

    def weights(self, network: int) -> Weights:
        return weights_of(self.losses[network])

    def finite(self) -> Tensor:
        sound = []
        for loss, optimizer in zip(self.losses, self.optimizers, strict=True):
            moments = [value for state in optimizer.state.values() for value in state.values()]
            values = (*loss.state_dict().values(), *moments)
            sound.append(all_finite(value for value in values if isinstance(value, Tensor)))
        return torch.tensor(sound)

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


def _target_updater(loss: LossModule, tau: float | None) -> TargetNetUpdater | None:
    if not targets_of(loss):
        return None
    # HardUpdate copies at every (interval + 1)-th step.
    return HardUpdate(loss, value_network_update_interval=0) if tau is None else SoftUpdate(loss, tau=tau)


class _FromRing(NamedTuple):
    """A batch that the step itself gathers from the fields of a ring, then places, their columns and perhaps
    noise."""

    rows: int
    horizon: Horizon | None

    def batch(self, columns: Sequence[Tensor]) -> TensorDict:
        index, column, *noise = columns[len(FIELDS) :]
        fields = dict(zip(FIELDS, columns, strict=False))
        return gather(fields, index, column, self.rows, self.horizon, *noise)


class _Given(NamedTuple):
    """A batch that exists before the step: the names of its entries, and its batch size [L, n]; of which the
    step takes places [L, ...], if they are a last column."""

    names: tuple[Any, ...]
    size: tuple[int, ...]

    def batch(self, columns: Sequence[Tensor]) -> TensorDict:
        batch = TensorDict({}, batch_size=self.size)
        for name, column in zip(self.names, columns, strict=False):
            batch.set(name, column)
        return _at(batch, columns[-1]) if len(columns) > len(self.names) else batch


def _at(batch: TensorDict, place: Tensor) -> TensorDict:
    """The steps at places [L, ...] of a batch [L, n]."""
    lane = torch.arange(len(place), device=place.device).view(-1, *[1] * (place.ndim - 1))
    steps: TensorDict = batch[lane, place]
    return steps


class FunctionalEngine(Engine):
    """Updates all networks in one step: gathering a batch, TorchRL's loss, its gradient and the optimiser.

    With a lane axis the loss returns one number per transition. These are averaged over the batch and summed
    over networks, so that each one's gradient depends on its own loss alone.

    Args:
        networks: of one architecture; their weights are copied.
        target_networks: networks with the initial target weights; by default targets start as copies.
        batching: see `Batching`; not "list".
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        target_networks: Sequence[nn.Module] | None = None,
        batching: Batching,
        sharing: int = 1,
        compile: bool = True,
    ) -> None:
        super().__init__(sharing)
        self.batching: Final = batching
        self._vmapped = batching == "vmapped"
        network, loss, weights = self._stacked(networks, make_loss)
        named = named_weights(loss)
        self.params = {name: weights[name] for name, value in named.items() if value.requires_grad}
        self.targets = {name: value for name, value in weights.items() if name not in self.params}
        if target_networks is not None:
            _, _, others = self._stacked(target_networks, make_loss)
            self.targets |= {name: others[_source(name)] for name in self.targets if _source(name) in others}
        self._mean, self._square = (
            {name: torch.zeros_like(value) for name, value in kept.items()}
            for kept in (self.params if rule.optimizer in kinds else {} for kinds in (WITH_MEAN, WITH_SQUARE))
        )
        places = {value.data_ptr(): name for name, value in named.items()}
        self._in_loss = {
            name: self.params[places[value.data_ptr()]]
            for name, value in network.named_parameters()
            if places.get(value.data_ptr()) in self.params
        }
        """Those of the trained weights that the network has, by their names in it."""
        self._parts = list(parts_of(network).items())
        if not self._vmapped:  # acts with the same tensors that updates change
            for name, parameter in network.named_parameters():
                if name in self._in_loss:
                    parameter.requires_grad_(False).data = self._in_loss[name]
        self.loss = FunctionalLoss(loss)
        self._names, self._target_names = tuple(self.params), tuple(self.targets)
        self._tensors = [list(group.values()) for group in self._groups().values()]
        self.steps = 0
        self._scalars = tuple(self._tensors[0][0].new_zeros(()) for _ in range(2))
        self._rule, self._is_warm = rule, not compile
        self._compiled = Compiled(FunctionalEngine._step, what="updates run", changes=(5,), enabled=compile)

    def _stacked(
        self, networks: Sequence[nn.Module], make_loss: MakeLoss
    ) -> tuple[nn.Module, LossModule, Weights]:
        """One network and its loss, and copies of all their weights by name, with the lane axis first."""
        network = deepcopy(networks[0]) if self._vmapped else stack_lanes(networks)
        loss = make_loss(network)
        own_targets(loss)
        if self._vmapped:
            each = [weights_of(make_loss(one)) for one in networks]
            return network, loss, {name: torch.stack([one[name] for one in each]) for name in each[0]}
        if shared := single_weights(loss):
            raise ValueError(f"all agents would share the weights {', '.join(shared)} of the loss")
        if any(group.batch_size for group in groups_of(loss).values()):
            raise ValueError("the loss stacks networks along an axis before the lane axis")
        return network, loss, weights_of(loss)

    def update(self, ring: Ring) -> Tensor:
        if ring.sequence_steps > 1 or self.sharing > 1:
            return super().update(ring)
        drawn = ring.draw()
        columns = [*ring.fields.values(), *drawn]
        if ring.noise is not None:
            columns.append(ring.noise.next())
        return self._run(_FromRing(ring.rows, ring.horizon), columns, (ring.sizes, drawn[0].shape))

    def update_at(self, batch: TensorDict, place: Tensor) -> Tensor:
        return super().update_at(batch, place) if self.sharing > 1 else self._update(batch, place)

    def _update(self, batch: TensorDict, *place: Tensor) -> Tensor:
        entries = sorted(batch.items(True, True), key=lambda entry: str(entry[0]))
        given = _Given(tuple(name for name, _ in entries), tuple(batch.batch_size))
        columns = [*(column for _, column in entries), *place]
        return self._run(given, columns, tuple((column.shape, column.dtype) for column in columns))

    def _run(self, source: _FromRing | _Given, columns: list[Tensor], sizes: tuple[Any, ...]) -> Tensor:
        self.steps += 1
        if not self._is_warm:
            # TensorDict fills a cache at first use, which compiled code would refill at each call.
            self._gradients(self._tensors[0], self._tensors[1], source.batch(columns))
            self._is_warm = True
        # Adam's two bias corrections, computed once here instead of once per weight in the graph.
        step_size, scale = self._scalars
        step_size.fill_(self._rule.learning_rate / (1 - BETA_1**self.steps))
        scale.fill_((1 - BETA_2**self.steps) ** -0.5)
        # Code is compiled for the source and its sizes; the engine's own tensors never change theirs.
        arguments = source, columns, step_size, scale, self._tensors
        losses: Tensor = self._compiled((source, sizes), self, *arguments)
        return losses

    def _step(
        self,
        source: _FromRing | _Given,
        columns: list[Tensor],
        step_size: Tensor,
        scale: Tensor,
        tensors: list[list[Tensor]],
    ) -> Tensor:
        """Changes the weights in place and returns the loss of each network. Tensors are passed in lists: the
        guards of compiled code find a dict's entry by counting through its keys, which takes longer than all
        computation of one lane."""
        params, targets, means, squares = tensors
        gradients, losses = self._gradients(params, targets, source.batch(columns))
        change_weights(self._rule, params, gradients, means, squares, step_size=step_size, scale=scale)
        if self._rule.tau is not None:
            for name, target in zip(self._target_names, targets, strict=True):
                if _source(name) in self._names:
                    target.lerp_(params[self._names.index(_source(name))], self._rule.tau)
        return losses

    def _gradients(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[list[Tensor], Tensor]:
        gradient = torch.func.grad(self._losses, has_aux=True)
        if self._vmapped:
            gradient = torch.vmap(gradient)
        gradients, losses = gradient(params, targets, batch)
        return gradients, losses

    def _losses(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """The sum of the losses of all networks, to differentiate, and each one's loss."""
        flat = self.batching == "lane_axis_flat"
        each = self.loss(
            dict(zip(self._names, params, strict=True)),
            dict(zip(self._target_names, targets, strict=True)),
            batch.reshape(-1) if flat else batch,
        )
        each = each.reshape(batch.batch_size) if flat else each
        losses = (each.mean() if self._vmapped else each.flatten(1).mean(-1)) * self._rule.loss_share
        return losses.sum(), losses

    def _outputs(self, part: int, *seen: Tensor) -> Any:
        name, network = self._parts[part]
        if not self._vmapped:
            return network(*seen)

        def outputs(weights: Weights, *inputs: Tensor) -> Any:
            return torch.func.functional_call(network, weights, inputs)

        return torch.vmap(outputs)(self._of_part(name), *seen)

    def _of_part(self, name: str) -> Weights:
        prefix = f"{name}." if name else ""
        weights = self._in_loss.items()
        return {key.removeprefix(prefix): value for key, value in weights if key.startswith(prefix)}

    def copy_to_targets(self, which: Tensor) -> None:
        for name, target in self.targets.items():
            if _source(name) in self.params:
                target[which] = self.params[_source(name)][which]

    def network_state(self, network: int) -> Weights:
        name, module = self._parts[0]
        if not self._vmapped:
            return lane_state(module, network)
        buffers = {key: value.clone() for key, value in module.named_buffers()}
        return {**{key: value[network].clone() for key, value in self._of_part(name).items()}, **buffers}

    def weights(self, network: int) -> Weights:
        return {
            name: (value[network] if self._vmapped or _source(name) in self.params else value).clone()
            for name, value in {**self.params, **self.targets}.items()
        }

    def finite(self) -> Tensor:
        lanes, every = len(self._tensors[0][0]), [value for group in self._tensors for value in group]
        return finite_lanes([value for value in every if value.ndim and len(value) == lanes])

    def _groups(self) -> dict[str, Weights]:
        return {"own": self.params, "targets": self.targets, "mean": self._mean, "square": self._square}

    def state_dict(self) -> dict[str, Any]:
        return {**self._groups(), "steps": self.steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for group, tensors in self._groups().items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; allowed: {sorted(tensors)}"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])  # in place: the compiled step refers to these
        self.steps = int(state["steps"])


def _source(name: str) -> str:
    return name.removeprefix("target_")


def make_engine(
    networks: Sequence[nn.Module],
    make_loss: MakeLoss,
    rule: UpdateRule,
    *,
    batching: Batching,
    compile: bool,
    target_networks: Sequence[nn.Module] | None = None,
    sharing: int = 1,
) -> Engine:
    """The engine of all lanes over their networks; `compile` is ignored for "list"."""
    options: dict[str, Any] = {"target_networks": target_networks, "sharing": sharing}
    if batching == "list":
        return ListEngine(networks, make_loss, rule, **options)
    return FunctionalEngine(networks, make_loss, rule, batching=batching, compile=compile, **options)
