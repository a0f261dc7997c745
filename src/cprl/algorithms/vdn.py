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
"""The entry with the values of the members' chosen actions, [.., S, 1]."""
_TEAM_VALUE: Final = "team_value"
"""The entry with the value of the team, [.., 1]."""


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


def mixed_loss(network: AgentNetworks, mixer_keys: Sequence[str]) -> LossModule:
    """Return `QMixerLoss` over a team's "actor" and "mixer", with entries at the root of the TensorDict.

    Args:
        mixer_keys: the entries that the mixer reads.
    """
    loss = QMixerLoss(
        q_actor(network["actor"]),
        TensorDictModule(network["mixer"], list(mixer_keys), [_TEAM_VALUE]),
        delay_value=True,
        action_space="categorical",
    )
    loss.set_keys(action="action", action_value="action_value", local_value=CHOSEN, global_value=_TEAM_VALUE)
    return loss
