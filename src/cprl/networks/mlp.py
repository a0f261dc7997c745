"""Fully connected networks: `MLP`, what an algorithm's `network` says, and `MLPNetwork`, the torch module."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Annotated, Final, TypedDict, Unpack

from torch import Tensor, nn
from torchrl import modules

from cprl.commons.spaces import Spaces
from cprl.values import Range, Value, Where

MOST_LAYERS: Final = 64
"""The largest number of hidden layers."""
MOST_CELLS: Final = 2**16
"""The largest number of units of one layer."""

Cells = Annotated[int, Range(1, MOST_CELLS)]
Layers = Annotated[
    tuple[Cells, ...],
    Where(
        lambda hidden_cells: len(hidden_cells) <= MOST_LAYERS,
        f"0 to {MOST_LAYERS} layers, each an integer in 1..{MOST_CELLS}",
    ),
]
"""Units of each hidden layer, e.g. (32, 32); () is a linear network."""


class Options(TypedDict, total=False):
    """Options that algorithms pass to all of their networks.

    Both reproduce details of the program that Wiatrak (2019) ran, see `cprl.learners.settings.DQNSettings`.
    """

    relu_on_outputs: bool
    """True if the outputs pass through ReLU too, as they do in that program; else they do not."""
    glorot_uniform: bool
    """True if weights are initialised Glorot-uniform and biases to zero, as they are in that program; else by
    torch's default."""


@dataclass(frozen=True, kw_only=True)
class MLP(Value):
    """Fully connected layers with ReLU."""

    hidden_cells: Layers = (32, 32)
    """Units of each hidden layer."""

    def make(self, spaces: Spaces, outputs: int, **options: Unpack[Options]) -> "MLPNetwork":
        """Return a new network.

        Args:
            outputs: the number of outputs.
        """
        return MLPNetwork(
            spaces.observation_shape,
            outputs,
            hidden_cells=self.hidden_cells,
            highest=spaces.observation_scale,
            **options,
        )


class MLPNetwork(nn.Module):
    """Maps observations to a number of outputs, e.g. action values: fully connected layers with ReLU.

    Args:
        observation_shape: (C, X, Y) of an observation, `Game.observation_shape`.
        outputs: the number of outputs: A for action values, 1 for a critic.
        hidden_cells: units of each hidden layer.
        highest: the largest value of an observation, `Observation.highest`; inputs are divided by it.
        relu_on_outputs: see `Options`, also for `glorot_uniform`.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        outputs: int,
        *,
        hidden_cells: Sequence[int] = (32, 32),
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest = highest
        self.relu_on_outputs = relu_on_outputs
        self.observation_dims = len(observation_shape)
        self.outputs = outputs
        self.layers = make_layers(
            prod(observation_shape), outputs, hidden_cells, relu_on_outputs=relu_on_outputs
        )
        if glorot_uniform:
            self.apply(glorot_uniform_)

    @property
    def linears(self) -> list[nn.Linear]:
        """Return the layers with weights, first to last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations, uint8 or float [..., C, X, Y], to [..., outputs], in the parameters' dtype."""
        features = observation.flatten(-self.observation_dims)
        scaled = features.to(self.linears[0].weight.dtype) / self.highest
        return self.layers(scaled)


def make_layers(
    inputs: int, outputs: int, hidden_cells: Sequence[int], *, relu_on_outputs: bool
) -> modules.MLP:
    """Return fully connected layers with ReLU between them."""
    return modules.MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(hidden_cells),
        activation_class=nn.ReLU,
        activate_last_layer=relu_on_outputs,
    )


def glorot_uniform_(module: nn.Module) -> None:
    """Initialise a layer's weights Glorot-uniform and its biases to zero."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
