"""GaussianNetwork: the acting network of continuous actions, with the scale by which it may be left."""

from typing import Any

import torch
from torch import Tensor, nn

_WITHIN = 0.99
"""The share of the bounds within which the first actions lie; at the bounds tanh has no slope."""


class GaussianNetwork(nn.Module):
    """A Gaussian policy: it acts by its mean, within bounds; losses read its standard deviation too.

    Args:
        network: a network with D outputs, of the means.
        low: the least value of each number of an action.
        high: the largest.
        scale: the standard deviation at first, in units of actions; it is the same whatever is observed.
        mean_rate: by which outputs for the mean are multiplied: the lower, the slower it moves.
        scale_rate: the same of the weight that is the logarithm of the scale.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        low: float,
        high: float,
        scale: float,
        mean_rate: float = 1.0,
        scale_rate: float = 1.0,
    ) -> None:
        super().__init__()
        self.network, self.low, self.high = network, low, high
        self.scale, self.mean_rate, self.scale_rate = scale, mean_rate, scale_rate
        self.widened = nn.Parameter(torch.zeros(()))

    def start_anywhere(self) -> None:
        """Moves the means to a uniformly random action, from torch's generator; for networks that end in a
        linear layer.

        Raises:
            ValueError: for another network.
        """
        last: Any = getattr(self.network, "linears", [None])[-1]
        if last is None:
            raise ValueError(f"network is a {type(self.network).__name__}; allowed: fully connected layers")
        with torch.no_grad():
            last.weight *= 0.1
            share = (torch.rand(len(last.bias)) * 2 - 1) * _WITHIN
            last.bias[:] = torch.atanh(share) / self.mean_rate

    def policy(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """[..., *shape] to the mean and the standard deviation, each [..., D]."""
        share = (self.mean_rate * self.network(observation)).tanh()
        action = self.low + (self.high - self.low) * 0.5 * (share + 1)
        widened = self.widened.view(*self.widened.shape, *[1] * (action.ndim - self.widened.ndim))
        return action, self.scale * (self.scale_rate * widened).exp().expand_as(action)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *shape] to actions [..., D], the mean."""
        return self.policy(observation)[0]


class GaussianPolicy(nn.Module):
    """A `GaussianNetwork` whose outputs are the mean and the standard deviation.

    Args:
        network: the network, whose weights it shares.
    """

    def __init__(self, network: GaussianNetwork) -> None:
        super().__init__()
        self.of = network

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Both."""
        return self.of.policy(observation)
