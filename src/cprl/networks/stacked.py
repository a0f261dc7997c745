"""The networks of many lanes as one network, so that all lanes are computed together.

Lanes have networks of one architecture. `stack_lanes` stacks their parameters along a lane axis; `lane_state`
takes the weights of one lane out again.
"""

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from cprl.networks.mlp import MLPNetwork


@runtime_checkable
class MakesStack(Protocol):
    """A network that stacks the networks of lanes itself."""

    def make_stack(self, networks: Sequence[Any]) -> nn.Module:
        """Return one network with copies of the parameters of all `networks` along a first axis; its method
        `lane_state(lane)` takes the state dict of one of them out again."""


class StackedMLP(nn.Module):
    """L networks of one architecture, `MLPNetwork`, computed together by batched matrix products.

    Parameters have a lane axis: matrices [L, in, out] and biases [L, 1, out]. A lane is one agent of one
    replica. Lanes do not influence each other: output l depends on input l and parameters l alone.
    R stacks of S networks each can be stacked once more, to parameters [R, S, in, out]; then L = R x S.
    """

    def __init__(self, networks: Sequence[MLPNetwork]) -> None:
        super().__init__()
        first = networks[0]
        refuse_mixed_architectures(
            (network.highest, network.relu_on_outputs, parameter_shapes(network)) for network in networks
        )
        self.highest = first.highest
        self.relu_on_outputs = first.relu_on_outputs
        self.observation_dims = first.observation_dims
        self.outputs = first.outputs
        self._layer_names = [name for name, layer in first.named_modules() if isinstance(layer, nn.Linear)]
        """The names of the linear layers in an `MLPNetwork`, in the order of `weights` and `biases`."""
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for layers in zip(*(network.linears for network in networks), strict=True):
            self.weights.append(torch.stack([layer.weight.detach().T for layer in layers]).contiguous())
            self.biases.append(torch.stack([layer.bias.detach()[None] for layer in layers]))

    @property
    def lane_axis(self) -> int:
        """Return the index of the axis of lanes in the parameters: 0, or 1 after an axis of R stacks."""
        dims: int = self.weights[0].ndim
        return dims - 3

    def make_stack(self, networks: Sequence["StackedMLP"]) -> "StackedMLP":
        """Return R stacks as one stack with copies of their parameters, [R, S, ...]."""
        stack_of_stacks = deepcopy(self)
        stack_of_stacks.weights = _stack_each(stack.weights for stack in networks)
        stack_of_stacks.biases = _stack_each(stack.biases for stack in networks)
        return stack_of_stacks

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the weights at an index of the first axis: those of a lane, as the state dict of
        its `MLPNetwork`; of R stacks, those of a whole stack of S lanes, as its state dict."""
        if self.lane_axis:
            return {name: value[lane].clone() for name, value in self.state_dict().items()}
        state = {}
        for name, weight, bias in zip(self._layer_names, self.weights, self.biases, strict=True):
            state[f"{name}.weight"] = weight[lane].detach().T.clone()
            state[f"{name}.bias"] = bias[lane, 0].detach().clone()
        return state

    def forward(self, observation: Tensor) -> Tensor:
        """Map the observations of lanes, [L, ..., C, X, Y], to outputs [L, ..., A], in the parameters' dtype;
        R stacks have axes [R, S] in place of [L]."""
        weights = [weight.flatten(0, -3) for weight in self.weights]
        biases = [bias.flatten(0, -3) for bias in self.biases]
        flat = observation.flatten(-self.observation_dims)
        features = flat.reshape(len(weights[0]), -1, flat.shape[-1]).to(weights[0].dtype) / self.highest
        for depth, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            if depth > 0:
                features = features.relu()
            features = torch.baddbmm(bias, features, weight)
        if self.relu_on_outputs:
            features = features.relu()
        return features.reshape(*flat.shape[:-1], features.shape[-1])


class StackedModules(nn.Module):
    """L networks of any one architecture, computed together by `torch.vmap`.

    Parameters have a lane axis, [L, ...]. Networks with buffers, such as batch normalisation, are refused,
    since lanes would share them.
    """

    def __init__(self, networks: Sequence[nn.Module]) -> None:
        super().__init__()
        first: Any = networks[0]
        if next(first.buffers(), None) is not None:
            raise ValueError(f"a {type(first).__name__} has buffers; allowed: parameters alone")
        refuse_mixed_architectures(map(parameter_shapes, networks))
        self.lanes = len(networks)
        self.observation_dims = int(first.observation_dims)
        self.outputs = getattr(first, "outputs", None)
        self.state_shape = getattr(first, "state_shape", None)
        self._parameter_names = [name for name, _ in first.named_parameters()]
        """The names of a lane's parameters, in the order of `weights`."""
        # No submodule: the parameters of this module are the stacked ones, not those of the template.
        self.__dict__["template"] = deepcopy(first)
        self.weights = _stack_each(network.parameters() for network in networks)

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the weights of one lane, as the state dict of its network."""
        return {
            name: weight[lane].detach().clone()
            for name, weight in zip(self._parameter_names, self.weights, strict=True)
        }

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """Map the observations of lanes, [L, ..., *shape], or flat [L x b, *shape], to the networks' outputs.

        Recurrent networks also read a state and `is_init`, and return states, see `cprl.networks.recurrent`.
        """
        batch_shape = observation.shape[: -self.observation_dims]
        observation_shape = observation.shape[len(batch_shape) :]
        vmapped = torch.vmap(self._call_template)
        if not recurrent:
            by_lane = observation.reshape(self.lanes, -1, *observation_shape)
            outputs = vmapped(list(self.weights), by_lane)
            return outputs.reshape(*batch_shape, *outputs.shape[2:])
        lane_shape = self.lanes, *((-1,) if len(batch_shape) == 1 else batch_shape[1:])
        inputs = [
            entry.reshape(*lane_shape, *entry.shape[len(batch_shape) :])
            for entry in (observation, *recurrent)
        ]
        results = vmapped(list(self.weights), *inputs)
        return tuple(result.reshape(*batch_shape, *result.shape[len(lane_shape) :]) for result in results)

    def _call_template(self, weights: list[Tensor], *inputs: Tensor) -> Any:
        """Return the outputs of one lane's network, by its weights in the order of `_parameter_names`."""
        by_name = dict(zip(self._parameter_names, weights, strict=True))
        return torch.func.functional_call(self.__dict__["template"], by_name, inputs)


