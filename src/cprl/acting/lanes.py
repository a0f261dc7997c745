"""LaneQNetwork: many independent networks of one shape as one, by batched matrix products."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cprl.acting.networks import QNetwork


class LaneQNetwork(nn.Module):
    """L networks like `QNetwork` whose parameters carry a lane axis, [L, in, out] and [L, 1, out].

    A lane is one agent of one replica; nothing crosses lanes: output l follows from input l and the
    parameters l alone.

    Args:
        networks: the networks of the lanes, of one shape; their weights are copied.

    Raises:
        ValueError: where the networks differ in shape.
    """

    def __init__(self, networks: Sequence[QNetwork]) -> None:
        super().__init__()
        first = networks[0]
        forms = {(network.highest, network.relu_on_outputs, *_shapes(network)) for network in networks}
        if len(forms) != 1:
            raise ValueError(f"the networks of the lanes have {len(forms)} different forms; one is wanted")
        self.highest, self.relu_on_outputs = first.highest, first.relu_on_outputs
        self.observation_dims = first.observation_dims
        layers = list(zip(*(network.linears for network in networks), strict=True))
        self.weights = nn.ParameterList(
            [torch.stack([layer.weight.detach().T for layer in lanes]).contiguous() for lanes in layers]
        )
        self.biases = nn.ParameterList(
            [torch.stack([layer.bias.detach()[None] for layer in lanes]) for lanes in layers]
        )

    @property
    def lanes(self) -> int:
        """The number of lanes L."""
        return len(self.weights[0])

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [L, C, X, Y] or [L, b, C, X, Y] to [L, A] or [L, b, A], in the parameters' type."""
        flat = observation.flatten(-self.observation_dims)
        values = flat.reshape(self.lanes, -1, flat.shape[-1]).to(self.weights[0].dtype) / self.highest
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias, values, weight)
            if layer < last or self.relu_on_outputs:
                values = values.relu()
        return values.reshape(*flat.shape[:-1], values.shape[-1])


def _shapes(network: QNetwork) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(layer.weight.shape) for layer in network.linears)
