"""Several networks of one agent that are trained together."""

from torch import Tensor, nn


class AgentNetworks(nn.ModuleDict):
    """Networks of one agent that are trained together, by name; the first one acts."""

    def forward(self, observation: Tensor) -> Tensor:
        """The output of the acting network."""
        given: Tensor = acting_part(self)(observation)
        return given


def parts_of(network: nn.Module) -> dict[str, nn.Module]:
    """The networks of one agent by name, the acting one first; a single network has the name ""."""
    return dict(network.items()) if isinstance(network, AgentNetworks) else {"": network}


def acting_part(network: nn.Module) -> nn.Module:
    """The network that acts."""
    return next(iter(parts_of(network).values()))
