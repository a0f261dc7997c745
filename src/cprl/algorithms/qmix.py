"""QMIX: the value of a team, by a network that never falls as a member's value rises."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import OffPolicy, TeamAlgorithm, team_of
from cprl.algorithms.vdn import CHOSEN, mixed_loss
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import Cells
from cprl.networks.team import Mixing


@dataclass(frozen=True, kw_only=True)
class QMIX(TeamAlgorithm, OffPolicy):
    """Monotonic mixing: the team's value never falls as a member's value rises. TorchRL's `QMixerLoss`.

    The mixing network reads the observations of all members. Source: Rashid et al., "QMIX: Monotonic Value
    Function Factorisation for Deep Multi-Agent Reinforcement Learning" (2018). Here members share no weights,
    unless `Team.share_parameters` says so, and their networks are not recurrent.
    """

    mixing_cells: Cells = 32
    """Units of the mixing layer."""
    fewest_members = 2
    update = "vmapped"

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        mixer = Mixing(
            spaces.observation_shape,
            members=len(members),
            cells=self.mixing_cells,
            highest=spaces.observation_scale,
        )
        return AgentNetworks({"actor": team_of(members, spaces), "mixer": mixer})

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return self.bootstrapped(mixed_loss(network, [CHOSEN, "observation"]))
