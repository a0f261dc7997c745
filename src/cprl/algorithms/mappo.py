"""MAPPO: PPO of a team, with a critic of what all members observe."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import nn
from torchrl.objectives.multiagent import MAPPOLoss

from cprl.algorithms.base import TeamAlgorithm, team_of
from cprl.algorithms.ppo import Clipped
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks
from cprl.networks.team import CentralCritic


@dataclass(frozen=True, kw_only=True)
class MAPPO(TeamAlgorithm, Clipped):
    """PPO with an actor per member and a central critic of all observations, TorchRL's `MAPPOLoss`.

    Source: Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games" (2022); here
    without value normalisation, and members share no weights, unless `Team.share_parameters` says so.
    """

    loss_kind = MAPPOLoss
    update = "stacked"

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_network(spaces, spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        everything = len(members), *spaces.observation_shape
        critic = self.new_network(spaces, 1, shape=everything)
        actor = team_of(members, spaces)
        return AgentNetworks({"actor": actor, "critic": CentralCritic(critic, len(members))})
