"""Fully connected networks."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Annotated, Final, TypedDict, Unpack

from torch import Tensor, nn
from torchrl import modules

from cprl.commons.spaces import Spaces
from cprl.values import Range, Value, Where

MOST_LAYERS: Final = 64
MOST_CELLS: Final = 2**16
"""Of one layer."""

Cells = Annotated[int, Range(1, MOST_CELLS)]
Layers = Annotated[
    tuple[Cells, ...],
    Where(
        lambda layers: len(layers) <= MOST_LAYERS,
        f"0 to {MOST_LAYERS} layers, each an integer in 1..{MOST_CELLS}",
    ),
]
"""Units of each hidden layer; none is a linear network."""


class Options(TypedDict, total=False):
    """What algorithms say of the networks that they have made."""

    relu_on_outputs: bool
    """Whether the outputs pass through ReLU too, as in the program of the study."""
    glorot_uniform: bool
    """Whether weights are initialised Glorot-uniform and biases to zero, as in the program of the study; else
    torch's default."""


@dataclass(frozen=True, kw_only=True)
class MLP(Value):
    """Fully connected layers with ReLU."""

    hidden_cells: Layers = (32, 32)
    """Units of each hidden layer."""

    def make(
        self, spaces: Spaces, outputs: int, *, shape: Sequence[int] | None = None, **options: Unpack[Options]
    ) -> "MLPNetwork":
        """Return a new network of observations, or of inputs of another shape."""
        shape, highest = shape or spaces.observation_shape, spaces.observation_scale
        return MLPNetwork(shape, outputs, hidden_cells=self.hidden_cells, highest=highest, **options)


class MLPNetwork(nn.Module):
    """Action values from an observation: fully connected layers with ReLU.

    Args:
        observation_shape: (C, X, Y) of an observation, `Game.observation_shape`.
        highest: the largest value of an observation, `Observation.highest`; inputs are divided by it.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        actions: int,
        *,
        hidden_cells: Sequence[int] = (32, 32),
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest, self.relu_on_outputs = highest, relu_on_outputs
        self.observation_dims, self.outputs = len(observation_shape), actions
        self.layers = layers(prod(observation_shape), actions, hidden_cells, relu_on_outputs=relu_on_outputs)
        if glorot_uniform:
            self.apply(glorot_uniform_)

    @property
    def linears(self) -> list[nn.Linear]:
        """The layers with weights, first to last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., A], in the parameters' type."""
        seen = observation.flatten(-self.observation_dims).to(self.linears[0].weight.dtype) / self.highest
        return self.layers(seen)  # type: ignore[no-any-return]


def layers(inputs: int, outputs: int, cells: Sequence[int], *, relu_on_outputs: bool) -> modules.MLP:
    """Return fully connected layers with ReLU between them."""
    return modules.MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(cells),
        activation_class=nn.ReLU,
        activate_last_layer=relu_on_outputs,
    )


def glorot_uniform_(module: nn.Module) -> None:
    """Initialises a layer's weights Glorot-uniform and its biases to zero."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.xavier_uniform_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
