"""LaneNetworks: the networks of all lanes, which act and learn together.

All weights have a lane axis, [L, ...]. One step gathers a batch, computes TorchRL's loss and its gradient,
and changes the weights as an optimiser does, for all lanes at once. Torch can compile the whole step.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from math import prod
from typing import Any, Final, Literal, TypeAlias

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._pytree import tree_map
from torchrl.objectives import LossModule

from cprl.learners.draw import Draw
from cprl.learners.optimizers import BETA_1, BETA_2, WITH_MEAN, WITH_SQUARE, UpdateRule, change_weights
from cprl.networks.agent import networks_by_name
from cprl.networks.finite import all_finite, finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives.functional import (
    FunctionalLoss,
    Weights,
    groups_of,
    mark_targets_updated,
    named_weights,
    single_weights,
    weights_of,
)
from cprl.system.compat.torchrl import entropy_by_formula
from cprl.system.compiling import Compiled

Update: TypeAlias = Literal["stacked", "vmapped", "list"]
"""How a loss is computed for all lanes.

"stacked": one loss over networks whose parameters have the lane axis, see
    `cprl.networks.stacked.stack_lanes`; right for losses that do not mix the transitions of a batch.
"vmapped": `torch.vmap` of the loss of one lane, so that lanes cannot mix; works with any network.
"list": a loss for each lane, one after the other; works with any loss, and is many times slower.
"""

MakeLoss = Callable[[Any], LossModule]
"""A function that makes TorchRL's loss from the network of a lane."""

COMPILED_STEPS: Final = 16
"""The length of the longest sequences whose update is compiled: torch unrolls the turns of a sequence, and
takes seconds to compile each."""


