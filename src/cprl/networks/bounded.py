"""BoundedNetwork: a network whose outputs stay within bounds, e.g. as a continuous action."""

from torch import Tensor, nn

from cprl import arguments


class BoundedNetwork(nn.Module):
    """The outputs of a network through tanh, scaled to low..high: the acting network of continuous actions.

    Args:
        network: the network, with D outputs.
        low: the least value of each output.
        high: the largest.

    Raises:
        ValueError: for what is no network, and unless low is below high.
    """

    def __init__(self, network: nn.Module, *, low: float, high: float) -> None:
        super().__init__()
        arguments.object_of("network", network, nn.Module, "a torch.nn.Module")
        low = arguments.number("low", low, low=-1e9, high=1e9, allowed="a number in -1e9..1e9")
        high = arguments.number("high", high, low=low, high=1e9, above=True, allowed="a number above low")
        self.network, self.low, self.high = network, low, high

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *shape] to actions [..., D]."""
        outputs: Tensor = self.network(observation)
        return self.low + (self.high - self.low) * 0.5 * (outputs.tanh() + 1)
