"""Convolutional networks over the rows and columns of an observation."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Annotated, Any

from torch import Tensor, nn
from torchrl import modules

from cprl.commons.spaces import Spaces
from cprl.networks.mlp import MOST_CELLS, MOST_LAYERS, Layers, check_size, glorot_uniform_
from cprl.values import Value, Where

Channels = Annotated[
    Layers,
    Where(
        lambda channels: len(channels) > 0,
        f"1 to {MOST_LAYERS} layers, each an integer in 1..{MOST_CELLS}",
    ),
]
Kernel = Annotated[int, Where(lambda cells: 1 <= cells <= 999 and cells % 2 == 1, "1, 3, 5 and so on")]


@dataclass(frozen=True, kw_only=True)
class Conv(Value):
    """Convolutions that keep the size of the window, then fully connected layers; ReLU after each."""

    channels: Channels = (16, 16)
    """Channels of each convolution."""
    kernel_cells: Kernel = 3
    """Rows and columns of a kernel."""
    hidden_cells: Layers = (32,)
    """Units of each fully connected layer after the convolutions."""

    def make(
        self,
        spaces: Spaces,
        outputs: int,
        *,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
        shape: Sequence[int] | None = None,
    ) -> "ConvNetwork":
        """A new network.

        Raises:
            ValueError: if observations have no rows and columns.
        """
        shape = tuple(spaces.observation_shape if shape is None else shape)
        if len(shape) < 3:
            raise ValueError(
                f"observations have the shape {list(shape)}; allowed for Conv: channels, rows and columns; "
                "use MLP"
            )
        return ConvNetwork(
            shape,
            outputs,
            channels=self.channels,
            kernel_cells=self.kernel_cells,
            hidden_cells=self.hidden_cells,
            highest=spaces.observation_scale,
            relu_on_outputs=relu_on_outputs,
            glorot_uniform=glorot_uniform,
        )


class ConvNetwork(nn.Module):
    """The network of a `Conv`.

    Args:
        observation_shape: (C, X, Y), or (S, C, X, Y) for S observations, whose channels are concatenated.
        highest: the largest value of an observation; inputs are divided by it.
        relu_on_outputs: whether the outputs pass through ReLU too.
        glorot_uniform: whether weights are initialised Glorot-uniform and biases to zero; else torch's
            default.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        outputs: int,
        *,
        channels: Sequence[int] = (16, 16),
        kernel_cells: int = 3,
        hidden_cells: Sequence[int] = (32,),
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest, self.outputs, self.observation_dims = highest, outputs, len(observation_shape)
        *planes, rows, columns = observation_shape
        check_size(
            (channels[-1] * rows * columns, *hidden_cells, outputs),
            more=kernel_cells**2 * sum(a * b for a, b in pairwise((prod(planes), *channels))),
        )
        self._window = prod(planes), rows, columns
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, kernel_cells, padding=kernel_cells // 2)
            for before, after in pairwise((prod(planes), *channels))
        )
        self.layers = modules.MLP(
            in_features=channels[-1] * rows * columns,
            out_features=outputs,
            num_cells=list(hidden_cells),
            activation_class=nn.ReLU,
            activate_last_layer=relu_on_outputs,
        )
        if glorot_uniform:
            self.apply(glorot_uniform_)

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 or float [..., C, X, Y] to [..., A], in the parameters' type."""
        leading = observation.shape[: -self.observation_dims]
        first: Any = self.convolutions[0]
        values = observation.reshape(-1, *self._window).to(first.weight.dtype) / self.highest
        for convolution in self.convolutions:
            values = convolution(values).relu()
        outputs: Tensor = self.layers(values.flatten(1))
        return outputs.reshape(*leading, self.outputs)