class LaneNetworks:
    """The networks of all lanes, with their losses, targets and optimisers.

    A lane's loss is the mean over its batch; the losses of all lanes are summed before they are
    differentiated. So the gradient by the weights of a lane is that of its own loss alone.

    Args:
        networks: one for each lane, or for each `sharing` lanes, all of one architecture; their weights are
            copied.
        make_loss: makes TorchRL's loss from a network.
        rule: how a gradient changes weights, and how targets follow.
        update: how the loss is computed for all lanes.
        target_networks: networks with the initial target weights; by default targets start as copies.
        sharing: the number of consecutive lanes S that share a network, which learns from the S x b
            transitions of all of them in one batch. There are L / S networks.
        compile: whether torch compiles the step; a "list" is never compiled.
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
        self.update = update
        self.rule = rule
        self.sharing = sharing
        self.updates = 0
        network, loss, weights = _combine(networks, make_loss, update)
        loss_weights = named_weights(loss)
        self.params = {name: weights[name] for name, value in loss_weights.items() if value.requires_grad}
        """The weights that are trained, [L / S, ...] each, by their names in the loss."""
        self.targets = {name: value for name, value in weights.items() if name not in self.params}
        """The weights that are not trained: targets, and what else a loss has."""
        if target_networks is not None:
            _, _, initial = _combine(target_networks, make_loss, update)
            self.targets |= {
                name: initial[_source(name)] for name in self.targets if _source(name) in initial
            }
        self.means = _zeros_like(self.params) if rule.optimizer in WITH_MEAN else {}
        self.squares = _zeros_like(self.params) if rule.optimizer in WITH_SQUARE else {}
        self.parts = list(networks_by_name(network).items())
        """The names and the networks of an agent, the acting one first."""
        self._network_weights = _select_weights(network, loss_weights, {**self.targets, **self.params})
        """The weights and buffers of the network, by their names in the network."""
        if update == "stacked":  # the network acts with the very tensors that steps change
            for name, parameter in network.named_parameters():
                if name in self._network_weights:
                    parameter.requires_grad_(False).data = self._network_weights[name]
        losses = [loss]
        if update == "vmapped":
            entropy_by_formula(loss)
        elif update == "list":
            losses = [make_loss(deepcopy(lane_network)) for lane_network in networks]
        for lane_loss in losses:
            mark_targets_updated(lane_loss)
        self.losses = [FunctionalLoss(lane_loss) for lane_loss in losses]
        params = list(self.params)
        self._names = (*self.params, *self.targets)
        self._followed = [
            (position, params.index(_source(name)))
            for position, name in enumerate(self.targets)
            if _source(name) in self.params
        ]
        """The positions of each target and of the weights that it follows, among targets and params."""
        self._tensors = [list(group.values()) for group in self._groups().values()]
        """Params, targets, means and squares, each in the order of their names."""
        self.learning_rate = rule.learning_rate
        """The learning rate of the next step."""
        self._scalars = [self._tensors[0][0].new_zeros(()) for _ in range(3)]
        """The learning rate, and the two corrections of Adam's biases."""
        self.compiles = compile and update != "list"
        self._is_warm = not self.compiles
        self._compiled = Compiled(LaneNetworks._step, what="updates run", changes=(4,), enabled=self.compiles)
        self._evaluate = Compiled(_outputs_of_both, what="rollouts are evaluated", enabled=self.compiles)

    def set_entropy_coeff(self, value: float) -> None:
        """Set the weight of the entropy in the losses of the next steps."""
        for loss in self.losses:
            loss.module.entropy_coeff.fill_(value)

    def learn(self, draw: Draw) -> Tensor:
        """Take one step of all networks from a batch; return their losses, float [L / S]."""
        self.updates += 1
        if not self._is_warm:
            # TensorDict fills a cache at first use, which compiled code would refill at each call.
            self._gradients(self._tensors[0], self._tensors[1], draw.gather(draw.columns))
            self._is_warm = True
        # Computed here once, and not in the compiled graph once for each weight.
        rate, step_size, scale = self._scalars
        if self.rule.decays:
            rate.fill_(self.learning_rate)
        step_size.fill_(self.learning_rate / (1 - BETA_1**self.updates))
        scale.fill_((1 - BETA_2**self.updates) ** -0.5)
        # Code is compiled for the form of each draw; the form of the networks' tensors never changes.
        arguments = draw.gather, draw.columns, self._scalars, self._tensors
        losses: Tensor = self._compiled((draw.gather, draw.form), self, *arguments)
        period = self.rule.target_every_updates
        if period is not None and self.updates % period == 0:
            self.copy_to_targets(torch.ones(len(self._tensors[0][0]), dtype=torch.bool))
        return losses

    def _step(
        self,
        gather: Callable[[Sequence[Tensor]], TensorDict],
        columns: list[Tensor],
        scalars: list[Tensor],
        tensors: list[list[Tensor]],
    ) -> Tensor:
        """Change the weights in place; return the loss of each network, [L / S].

        This is the code that torch compiles. Tensors are passed in lists, because the guards of compiled code
        look for an entry of a dict by counting through its keys, which takes longer than all computation of
        one lane.

        Args:
            gather: makes the batch of `columns`, see `Draw`.
            scalars: the learning rate, and the two corrections of Adam's biases.
            tensors: params, targets, means and squares, each in the order of their names.
        """
        params, targets, means, squares = tensors
        gradients, losses = self._gradients(params, targets, gather(columns))
        decaying, step_size, scale = scalars
        rate = decaying if self.rule.decays else self.rule.learning_rate
        change_weights(
            self.rule, params, gradients, means, squares, rate=rate, step_size=step_size, scale=scale
        )
        if self.rule.tau is not None:
            for target, source in self._followed:
                targets[target].lerp_(params[source], self.rule.tau)
        return losses

    def _gradients(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Sequence[Tensor], Tensor]:
        """Return the gradient of each network's loss by its own weights, and the losses, [L / S]."""
        batch = self._by_network(batch)
        if self.update == "list":
            results = [
                self._single_gradient(index, params, targets, batch) for index in range(len(self.losses))
            ]
            return _stack(results)
        gradient_function = torch.func.grad(self._total_loss, has_aux=True)
        if self.update == "vmapped":
            gradient_function = torch.vmap(gradient_function)
        gradients, losses = gradient_function(params, targets, batch)
        return gradients, losses

    def _single_gradient(
        self, index: int, params: list[Tensor], targets: list[Tensor], batch: TensorDict
    ) -> tuple[Sequence[Tensor], Tensor]:
        """Return the gradient and the loss of one network, for the update "list"."""
        weights = [value[index].detach().requires_grad_() for value in params]
        target_weights = [value[index] for value in targets]
        loss, _ = self._total_loss(weights, target_weights, batch[index], index)
        gradients = torch.autograd.grad(loss, weights, allow_unused=True, materialize_grads=True)
        return gradients, loss.detach()

    def _total_loss(
        self, params: list[Tensor], targets: list[Tensor], batch: TensorDict, index: int = 0
    ) -> tuple[Tensor, Tensor]:
        """Return the sum of the losses of all networks, which is differentiated, and the loss of each.

        Losses are averaged over the batch and summed over networks, so that the gradient of each network
        depends on its own loss alone.

        Args:
            index: the index of the loss function.
        """
        weights = dict(zip(self._names, (*params, *targets), strict=True))
        transition_losses = self.losses[index](weights, batch)
        is_single = self.update != "stacked"
        losses = _mean_loss(transition_losses, batch, is_single=is_single) * self.rule.loss_share
        return losses.sum(), losses

    def _by_network(self, batch: TensorDict) -> TensorDict:
        """Reshape a batch of lanes, [L, b], to one of networks, [L / S, S x b]."""
        if self.sharing == 1:
            return batch
        lanes, *sizes = batch.batch_size
        if "is_init" in batch:  # of sequences, whose turns stay together on the last axis
            *sequences, steps = sizes
            sizes = [prod(sequences), steps]
        return batch.reshape(lanes // self.sharing, self.sharing * sizes[0], *sizes[1:])

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """Return the outputs of one network of each lane with its current weights, [L, k, ...]; of recurrent
        networks also the states, see `cprl.networks.recurrent`.

        Args:
            observation: what lanes observe, [L, k, ...].
            recurrent: the further inputs of recurrent networks: states, and `is_init` for sequences.
            part: the index of the network among those of an agent, see
                `cprl.networks.agent.networks_by_name`; the first one acts.
        """
        if self.sharing == 1:
            return self._outputs(part, observation, *recurrent)
        by_network = [
            entry.reshape(-1, self.sharing, *entry.shape[1:]) for entry in (observation, *recurrent)
        ]
        if recurrent:  # lanes stay apart, so that the axis of time stays where it is
            return tuple(result.flatten(0, 1) for result in self._outputs(part, *by_network))
        result: Tensor = self._outputs(part, by_network[0].flatten(1, 2))
        return result.reshape(*observation.shape[:2], *result.shape[2:])

    def outputs_of_both(self, observation: Tensor) -> list[Tensor]:
        """Return the outputs of the first two networks of an agent, actor and critic; torch compiles this if
        it compiles steps."""
        return self._evaluate((observation.shape, observation.dtype), self, observation)

    def _outputs(self, part: int, *inputs: Tensor) -> Any:
        """Return the outputs of one network of each agent that has networks of its own, [L / S, ...]."""
        name, network = self.parts[part]
        if self.update == "stacked":
            return network(*inputs)

        def call_network(weights: Weights, *network_inputs: Tensor) -> Any:
            return torch.func.functional_call(network, weights, network_inputs)

        weights = self._part_weights(name)
        if self.update == "vmapped":
            return torch.vmap(call_network)(weights, *inputs)
        results = []
        for index, lane_inputs in enumerate(zip(*inputs, strict=True)):
            lane_weights = {key: value[index] for key, value in weights.items()}
            results.append(call_network(lane_weights, *lane_inputs))
        return _stack(results)

    def _part_weights(self, part_name: str) -> Weights:
        """Return the weights of one network of an agent, by their names in it."""
        prefix = f"{part_name}." if part_name else ""
        weights = self._network_weights.items()
        return {name.removeprefix(prefix): value for name, value in weights if name.startswith(prefix)}

    def copy_to_targets(self, marked: Tensor) -> None:
        """Copy the weights of the marked networks, bool [L / S], to their targets."""
        params, targets, *_ = self._tensors
        for target, source in self._followed:
            targets[target][marked] = params[source][marked]

    def network_state(self, index: int) -> Weights:
        """Return copies of the current weights of an acting network, 0 to L / S - 1, as its state dict."""
        part_name, network = self.parts[0]
        if self.update == "stacked":
            return lane_state(network, index)
        weights = {name: value[index] for name, value in self._part_weights(part_name).items()}
        return {name: value.clone() for name, value in {**network.state_dict(), **weights}.items()}

    def finite(self) -> Tensor:
        """Return for each network whether its weights, targets, moments and what its loss keeps are finite,
        bool [L / S], on the CPU."""
        networks = len(self._tensors[0][0])
        tensors = [value for group in self._tensors for value in group]
        are_finite = finite_lanes([value for value in tensors if value.ndim and len(value) == networks])
        if self.update == "list":
            are_finite &= torch.tensor([all_finite(loss.module.buffers()) for loss in self.losses])
        return are_finite

    def _groups(self) -> dict[str, Weights]:
        return {
            "params": self.params,
            "targets": self.targets,
            "means": self.means,
            "squares": self.squares,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the full state; the tensors are not copied."""
        losses = [loss.call_state() for loss in self.losses] if self.update == "list" else []
        return {**self._groups(), "updates": self.updates, "losses": losses}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `state_dict` returned.

        Raises:
            ValueError: if the state has other weights.
        """
        for group, tensors in self._groups().items():
            if set(state[group]) != set(tensors):
                raise ValueError(
                    f"the state has the weights {sorted(state[group])}; allowed: {sorted(tensors)}"
                )
            for name, tensor in tensors.items():
                tensor.copy_(state[group][name])  # in place, because compiled code refers to these tensors
        for loss, call_state in zip(self.losses, state["losses"], strict=False):
            loss.load_call_state(call_state)
        self.updates = int(state["updates"])


def _stack(results: Sequence[Any]) -> Any:
    """Return the results of all networks as one, whose tensors have the lane axis in front."""
    return tree_map(lambda *tensors: torch.stack(tensors), *results)


def _outputs_of_both(networks: LaneNetworks, observation: Tensor) -> list[Tensor]:
    """Return the outputs of actors and critics; a function, as torch compiles it."""
    return [networks.outputs(observation, part=part) for part in range(2)]


def _mean_loss(losses: Tensor, batch: TensorDict, *, is_single: bool) -> Tensor:
    """Return the mean of the losses of each network, [L / S], or of one, [].

    Args:
        losses: of each transition, [L / S, b, ..], or [b, ..] for one network; or a number that the loss has
            averaged itself.
        batch: has the entry "in_play", bool [L / S, b, ..] or [b, ..], if agents learn only from turns in
            which they are in play; then the mean is over these.
        is_single: true for the losses of one network.
    """
    first_axis = 0 if is_single else 1
    if "in_play" not in batch:
        return losses.mean() if is_single else losses.flatten(1).mean(-1)
    in_play = batch["in_play"]
    if losses.ndim < in_play.ndim:
        raise ValueError(
            "only_in_play is True, and the loss gives one number for a batch; allowed with such a loss: False"
        )
    counted = in_play.reshape(*in_play.shape, *[1] * (losses.ndim - in_play.ndim)).expand_as(losses)
    total = torch.where(counted, losses, 0.0).flatten(first_axis).sum(-1)
    return total / counted.flatten(first_axis).sum(-1).clamp(min=1)


def _source(name: str) -> str:
    """Return the name of the weights that a target follows, e.g. "value_params:0" for
    "target_value_params:0"; another name as it is."""
    return name.removeprefix("target_")


def _zeros_like(weights: Weights) -> Weights:
    return {name: torch.zeros_like(value) for name, value in weights.items()}


def _combine(
    networks: Sequence[nn.Module], make_loss: MakeLoss, update: Update
) -> tuple[nn.Module, LossModule, Weights]:
    """Return one network for all lanes, its loss, and copies of the weights of all lanes.

    If `update` is "stacked", the network is the stack of all; else it is a copy of the first one, which is
    called with the weights of each lane. Weights have a lane axis in front and are named as in the loss.
    """
    if update != "stacked":
        network = deepcopy(networks[0])
        weights_by_network = [weights_of(make_loss(lane_network)) for lane_network in networks]
        weights = {}
        for name in weights_by_network[0]:
            weights[name] = torch.stack([lane_weights[name] for lane_weights in weights_by_network])
        return network, make_loss(network), weights
    network = stack_lanes(networks)
    loss = make_loss(network)
    if shared := single_weights(loss):
        raise ValueError(f"all agents would share the weights {', '.join(shared)} of the loss")
    if any(group.batch_size for group in groups_of(loss).values()):
        raise ValueError("the loss stacks networks along an axis before the lane axis")
    return network, loss, weights_of(loss)


def _select_weights(network: nn.Module, loss_weights: Weights, weights: Weights) -> Weights:
    """Return the weights that a network has in common with its loss, by their names in the network.

    A loss gives the network's tensors names of its own, so they are matched by their addresses in memory.

    Args:
        loss_weights: the tensors of the loss, by their names in the loss.
        weights: the tensors to return, by their names in the loss.
    """
    loss_names = {loss_weights[name].data_ptr(): name for name in weights}
    selected = {}
    for name, value in network.state_dict().items():
        loss_name = loss_names.get(value.data_ptr())
        if loss_name is not None:
            selected[name] = weights[loss_name]
    return selected
