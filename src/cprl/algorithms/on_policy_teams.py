"""Teams that learn on-policy: for each member an actor of its own, and TorchRL's losses over all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss

from cprl.algorithms.on_policy import actor_and_critic, clipped_loss, rollout_network
from cprl.commons.game import Game
from cprl.learners.settings import RolloutSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.team import CentralCritic, TeamNetwork


@dataclass(frozen=True, kw_only=True)
class MAPPO:
    """PPO with actors of their own and one critic that sees what all members see, by TorchRL's `MAPPOLoss`.

    Source: Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games" (2022); without
    their normalisation of values, and with networks of each member's own.
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """How far the chance of an action may move from what it was, as a ratio."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    stochastic: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = True
    fewest_members: ClassVar[int] = 1

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        return rollout_network(game, self.settings, game.observation_shape, len(game.actions))

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        everything = len(members), *game.observation_shape
        critic = rollout_network(game, self.settings, everything, 1)
        return AgentNetworks({"actor": TeamNetwork(members), "critic": CentralCritic(critic, len(members))})  # type: ignore[arg-type]

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return clipped_loss(network, MAPPOLoss, self)


@dataclass(frozen=True, kw_only=True)
class IPPO:
    """PPO with actors and critics of their own, by TorchRL's `IPPOLoss`.

    Unlike agents that each learn by `PPO`, members share the length to which a gradient is shortened and the
    mean and deviation of advantages. Source: de Witt et al., "Is Independent Learning All You Need in the
    StarCraft Multi-Agent Challenge?" (2020).
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """How far the chance of an action may move from what it was, as a ratio."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    stochastic: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 1

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        return actor_and_critic(game, self.settings)

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        of_each: Sequence[Any] = members
        return AgentNetworks(
            {name: TeamNetwork([networks[name] for networks in of_each]) for name in ("actor", "critic")}
        )

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return clipped_loss(network, IPPOLoss, self)
