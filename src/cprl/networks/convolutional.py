"""Convolutional networks over the rows and columns of an observation."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import prod
from typing import Annotated, Any, Unpack

from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.networks.mlp import MOST_CELLS, MOST_LAYERS, Layers, Options, glorot_uniform_, layers
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

    def make(
        self, spaces: Spaces, outputs: int, *, shape: Sequence[int] | None = None, **options: Unpack[Options]
    ) -> "ConvNetwork":
        """Return a new network; raises a ValueError if observations have no rows and columns."""
        shape = shape or spaces.observation_shape
        if len(shape) < 3:
            raise ValueError(
                f"observations have the shape {list(shape)}; allowed for Conv: channels, rows and columns; "
                "use MLP"
            )
        return ConvNetwork(self, shape, outputs, highest=spaces.observation_scale, **options)


class ConvNetwork(nn.Module):
    """The network of a `Conv`.

    Args:
        observation_shape: (C, X, Y), or (S, C, X, Y) for S observations, whose channels are concatenated.
        highest: the largest value of an observation; inputs are divided by it.
    """

    def __init__(
        self,
        form: Conv,
        observation_shape: Sequence[int],
        outputs: int,
        *,
        highest: float = 255.0,
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.highest, self.outputs, self.observation_dims = highest, outputs, len(observation_shape)
        *planes, rows, columns = observation_shape
        steps = list(pairwise((prod(planes), *form.channels)))
        features = form.channels[-1] * rows * columns
        self._window = prod(planes), rows, columns
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, form.kernel_cells, padding=form.kernel_cells // 2)
            for before, after in steps
        )
        self.layers = layers(features, outputs, form.hidden_cells, relu_on_outputs=relu_on_outputs)
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
