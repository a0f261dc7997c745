"""The networks of many lanes as one, whose parameters carry a lane axis."""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from cprl.networks.mlp import MLPNetwork


class StackedMLP(nn.Module):
    """L networks like `MLPNetwork` whose parameters carry a lane axis, [L, in, out] and [L, 1, out].

    A lane is one agent of one replica. Lanes do not influence each other: output l depends on input l and
    parameters l alone. R such stacks of S networks each stack to parameters [R, S, in, out], of L = R x S.
    """

    def __init__(self, networks: Sequence[MLPNetwork]) -> None:
        super().__init__()
        first = networks[0]
        refuse_other_forms(
            (network.highest, network.relu_on_outputs, *(layer.weight.shape for layer in network.linears))
            for network in networks
        )
        self.highest, self.relu_on_outputs = first.highest, first.relu_on_outputs
        self.observation_dims, self.outputs = first.observation_dims, first.outputs
        self._names = [name for name, layer in first.named_modules() if isinstance(layer, nn.Linear)]
        layers = list(zip(*(network.linears for network in networks), strict=True))
        self.weights = nn.ParameterList(
            [torch.stack([layer.weight.detach().T for layer in lanes]).contiguous() for lanes in layers]
        )
        self.biases = nn.ParameterList(
            [torch.stack([layer.bias.detach()[None] for layer in lanes]) for lanes in layers]
        )

    @property
    def lane_axis(self) -> int:
        """The place of the axis of S lanes: 0, or 1 after an axis of R stacks."""
        dims: int = self.weights[0].ndim
        return dims - 3

    def stacked(self, stacks: Sequence["StackedMLP"]) -> "StackedMLP":
        """R such networks as one; copies."""
        together = deepcopy(self)
        for name in ("weights", "biases"):
            by_layer = zip(*(getattr(stack, name) for stack in stacks), strict=True)
            layers = [torch.stack([one.detach() for one in of_layer]) for of_layer in by_layer]
            setattr(together, name, nn.ParameterList(layers))
        return together

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the weights of one lane, as the state dict of its `MLPNetwork`, or of its stack."""
        if self.lane_axis:
            return {name: value[lane].clone() for name, value in self.state_dict().items()}
        state = {}
        for name, weight, bias in zip(self._names, self.weights, self.biases, strict=True):
            state[f"{name}.weight"] = weight[lane].detach().T.clone()
            state[f"{name}.bias"] = bias[lane, 0].detach().clone()
        return state

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [L, C, X, Y] or [L, ..., C, X, Y] to [L, A] or [L, ..., A], in the parameters' type; [R, S]
        in place of [L] of R stacks."""
        weights, biases = ([layer.flatten(0, -3) for layer in group] for group in (self.weights, self.biases))
        flat = observation.flatten(-self.observation_dims)
        values = flat.reshape(len(weights[0]), -1, flat.shape[-1]).to(weights[0].dtype) / self.highest
        for place, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            values = torch.baddbmm(bias, values.relu() if place else values, weight)
        if self.relu_on_outputs:
            values = values.relu()
        return values.reshape(*flat.shape[:-1], values.shape[-1])


class StackedModules(nn.Module):
    """L networks of one architecture, vmapped over parameters with a lane axis, [L, ...]."""

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        first: Any = networks[0]
        if next(first.buffers(), None) is not None:
            raise ValueError(f"a {type(first).__name__} has buffers; allowed: parameters alone")
        refuse_other_forms(
            tuple((name, value.shape) for name, value in network.named_parameters()) for network in networks
        )
        self.lanes, self.observation_dims = len(networks), int(first.observation_dims)
        self.outputs = getattr(first, "outputs", None)
        self.state_shape = getattr(first, "state_shape", None)
        self._names = [name for name, _ in first.named_parameters()]
        self.__dict__["form"] = deepcopy(first)  # not a submodule: this module's weights are the stacked ones
        each = zip(*(network.parameters() for network in networks), strict=True)
        self.weights = nn.ParameterList([torch.stack([one.detach() for one in lanes]) for lanes in each])

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the weights of one lane, as the state dict of its network."""
        return {
            name: weight[lane].detach().clone()
            for name, weight in zip(self._names, self.weights, strict=True)
        }

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """[L, ..., *shape], or flat [L x b, *shape], to the outputs of the networks; recurrent ones also read
        and give what `cprl.networks.recurrent` says."""
        dims = self.observation_dims
        leading, shape = observation.shape[:-dims], observation.shape[-dims:]

        def output(weights: list[Tensor], *seen: Tensor) -> Any:
            named = dict(zip(self._names, weights, strict=True))
            return torch.func.functional_call(self.__dict__["form"], named, seen)

        if recurrent:
            apart = self.lanes, *((-1,) if len(leading) == 1 else leading[1:])
            by_lane = [
                entry.reshape(*apart, *entry.shape[len(leading) :]) for entry in (observation, *recurrent)
            ]
            each = torch.vmap(output)(list(self.weights), *by_lane)
            return tuple(given.reshape(*leading, *given.shape[len(apart) :]) for given in each)
        given = torch.vmap(output)(list(self.weights), observation.reshape(self.lanes, -1, *shape))
        return given.reshape(*leading, *given.shape[2:])


def stack_lanes(networks: Sequence[nn.Module]) -> nn.Module:
    """One network with the parameters of all lanes along a lane axis; copies."""
    first: Any = networks[0]
    if hasattr(first, "stacked"):
        itself: nn.Module = first.stacked(networks)
        return itself
    if _over(first) and all(type(network) is type(first) for network in networks):
        stack: Any = deepcopy(first)
        for part in _over(first):
            setattr(stack, part, stack_lanes([getattr(network, part) for network in networks]))
        for name, _ in first.named_parameters(recurse=False):
            weights = torch.stack([getattr(network, name).detach() for network in networks])
            setattr(stack, name, nn.Parameter(weights))
        return stack  # type: ignore[no-any-return]
    if all(isinstance(network, MLPNetwork) for network in networks):
        return StackedMLP(networks)  # type: ignore[arg-type]
    if not all(hasattr(network, "observation_dims") for network in networks):
        raise ValueError(
            f"a {type(first).__name__} lacks the attribute observation_dims, the axes of an observation"
        )
    return StackedModules(networks)


def lane_state(stack: nn.Module, lane: int) -> dict[str, Tensor]:
    """Copies of the weights of one lane of an acting network that `stack_lanes` made, as the state dict of
    the lane's network."""
    if _over(stack):
        weights = {
            name: value[lane].detach().clone() for name, value in stack.named_parameters(recurse=False)
        }
        buffers = {name: value.clone() for name, value in stack.named_buffers(recurse=False)}
        inner = {
            f"{part}.{name}": value
            for part in _over(stack)
            for name, value in lane_state(getattr(stack, part), lane).items()
        }
        return {**weights, **buffers, **inner}
    state: dict[str, Tensor] = stack.lane_state(lane)  # type: ignore[operator]
    return state


def _over(network: Any) -> list[str]:
    """The attributes of a network that computes with the outputs of others: `stacks_over` of its class names
    them, and its own weights get a lane axis in front."""
    names = getattr(network, "stacks_over", ())
    return [name for name in names if getattr(network, name) is not None]


def refuse_other_forms(forms: Iterable[object]) -> None:
    """Raises a ValueError unless all networks of a stack are of one form."""
    if (count := len(set(forms))) != 1:
        raise ValueError(f"the networks of the lanes have {count} architectures; allowed: 1")
