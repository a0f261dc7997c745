"""Recurrent networks: what an agent does depends on what it has seen since its episode began.

A recurrent network is called in two ways. With an observation and a state it takes one step. With `is_init`
as well, it takes the steps of sequences, whose time is the last axis before that of an observation: where
`is_init` is True a step begins with the state of its own entry, elsewhere with that of the step before. So a
sequence may hold several episodes, and may begin in the middle of one.
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
from cprl.networks.stacked import lane_state, refuse_other_forms, stack_lanes
from cprl.values import Value, Where

Kind = Literal["GRU", "LSTM"]
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
    """What reads the observation; its last hidden layer, with ReLU, is the input of the recurrent one."""
    recurrent_cells: Cells = 32
    """Units H of the recurrent layer."""
    kind: ClassVar[Kind]

    def make(
        self, spaces: Spaces, outputs: int, *, shape: Sequence[int] | None = None, **options: Unpack[Options]
    ) -> "RecurrentNetwork":
        """Return a new network."""
        for name, value in options.items():
            if value:
                raise ValueError(f"settings.{name} is True; allowed with a recurrent network: False")
        *hidden_cells, features = self.encoder.hidden_cells
        first = replace(self.encoder, hidden_cells=tuple(hidden_cells))
        encoder = first.make(spaces, features, relu_on_outputs=True, shape=shape)
        return RecurrentNetwork(encoder, outputs, kind=self.kind, recurrent_cells=self.recurrent_cells)


@dataclass(frozen=True, kw_only=True)
class GRU(Recurrent):
    """A layer of gated recurrent units; its state is the H numbers that it puts out.

    Source: Cho et al., "Learning Phrase Representations using RNN Encoder-Decoder for Statistical Machine
    Translation" (2014), in the form of `torch.nn.GRU`.
    """

    kind: ClassVar[Kind] = "GRU"


@dataclass(frozen=True, kw_only=True)
class LSTM(Recurrent):
    """A layer of long short-term memory; its state is 2 H numbers, those that it puts out and then its cells.

    Source: Hochreiter and Schmidhuber, "Long Short-Term Memory" (1997), with the forget gate of Gers et al.,
    "Learning to Forget" (2000), in the form of `torch.nn.LSTM`.
    """

    kind: ClassVar[Kind] = "LSTM"


class _Weights(NamedTuple):
    """The layers after the encoder, of L lanes: [L, in, out] and [L, 1, out]."""

    input: Tensor
    input_bias: Tensor
    state: Tensor
    state_bias: Tensor
    head: Tensor
    head_bias: Tensor


class RecurrentNetwork(nn.Module):
    """The network of a `GRU` or an `LSTM`.

    Args:
        encoder: a network with the attributes `outputs`, F of them, and `observation_dims`.
        recurrent_cells: units of the recurrent layer, H; the state of one agent has K numbers, H or 2 H.
    """

    def __init__(self, encoder: nn.Module, outputs: int, *, kind: Kind, recurrent_cells: int) -> None:
        super().__init__()
        of_encoder: Any = encoder
        self.encoder, self.outputs = encoder, outputs
        self.observation_dims: int = of_encoder.observation_dims
        self.state_shape = (2 * recurrent_cells if kind == "LSTM" else recurrent_cells,)
        """The shape of the state of one agent, (K,)."""
        make_cell = nn.LSTMCell if kind == "LSTM" else nn.GRUCell
        self.cell: nn.LSTMCell | nn.GRUCell = make_cell(of_encoder.outputs, recurrent_cells)
        self.head = nn.Linear(recurrent_cells, outputs)

    def forward(
        self, observation: Tensor, state: Tensor, is_init: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Takes one step, or the steps of sequences.

        Args:
            observation: uint8 or float [..., *shape]; of sequences [..., T, *shape].
            state: before each step, [..., K] or [..., T, K]; of a step that is not in `is_init` not read.
            is_init: bool [..., T], see the module; that of the first step of a sequence is taken for True.

        Returns:
            The outputs [..., A] or [..., T, A], and the states after each step, as `state`.
        """
        weights = _Weights(*(layer[None] for layer in _layers(self)))
        steps = 1 if is_init is None else is_init.shape[-1]
        return _outputs(weights, self.encoder(observation), state, is_init, (1, -1, steps))

    def stacked(self, networks: Sequence["RecurrentNetwork"]) -> "StackedRecurrent":
        """One network with the parameters of all lanes along a first axis; copies."""
        return StackedRecurrent(networks)


