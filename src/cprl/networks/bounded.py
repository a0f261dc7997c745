"""BoundedNetwork: a network whose outputs stay within bounds, e.g. as a continuous action."""

from torch import Tensor, nn


class BoundedNetwork(nn.Module):
    """The outputs of a network through tanh, scaled to low..high: the acting network of continuous actions.

    Args:
        network: the network, with D outputs.
        low: the least value of each output.
        high: the largest.
    """

    def __init__(self, network: nn.Module, *, low: float, high: float) -> None:
        super().__init__()
        self.network, self.low, self.high = network, low, high

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *shape] to actions [..., D]."""
        outputs: Tensor = self.network(observation)
        return self.low + (self.high - self.low) * 0.5 * (outputs.tanh() + 1)
