"""Recurrent networks, `GRU` and `LSTM`: agents act by all that they have seen since their episode began.

A recurrent network is called in two ways. With an observation and a state it takes one step. With `is_init`
as well, it takes all steps of sequences, whose time axis stands directly before the axes of an observation.
A step where `is_init` is True starts from the state that is passed for this step; any other step starts from
the state that the step before it left. So a sequence may hold several episodes, and may begin in the middle
of one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Unpack

import torch
from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.networks.convolutional import Conv
from cprl.networks.mlp import MLP, Cells, Options
from cprl.networks.stacked import lane_state, parameter_shapes, refuse_mixed_architectures, stack_lanes
from cprl.values import Value, Where

_Kind = Literal["GRU", "LSTM"]
Encoder = Annotated[
    MLP | Conv,
    Where(lambda encoder: len(encoder.hidden_cells) > 0, "MLP or Conv, with at least one of hidden_cells"),
]


@dataclass(frozen=True, kw_only=True)
class Recurrent(Value, stored=False):
    """A recurrent layer between an encoder of observations and a linear layer: a `GRU` or an `LSTM`.

    Its state is zero where an episode begins.
    """

    encoder: Encoder = MLP(hidden_cells=(32,))  # noqa: RUF009 - a frozen value
    """The network that reads the observation; its last hidden layer, with ReLU, is the input of the recurrent
    layer."""
    recurrent_cells: Cells = 32
    """Units H of the recurrent layer."""
    kind: ClassVar[_Kind]

    def make(self, spaces: Spaces, outputs: int, **options: Unpack[Options]) -> "RecurrentNetwork":
        """Return a new network.

        Args:
            outputs: the number of outputs.

        Raises:
            ValueError: if an option is set: recurrent networks have none.
        """
        for name, value in options.items():
            if value:
                raise ValueError(f"settings.{name} is True; allowed with a recurrent network: False")
        *hidden_cells, features = self.encoder.hidden_cells
        # The encoder's last hidden layer becomes its output layer, with ReLU.
        without_last = replace(self.encoder, hidden_cells=tuple(hidden_cells))
        encoder = without_last.make(spaces, features, relu_on_outputs=True)
        return RecurrentNetwork(encoder, outputs, kind=self.kind, recurrent_cells=self.recurrent_cells)


@dataclass(frozen=True, kw_only=True)
class GRU(Recurrent):
    """A layer of gated recurrent units; its state is its H outputs.

    Source: Cho et al., "Learning Phrase Representations using RNN Encoder-Decoder for Statistical Machine
    Translation" (2014), in the form of `torch.nn.GRU`.
    """

    kind: ClassVar[_Kind] = "GRU"


@dataclass(frozen=True, kw_only=True)
class LSTM(Recurrent):
    """A layer of long short-term memory; its state is 2 H numbers, its H outputs and then its H memory cells.

    Source: Hochreiter and Schmidhuber, "Long Short-Term Memory" (1997), with the forget gate of Gers et al.,
    "Learning to Forget" (2000), in the form of `torch.nn.LSTM`.
    """

    kind: ClassVar[_Kind] = "LSTM"


class _Weights(NamedTuple):
    """The weights after the encoder, of L lanes: matrices [L, in, out] and biases [L, 1, out].

    G is the number of gates times H: 3 H in a GRU, 4 H in an LSTM.
    """

    input: Tensor
    """From the encoder's features to the gates, [L, F, G]."""
    input_bias: Tensor
    state: Tensor
    """From the layer's last outputs to the gates, [L, H, G]."""
    state_bias: Tensor
    head: Tensor
    """From the layer's outputs to those of the network, [L, H, A]."""
    head_bias: Tensor


