"""IPPO: PPO of a team whose members each have an actor and a critic."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn
from torchrl.objectives.multiagent import IPPOLoss

from cprl.algorithms.base import TeamAlgorithm, team_of
from cprl.algorithms.ppo import Clipped
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks


@dataclass(frozen=True, kw_only=True)
class IPPO(TeamAlgorithm, Clipped):
    """PPO with an actor and a critic per member, TorchRL's `IPPOLoss`.

    Unlike agents that each learn with `PPO`, members share gradient clipping and the normalisation of
    advantages. Source: de Witt et al., "Is Independent Learning All You Need in the
    StarCraft Multi-Agent Challenge?" (2020).
    """

    loss_kind = IPPOLoss
    shares_reward = False
    update = "stacked"

    def make_team(self, members: Sequence[Any], spaces: Spaces) -> nn.Module:
        actors = team_of([networks["actor"] for networks in members], spaces)
        critics = team_of([networks["critic"] for networks in members], spaces)
        return AgentNetworks({"actor": actors, "critic": critics})
