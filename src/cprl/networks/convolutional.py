"""Convolutional networks over the rows and columns of an observation: `Conv`, what an algorithm's `network`
says, and `ConvNetwork`, the torch module."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Annotated, Any, Unpack

from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.networks.mlp import MOST_CELLS, MOST_LAYERS, Layers, Options, glorot_uniform_, make_layers
from cprl.values import Value, Where

Channels = Annotated[Layers, Where(bool, f"1 to {MOST_LAYERS} layers, each an integer in 1..{MOST_CELLS}")]
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

    def make(self, spaces: Spaces, outputs: int, **options: Unpack[Options]) -> "ConvNetwork":
        """Return a new network.

        Args:
            outputs: the number of outputs.

        Raises:
            ValueError: if inputs have no rows and columns.
        """
        shape = spaces.observation_shape
        if len(shape) < 3:
            raise ValueError(
                f"observations have the shape {list(shape)}; allowed for Conv: channels, rows and columns; "
                "use MLP"
            )
        return ConvNetwork(self, shape, outputs, highest=spaces.observation_scale, **options)


class ConvNetwork(nn.Module):
    """Maps observations to a number of outputs by convolutions and fully connected layers.

    Args:
        specification: says the layers.
        observation_shape: (C, X, Y), or (S, C, X, Y) for S observations, whose channels are concatenated.
        outputs: the number of outputs: A for action values, 1 for a critic.
        highest: the largest value of an observation; inputs are divided by it.
        relu_on_outputs: see `cprl.networks.mlp.Options`, also for `glorot_uniform`.
    """

    def __init__(
        self,
        specification: Conv,
        observation_shape: Sequence[int],
        outputs: int,
        *,
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest = highest
        self.outputs = outputs
        self.observation_dims = len(observation_shape)
        *channel_axes, rows, columns = observation_shape
        in_channels = prod(channel_axes)
        self._input_shape = in_channels, rows, columns
        kernel = specification.kernel_cells
        self.convolutions = nn.ModuleList(
            nn.Conv2d(channels, next_channels, kernel, padding=kernel // 2)
            for channels, next_channels in pairwise((in_channels, *specification.channels))
        )
        features = specification.channels[-1] * rows * columns
        self.layers = make_layers(
            features, outputs, specification.hidden_cells, relu_on_outputs=relu_on_outputs
        )
        if glorot_uniform:
            self.apply(glorot_uniform_)

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations, uint8 or float [..., C, X, Y], to [..., outputs], in the parameters' dtype."""
        batch_shape = observation.shape[: -self.observation_dims]
        first: Any = self.convolutions[0]
        features = observation.reshape(-1, *self._input_shape).to(first.weight.dtype) / self.highest
        for convolution in self.convolutions:
            features = convolution(features).relu()
        outputs: Tensor = self.layers(features.flatten(1))
        return outputs.reshape(*batch_shape, self.outputs)