def stack_lanes(networks: Sequence[nn.Module]) -> nn.Module:
    """Return one network with copies of the parameters of all lanes along a lane axis.

    Its class depends on the networks of the lanes: what `make_stack` of the first returns, if it is a
    `MakesStack`; a network of the same class whose inner networks are stacked, where the class names these
    in `inner_network_names`; a `StackedMLP` of `MLPNetwork`s; else a `StackedModules`.

    Raises:
        ValueError: if the lanes' networks have several architectures, or cannot be stacked.
    """
    first: Any = networks[0]
    if isinstance(first, MakesStack):
        return first.make_stack(networks)
    inner_names = _inner_names(first)
    if inner_names and all(type(network) is type(first) for network in networks):
        return _stack_around_inner(networks, inner_names)
    if all(isinstance(network, MLPNetwork) for network in networks):
        return StackedMLP(networks)  # type: ignore[arg-type]
    if not all(hasattr(network, "observation_dims") for network in networks):
        raise ValueError(
            f"a {type(first).__name__} lacks the attribute observation_dims, the axes of an observation"
        )
    return StackedModules(networks)


def _stack_around_inner(networks: Sequence[nn.Module], inner_names: Sequence[str]) -> nn.Module:
    """Return one network of the same class, whose inner networks are stacked each by itself.

    The parameters around them get a lane axis in front. Buffers are those of the first network: they must be
    the same constants in all lanes.
    """
    stack = deepcopy(networks[0])
    for name in inner_names:
        setattr(stack, name, stack_lanes([getattr(network, name) for network in networks]))
    for name, _ in networks[0].named_parameters(recurse=False):
        weights = torch.stack([getattr(network, name).detach() for network in networks])
        setattr(stack, name, nn.Parameter(weights))
    return stack


def lane_state(stack: nn.Module, lane: int) -> dict[str, Tensor]:
    """Return copies of the weights of one lane of a network that `stack_lanes` made, as the state dict of the
    lane's network."""
    inner_names = _inner_names(stack)
    if not inner_names:
        return stack.lane_state(lane)  # type: ignore[operator]
    weights = {name: value[lane].detach().clone() for name, value in stack.named_parameters(recurse=False)}
    buffers = {name: value.clone() for name, value in stack.named_buffers(recurse=False)}
    inner_weights = {
        f"{inner_name}.{name}": value
        for inner_name in inner_names
        for name, value in lane_state(getattr(stack, inner_name), lane).items()
    }
    return {**weights, **buffers, **inner_weights}


def _inner_names(network: Any) -> list[str]:
    """Return the names of the attributes that hold the inner networks of a network.

    A network that computes with the outputs of other networks lists them in its attribute
    `inner_network_names`; one of them may be None.
    """
    names = getattr(network, "inner_network_names", ())
    return [name for name in names if getattr(network, name) is not None]


def _stack_each(lists: Iterable[Iterable[Tensor]]) -> nn.ParameterList:
    """Return copies of tensors, stacked: the first tensors of all lists, their second ones, and so on."""
    stacks = nn.ParameterList()
    for tensors in zip(*lists, strict=True):
        stacks.append(torch.stack([tensor.detach() for tensor in tensors]))
    return stacks


def parameter_shapes(network: nn.Module) -> tuple[tuple[str, torch.Size], ...]:
    """Return the name and the shape of each parameter of a network."""
    return tuple((name, value.shape) for name, value in network.named_parameters())


def refuse_mixed_architectures(architectures: Iterable[object]) -> None:
    """Raise a ValueError unless all networks of a stack have one architecture, given as a hashable value for
    each network."""
    if (count := len(set(architectures))) != 1:
        raise ValueError(f"the networks of the lanes have {count} architectures; allowed: 1")