class RecurrentNetwork(nn.Module):
    """Maps observations and a state to outputs and the next state, by a `GRU` or an `LSTM`.

    Args:
        encoder: maps observations to F features; has the attributes `outputs`, F, and `observation_dims`.
        outputs: the number of outputs A.
        kind: the recurrent layer.
        recurrent_cells: units of the recurrent layer, H; the state of one agent has K numbers, H for a GRU
            and 2 H for an LSTM.
    """

    def __init__(self, encoder: nn.Module, outputs: int, *, kind: _Kind, recurrent_cells: int) -> None:
        super().__init__()
        first: Any = encoder
        self.encoder = encoder
        self.outputs = outputs
        self.observation_dims: int = first.observation_dims
        self.state_shape = (2 * recurrent_cells if kind == "LSTM" else recurrent_cells,)
        """The shape of the state of one agent, (K,)."""
        make_cell = nn.LSTMCell if kind == "LSTM" else nn.GRUCell
        self.cell: nn.LSTMCell | nn.GRUCell = make_cell(first.outputs, recurrent_cells)
        self.head = nn.Linear(recurrent_cells, outputs)

    def forward(
        self, observation: Tensor, state: Tensor, is_init: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Take one step, or the steps of sequences.

        Args:
            observation: uint8 or float [..., *shape]; [..., T, *shape] for sequences.
            state: the state before each step, [..., K] or [..., T, K]; read only where `is_init` is True.
            is_init: bool [..., T], the steps that start from `state`; the first step of a sequence always
                does. None for one step.

        Returns:
            The outputs [..., A] or [..., T, A], and the states after each step, in the shape of `state`.
        """
        weights = _Weights(*(layer[None] for layer in _layers(self)))
        steps = 1 if is_init is None else is_init.shape[-1]
        return _outputs(weights, self.encoder(observation), state, is_init, (1, -1, steps))

    def make_stack(self, networks: Sequence["RecurrentNetwork"]) -> "StackedRecurrent":
        """Return one network with the parameters of all lanes along a first axis; copies."""
        return StackedRecurrent(networks)


class StackedRecurrent(nn.Module):
    """L networks of one architecture, `RecurrentNetwork`, computed together.

    Parameters have a lane axis: matrices [L, in, out] and biases [L, 1, out].
    """

    def __init__(self, networks: Sequence[RecurrentNetwork]) -> None:
        super().__init__()
        first = networks[0]
        refuse_mixed_architectures(map(parameter_shapes, networks))
        self.lanes = len(networks)
        self.outputs = first.outputs
        self.observation_dims = first.observation_dims
        self.state_shape = first.state_shape
        self.encoder = stack_lanes([network.encoder for network in networks])
        layers = zip(*map(_layers, networks), strict=True)
        self.weights = nn.ParameterList([torch.stack(lanes).detach().contiguous() for lanes in layers])

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the weights of one lane, as the state dict of its `RecurrentNetwork`."""
        state = {f"encoder.{name}": value for name, value in lane_state(self.encoder, lane).items()}
        for name, weight in zip(_NAMES, self.weights, strict=True):
            layer = weight[lane].detach().clone()
            state[name] = layer[0] if "bias" in name else layer.T.contiguous()
        return state

    def forward(
        self, observation: Tensor, state: Tensor, is_init: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Compute `RecurrentNetwork.forward` of each lane, of inputs with a lane axis in front: [L, ...], or
        flat with the axis of time, [L x T, ...]."""
        batch_shape = observation.shape[: -self.observation_dims]
        observation_shape = observation.shape[len(batch_shape) :]
        steps = 1
        if is_init is not None:
            steps = batch_shape[-1] if len(batch_shape) > 1 else batch_shape[0] // self.lanes
        features = self.encoder(observation.reshape(self.lanes, -1, *observation_shape))
        features = features.reshape(*batch_shape, features.shape[-1])
        return _outputs(_Weights(*self.weights), features, state, is_init, (self.lanes, -1, steps))


_NAMES: Final = (
    "cell.weight_ih",
    "cell.bias_ih",
    "cell.weight_hh",
    "cell.bias_hh",
    "head.weight",
    "head.bias",
)
"""The parameters after the encoder, in the order of `_Weights`."""


def _layers(network: RecurrentNetwork) -> _Weights:
    """Return the weights of one network after its encoder: matrices [in, out], biases [1, out]."""
    weights = attrgetter(*_NAMES)(network)
    return _Weights(*(weight.T if weight.ndim > 1 else weight[None] for weight in weights))


def _outputs(
    weights: _Weights, features: Tensor, state: Tensor, is_init: Tensor | None, size: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """Return the outputs and the states after each step, from features [..., F] and states [..., K].

    Args:
        size: (L, n, T): the lanes, the sequences of each lane or -1, and the steps of each sequence.
    """
    lanes, _, steps = size
    batch_shape = features.shape[:-1]
    state_size = state.shape[-1]
    # What the gates get from the input does not depend on the state: one product for all steps.
    gates = torch.baddbmm(weights.input_bias, features.reshape(lanes, -1, features.shape[-1]), weights.input)
    gates = gates.view(lanes, -1, steps, gates.shape[-1])
    state = state.reshape(*size, state_size)
    # Unbound once: the gradient of an index per step would be as large as the sequence.
    step_begins = None if is_init is None else is_init.reshape(*size, 1).unbind(2)
    current = state[:, :, 0]
    states_after = []
    for step, (from_input, given_state) in enumerate(zip(gates.unbind(2), state.unbind(2), strict=True)):
        if step and step_begins is not None:
            current = torch.where(step_begins[step], given_state, current)
        current = _step(weights, from_input, current)
        states_after.append(current)
    states = torch.stack(states_after, 2)
    cells = weights.state.shape[-2]
    layer_outputs = states[..., :cells].reshape(lanes, -1, cells)
    outputs = torch.baddbmm(weights.head_bias, layer_outputs, weights.head)
    return outputs.reshape(*batch_shape, outputs.shape[-1]), states.reshape(*batch_shape, state_size)


def _step(weights: _Weights, from_input: Tensor, state: Tensor) -> Tensor:
    """Return the states after a step, [L, n, K], by the formulas of `torch.nn.GRU` and `torch.nn.LSTM`.

    Args:
        from_input: what the gates get from the input, [L, n, G].
        state: the states before the step, [L, n, K].
    """
    cells, gates = weights.state.shape[-2:]
    last_output = state[..., :cells]
    memory = state[..., cells:]  # empty in a GRU
    from_state = torch.baddbmm(weights.state_bias, last_output, weights.state)
    if gates == 3 * cells:  # a GRU
        reset, update = (from_input[..., : 2 * cells] + from_state[..., : 2 * cells]).sigmoid().chunk(2, -1)
        new = torch.addcmul(from_input[..., 2 * cells :], reset, from_state[..., 2 * cells :]).tanh()
        return torch.lerp(new, last_output, update)
    input_gate, forget_gate, new, output_gate = (from_input + from_state).chunk(4, -1)
    memory = torch.addcmul(forget_gate.sigmoid() * memory, input_gate.sigmoid(), new.tanh())
    return torch.cat([output_gate.sigmoid() * memory.tanh(), memory], -1)


def state_shape_of(network: nn.Module) -> tuple[int, ...] | None:
    """Return the shape of a recurrent network's state, e.g. (K,) for one agent; None if it has no state."""
    return getattr(network, "state_shape", None)


def state_cells_of(network: nn.Module) -> int:
    """Return the numbers in one agent's state in a recurrent network; 0 if the network has no state."""
    return (state_shape_of(network) or (0,))[-1]
