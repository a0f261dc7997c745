"""Several networks of one agent that are trained together."""

from collections.abc import Mapping
from typing import Final

from torch import Tensor, nn

from cprl.checks import Check, checked

_NETWORKS: Final = Check(
    lambda value: (
        isinstance(value, Mapping)
        and len(value) > 0
        and all(isinstance(name, str) and name and "." not in name for name in value)
        and all(isinstance(network, nn.Module) for network in value.values())
    ),
    "torch modules by name, at least one",
)


class AgentNetworks(nn.ModuleDict):
    """Networks of one agent that are trained together, by name; the first one acts.

    Raises:
        ValueError: for anything but a table of networks by name, at least one.
    """

    def __init__(self, modules: Mapping[str, nn.Module]) -> None:
        super().__init__(checked("modules", modules, _NETWORKS))

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