class StackedRecurrent(nn.Module):
    """L networks like `RecurrentNetwork` whose parameters carry a lane axis, [L, in, out] and [L, 1, out]."""

    def __init__(self, networks: Sequence[RecurrentNetwork]) -> None:
        super().__init__()
        first = networks[0]
        refuse_other_forms(tuple(value.shape for value in _layers(network)) for network in networks)
        self.lanes, self.outputs = len(networks), first.outputs
        self.observation_dims, self.state_shape = first.observation_dims, first.state_shape
        self.encoder = stack_lanes([network.encoder for network in networks])
        layers = zip(*map(_layers, networks), strict=True)
        self.weights = nn.ParameterList([torch.stack(lanes).detach().contiguous() for lanes in layers])

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the weights of one lane, as the state dict of its `RecurrentNetwork`."""
        state = {f"encoder.{name}": value for name, value in lane_state(self.encoder, lane).items()}
        for name, weight in zip(_NAMES, self.weights, strict=True):
            layer = weight[lane].detach().clone()
            state[name] = layer[0] if "bias" in name else layer.T.contiguous()
        return state

    def forward(
        self, observation: Tensor, state: Tensor, is_init: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """As `RecurrentNetwork.forward`, with a lane axis first: [L, ...], or all flat: [L x T, ...]."""
        dims, steps = self.observation_dims, 1
        leading, shape = observation.shape[:-dims], observation.shape[-dims:]
        if is_init is not None:
            steps = leading[-1] if len(leading) > 1 else leading[0] // self.lanes
        features = self.encoder(observation.reshape(self.lanes, -1, *shape))
        features = features.reshape(*leading, features.shape[-1])
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
    """The layers of one network after its encoder, without a lane axis."""
    weights = attrgetter(*_NAMES)(network)
    return _Weights(*(weight.T if weight.ndim > 1 else weight[None] for weight in weights))


def _outputs(
    weights: _Weights, features: Tensor, state: Tensor, is_init: Tensor | None, size: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """The outputs and the states after each step, of features [..., F] and states [..., K].

    Args:
        size: L, the sequences of each lane or -1, and the steps of each.
    """
    lanes, _, steps = size
    leading, numbers = features.shape[:-1], state.shape[-1]
    gates = torch.baddbmm(weights.input_bias, features.reshape(lanes, -1, features.shape[-1]), weights.input)
    gates, state = gates.view(lanes, -1, steps, gates.shape[-1]), state.reshape(*size, numbers)
    # Unbound once: the gradient of an index per step would be as large as the sequence.
    begins = None if is_init is None else is_init.reshape(*size, 1).unbind(2)
    now, after = state[:, :, 0], []
    for step, (of_input, given) in enumerate(zip(gates.unbind(2), state.unbind(2), strict=True)):
        if step and begins is not None:
            now = torch.where(begins[step], given, now)
        now = _step(weights, of_input, now)
        after.append(now)
    states = torch.stack(after, 2)
    cells = weights.state.shape[-2]
    put_out = states[..., :cells].reshape(lanes, -1, cells)
    outputs = torch.baddbmm(weights.head_bias, put_out, weights.head)
    return outputs.reshape(*leading, outputs.shape[-1]), states.reshape(*leading, numbers)


def _step(weights: _Weights, of_input: Tensor, state: Tensor) -> Tensor:
    """The states after a step, [L, n, K], by the formulas of `torch.nn.GRU` and `torch.nn.LSTM`."""
    cells, gates = weights.state.shape[-2:]
    before, memory = state[..., :cells], state[..., cells:]
    of_state = torch.baddbmm(weights.state_bias, before, weights.state)
    if gates == 3 * cells:
        reset, update = (of_input[..., : 2 * cells] + of_state[..., : 2 * cells]).sigmoid().chunk(2, -1)
        new = torch.addcmul(of_input[..., 2 * cells :], reset, of_state[..., 2 * cells :]).tanh()
        return torch.lerp(new, before, update)
    enters, stays, new, leaves = (of_input + of_state).chunk(4, -1)
    memory = torch.addcmul(stays.sigmoid() * memory, enters.sigmoid(), new.tanh())
    return torch.cat([leaves.sigmoid() * memory.tanh(), memory], -1)


def state_shape_of(network: nn.Module) -> tuple[int, ...] | None:
    """The shape of the state of a recurrent network, None for one that has no state."""
    return getattr(network, "state_shape", None)


def state_cells_of(network: nn.Module) -> int:
    """The numbers of the state of a recurrent network, 0 for one that has no state."""
    return (state_shape_of(network) or (0,))[-1]
