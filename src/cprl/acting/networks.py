"""Networks that read a window."""

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

BRIGHTEST = 255.0
"""Windows are uint8; networks see them divided by this, in 0..1."""


class QNetwork(nn.Module):
    """The value of each action, from an RGB window, by fully connected layers with ReLU.

    Args:
        window_shape: (3, X, Y) of a window.
        actions: how many actions A there are.
        hidden_cells: units of each hidden layer.
        relu_on_outputs: ReLU on the values too, as in the study as run.
        glorot_uniform: Glorot-uniform weights and zero biases, as in the study as run; else torch's default.
    """

    def __init__(
        self,
        window_shape: Sequence[int],
        actions: int,
        *,
        hidden_cells: Sequence[int] = (32, 32),
        relu_on_outputs: bool = False,
        glorot_uniform: bool = False,
    ) -> None:
        super().__init__()
        self.window_dims = len(window_shape)
        self.layers = MLP(
            in_features=prod(window_shape),
            out_features=actions,
            num_cells=list(hidden_cells),
            activation_class=nn.ReLU,
            activate_last_layer=relu_on_outputs,
        )
        if glorot_uniform:
            self.apply(_glorot_uniform)

    def forward(self, window: Tensor) -> Tensor:
        """uint8 [..., 3, X, Y] to float32 [..., A]."""
        seen = window.flatten(-self.window_dims).to(torch.float32) / BRIGHTEST
        return self.layers(seen)  # type: ignore[no-any-return]


def _glorot_uniform(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.xavier_uniform_(module.weight)
        nn.init.zeros_(module.bias)
