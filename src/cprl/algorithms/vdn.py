"""VDN: the value of a team is the sum of the values of its members."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import VDNMixer
from torchrl.objectives import LossModule
from torchrl.objectives.multiagent import QMixerLoss

from cprl.algorithms.base import OffPolicy, TeamAlgorithm, q_actor, team_of
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks

CHOSEN: Final = "chosen_action_value"
_OF_TEAM: Final = "team_value"


@dataclass(frozen=True, kw_only=True)
class VDN(TeamAlgorithm, OffPolicy):
    """Value decomposition: the team's value is the sum of its members' values, TorchRL's `QMixerLoss`.

    Source: Sunehag et al., "Value-Decomposition Networks For Cooperative Multi-Agent Learning" (2017).
    """

    update = "vmapped"

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        mixer = VDNMixer(len(members), device="cpu")
        return AgentNetworks({"actor": team_of(members, spaces), "mixer": mixer})

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return self.bootstrapped(mixed_loss(network, [CHOSEN]))


def mixed_loss(network: AgentNetworks, seen_by_mixer: Sequence[str]) -> LossModule:
    """`QMixerLoss` over a team's "actor" and "mixer", with entries at the root of the TensorDict."""
    loss = QMixerLoss(
        q_actor(network["actor"]),
        TensorDictModule(network["mixer"], list(seen_by_mixer), [_OF_TEAM]),
        delay_value=True,
        action_space="categorical",
    )
    loss.set_keys(action="action", action_value="action_value", local_value=CHOSEN, global_value=_OF_TEAM)
    return loss
