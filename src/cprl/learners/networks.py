"""LaneNetworks: the networks of all lanes, which act and learn together.

All weights have a lane axis, [L, ...]. A step gathers a batch, takes TorchRL's loss and its gradient, and
changes the weights by the rule of an optimiser, for all lanes at once; torch may compile it.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from math import prod
from typing import Any, Final, Literal, TypeAlias

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.learners.draw import Draw
from cprl.learners.optimizers import BETA_1, BETA_2, WITH_MEAN, WITH_SQUARE, UpdateRule, change_weights
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
    weights_of,
)
from cprl.system.compat import entropy_by_formula
from cprl.system.compiling import Compiled

Update: TypeAlias = Literal["stacked", "vmapped", "list"]
"""How a loss sees the lanes.

"stacked": one loss over networks whose parameters have the lane axis, see
    `cprl.networks.stacked.stack_lanes`; right for losses that do not mix the transitions of a batch.
"vmapped": `torch.vmap` of the loss of one lane, so that lanes cannot mix; works with any network.
"list": a loss for each lane, one after the other; works with any loss, and is many times slower.
"""

MakeLoss = Callable[[Any], LossModule]
"""Makes the loss of a lane from its network."""

COMPILED_STEPS: Final = 16
"""The longest sequences whose update is compiled: torch unrolls their turns, and takes seconds for each."""


class LaneNetworks:
    """The networks, losses and optimisers of all lanes.

    Losses are averaged over each lane's batch and summed over lanes, so the gradient by the weights of a lane
    is that of its own loss alone.

    Args:
        networks: of one architecture, for each lane, or each `sharing` lanes; their weights are copied.
        make_loss: makes TorchRL's loss from a network.
        update: how the loss sees the lanes.
        target_networks: networks with the initial target weights; by default targets start as copies.
        sharing: how many consecutive lanes S share a network, which learns from the transitions of all of
            them in one batch, S x b of them. There are L / S networks.
        compile: whether torch compiles the step; a "list" is not compiled.
    """

    def __init__(
        self,
        networks: Sequence[nn.Module],
        make_loss: MakeLoss,
        rule: UpdateRule,
        *,
        update: Update,
        target_networks: Sequence[nn.Module] | None = None,
        sharing: int = 1,
        compile: bool = False,
    ) -> None:
        self.update, self.rule, self.sharing, self.updates = update, rule, sharing, 0
        network, loss, weights = _together(networks, make_loss, update)
        named = named_weights(loss)
        self.params = {name: weights[name] for name, value in named.items() if value.requires_grad}
        self.targets = {name: value for name, value in weights.items() if name not in self.params}
        """Targets, and whatever else is not trained."""
        if target_networks is not None:
            _, _, others = _together(target_networks, make_loss, update)
            self.targets |= {name: others[_source(name)] for name in self.targets if _source(name) in others}
        self.means = _zeros_like(self.params) if rule.optimizer in WITH_MEAN else {}
        self.squares = _zeros_like(self.params) if rule.optimizer in WITH_SQUARE else {}
        self.parts = list(parts_of(network).items())
        self._acting = _weights_in(network, named, {**self.targets, **self.params})
        """Weights and buffers of the network, by their names in it."""
        if update == "stacked":  # acts with the same tensors that steps change
            for name, parameter in network.named_parameters():
                if name in self._acting:
                    parameter.requires_grad_(False).data = self._acting[name]
        if update == "vmapped":
            entropy_by_formula(loss)
        modules = [make_loss(deepcopy(each)) for each in networks] if update == "list" else [loss]
        for module in modules:
            own_targets(module)
        self.losses = [FunctionalLoss(module) for module in modules]
        self._names, self._target_names = tuple(self.params), tuple(self.targets)
        self._tensors = [list(group.values()) for group in self._groups().values()]
        self.learning_rate = rule.learning_rate
        """Of the next step."""
        self._scalars = [self._tensors[0][0].new_zeros(()) for _ in range(3)]
        """The learning rate, and the two corrections of Adam's biases."""
        self.compiles = compile and update != "list"
        self._is_warm = not self.compiles
        self._compiled = Compiled(LaneNetworks._step, what="updates run", changes=(4,), enabled=self.compiles)
        self._evaluate = Compiled(_outputs_of_both, what="rollouts are evaluated", enabled=self.compiles)

    def learn(self, draw: Draw) -> Tensor:
        """Takes one step of all networks; returns their losses, float [L / S]."""
        self.updates += 1
        if not self._is_warm:
            # TensorDict fills a cache at first use, which compiled code would refill at each call.
            self._gradients(self._tensors[0], self._tensors[1], draw.gather(draw.columns))
            self._is_warm = True
        # Computed once here instead of once per weight in the graph.
        rate, step_size, scale = self._scalars
        if self.rule.falls:
            rate.fill_(self.learning_rate)
        step_size.fill_(self.learning_rate / (1 - BETA_1**self.updates))
        scale.fill_((1 - BETA_2**self.updates) ** -0.5)
        # Code is compiled for the draw's form; the networks' own tensors never change theirs.
        arguments = draw.gather, draw.columns, self._scalars, self._tensors
        losses: Tensor = self._compiled((draw.gather, draw.form), self, *arguments)
        every = self.rule.target_every_updates
        if every is not None and self.updates % every == 0:
            self.copy_to_targets(torch.ones(len(self._tensors[0][0]), dtype=torch.bool))
        return losses

    def _step(
        self,
        gather: Callable[[Sequence[Tensor]], TensorDict],
        columns: list[Tensor],
        scalars: list[Tensor],
        tensors: list[list[Tensor]],
    ) -> Tensor:
        """Changes the weights in place and returns the loss of each network. Tensors are passed in lists: the
        guards of compiled code find a dict's entry by counting through its keys, which takes longer than all
        computation of one lane."""
        params, targets, means, squares = tensors
        gradients, losses = self._gradients(params, targets, gather(columns))
        rate, step_size, scale = scalars
        options: dict[str, Any] = {"step_size": step_size, "scale": scale}
        options["rate"] = rate if self.rule.falls else self.rule.learning_rate
        change_weights(self.rule, params, gradients, means, squares, **options)
        if self.rule.tau is not None:
            for name, target in zip(self._target_names, targets, strict=True):
                if _source(name) in self._names:
                    target.lerp_(params[self._names.index(_source(name))], self.rule.tau)
        return losses

    def _gradients(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Sequence[Tensor], Tensor]:
        """The gradient of each network's loss by its own weights, and the losses, [L / S]."""
        batch = self._by_network(batch)
        if self.update == "list":
            each = [self._gradient_of(place, params, targets, batch) for place in range(len(self.losses))]
            gradients, losses = zip(*each, strict=True)
            return [torch.stack(slopes) for slopes in zip(*gradients, strict=True)], torch.stack(losses)
        gradient = torch.func.grad(self._total, has_aux=True)
        if self.update == "vmapped":
            gradient = torch.vmap(gradient)
        gradients, losses = gradient(params, targets, batch)
        return gradients, losses

    def _total(self, params: list[Tensor], targets: list[Tensor], batch: TensorDict) -> tuple[Tensor, Tensor]:
        """The sum of the losses of all networks, to differentiate, and each one's loss.

        They are averaged over the batch and summed over networks, so that each one's gradient depends on its
        own loss alone.
        """
        each = self._loss(0, params, targets, batch)
        losses = _mean(each, batch, of_one=self.update == "vmapped") * self.rule.loss_share
        return losses.sum(), losses

    def _gradient_of(
        self, place: int, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Sequence[Tensor], Tensor]:
        """The gradient and the loss of one network of a "list"."""
        weights = [value[place].detach().requires_grad_() for value in params]
        each = self._loss(place, weights, [value[place] for value in targets], batch[place])
        loss = _mean(each, batch[place], of_one=True) * self.rule.loss_share
        gradients = torch.autograd.grad(loss, weights, allow_unused=True, materialize_grads=True)
        return gradients, loss.detach()

    def _loss(self, place: int, params: list[Tensor], targets: list[Tensor], batch: TensorDict) -> Tensor:
        named = dict(zip(self._names, params, strict=True))
        return self.losses[place](named, dict(zip(self._target_names, targets, strict=True)), batch)

    def _by_network(self, batch: TensorDict) -> TensorDict:
        """A batch of lanes, [L, b], as one of networks, [L / S, S x b]."""
        if self.sharing == 1:
            return batch
        lanes, *sizes = batch.batch_size
        if "is_init" in batch:  # each sequence stays one
            *sequences, steps = sizes
            sizes = [prod(sequences), steps]
        return batch.reshape(lanes // self.sharing, self.sharing * sizes[0], *sizes[1:])

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """The outputs of the networks with their current weights: [L, k, ...] to [L, k, ...]; of recurrent
        ones also their states.

        Args:
            observation: what lanes observe.
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

    def outputs_of_both(self, observation: Tensor) -> list[Tensor]:
        """The outputs of the first two parts, actor and critic; compiled where steps are."""
        both: list[Tensor] = self._evaluate((observation.shape, observation.dtype), self, observation)
        return both

    def _outputs(self, part: int, *seen: Tensor) -> Any:
        name, network = self.parts[part]
        if self.update == "stacked":
            return network(*seen)

        def outputs(weights: Weights, *inputs: Tensor) -> Any:
            return torch.func.functional_call(network, weights, inputs)

        weights = self._of_part(name)
        if self.update == "vmapped":
            return torch.vmap(outputs)(weights, *seen)
        each = [
            outputs({key: value[place] for key, value in weights.items()}, *inputs)
            for place, inputs in enumerate(zip(*seen, strict=True))
        ]
        if isinstance(each[0], tuple):
            return tuple(torch.stack(given) for given in zip(*each, strict=True))
        return torch.stack(each)

    def _of_part(self, name: str) -> Weights:
        prefix = f"{name}." if name else ""
        weights = self._acting.items()
        return {key.removeprefix(prefix): value for key, value in weights if key.startswith(prefix)}

    def copy_to_targets(self, which: Tensor) -> None:
        """Copies the weights of the marked networks, bool [L / S], to their targets."""
        for name, target in self.targets.items():
            if _source(name) in self.params:
                target[which] = self.params[_source(name)][which]

    def network_state(self, place: int) -> Weights:
        """Copies of the current weights of an acting network, as its state dict."""
        name, network = self.parts[0]
        if self.update == "stacked":
            return lane_state(network, place)
        weights = {key: value[place].clone() for key, value in self._of_part(name).items()}
        others = {key: value for key, value in network.state_dict().items() if key not in weights}
        return {**weights, **{key: value.clone() for key, value in others.items()}}

    def finite(self) -> Tensor:
        """Whether weights, targets, moments and what losses keep are finite, bool [L / S] on the CPU."""
        networks, every = len(self._tensors[0][0]), [value for group in self._tensors for value in group]
        sound = finite_lanes([value for value in every if value.ndim and len(value) == networks])
        if self.update == "list":
            sound &= torch.tensor([all_finite(loss.module.buffers()) for loss in self.losses])
        return sound

    def _groups(self) -> dict[str, Weights]:
        return {
            "params": self.params,
            "targets": self.targets,
            "means": self.means,
            "squares": self.squares,
        }

    def state_dict(self) -> dict[str, Any]:
        """The full state; the tensors themselves, not copies."""
        losses = [loss.kept() for loss in self.losses] if self.update == "list" else []
        return {**self._groups(), "updates": self.updates, "losses": losses}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        for group, tensors in self._groups().items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; allowed: {sorted(tensors)}"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])  # in place: the compiled step refers to these
        for loss, kept in zip(self.losses, state["losses"], strict=False):
            loss.keep(kept)
        self.updates = int(state["updates"])


def _outputs_of_both(networks: LaneNetworks, observation: Tensor) -> list[Tensor]:
    return [networks.outputs(observation, part=part) for part in range(2)]


def _mean(each: Tensor, batch: TensorDict, *, of_one: bool) -> Tensor:
    """The mean loss of one network, or of each, [L / S]; where the batch marks turns in play, of these.

    Args:
        each: the loss of each transition, [b, ..] of one network, or [L / S, b, ..]; or one number.
        batch: with the entry "in_play", bool [b] or [b, S], or [L / S, b, ..], if agents learn from these
            alone.
    """
    first = 0 if of_one else 1
    if "in_play" not in batch:
        mean: Tensor = each.mean() if of_one else each.flatten(1).mean(-1)
        return mean
    marked = batch["in_play"]
    if each.ndim < marked.ndim:
        raise ValueError(
            "only_in_play is True, and the loss gives one number for a batch; allowed with such a loss: False"
        )
    counts = marked.reshape(*marked.shape, *[1] * (each.ndim - marked.ndim)).expand_as(each)
    summed = torch.where(counts, each, 0.0).flatten(first).sum(-1)
    of_marked: Tensor = summed / counts.flatten(first).sum(-1).clamp(min=1)
    return of_marked


def _source(name: str) -> str:
    return name.removeprefix("target_")


def _zeros_like(weights: Weights) -> Weights:
    return {name: torch.zeros_like(value) for name, value in weights.items()}


def _together(
    networks: Sequence[nn.Module], make_loss: MakeLoss, update: Update
) -> tuple[nn.Module, LossModule, Weights]:
    """One network and its loss, and copies of all their weights by name, with the lane axis first."""
    if update != "stacked":
        network = deepcopy(networks[0])
        each = [weights_of(make_loss(one)) for one in networks]
        return (
            network,
            make_loss(network),
            {name: torch.stack([one[name] for one in each]) for name in each[0]},
        )
    network = stack_lanes(networks)
    loss = make_loss(network)
    if shared := single_weights(loss):
        raise ValueError(f"all agents would share the weights {', '.join(shared)} of the loss")
    if any(group.batch_size for group in groups_of(loss).values()):
        raise ValueError("the loss stacks networks along an axis before the lane axis")
    return network, loss, weights_of(loss)


def _weights_in(network: nn.Module, in_loss: Weights, weights: Weights) -> Weights:
    """Those of a loss's weights that a network has, by their names in the network."""
    places = {in_loss[name].data_ptr(): name for name in weights}
    names = {name: places.get(value.data_ptr()) for name, value in network.state_dict().items()}
    return {name: weights[place] for name, place in names.items() if place is not None}
