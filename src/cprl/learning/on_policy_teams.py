"""Teams that learn on-policy: for each member an actor of its own, and TorchRL's losses over all of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss

from cprl.acting.networks import AgentNetworks, QNetwork
from cprl.acting.teams import CentralCritic, TeamNetwork
from cprl.commons.game import Game
from cprl.learning.off_policy_actors import policy
from cprl.learning.settings import RolloutSettings


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
    samples: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = True
    fewest_members: ClassVar[int] = 1

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        return _of_rollouts(game, self.settings, outputs=len(game.actions))

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        everything = len(members), *game.observation_shape
        critic = QNetwork(
            everything, 1, highest=game.observation.highest, hidden_cells=self.settings.hidden_cells
        )
        return AgentNetworks({"actor": TeamNetwork(members), "critic": CentralCritic(critic, len(members))})  # type: ignore[arg-type]

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return _clipped(network, MAPPOLoss, self)


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
    samples: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 1

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        sizes = {"actor": len(game.actions), "critic": 1}
        return AgentNetworks(
            {name: _of_rollouts(game, self.settings, outputs=size) for name, size in sizes.items()}
        )

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        of_each: Sequence[Any] = members
        return AgentNetworks(
            {name: TeamNetwork([networks[name] for networks in of_each]) for name in ("actor", "critic")}
        )

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return _clipped(network, IPPOLoss, self)


def _of_rollouts(game: Game, settings: RolloutSettings, *, outputs: int) -> QNetwork:
    return QNetwork(
        game.observation_shape,
        outputs,
        highest=game.observation.highest,
        hidden_cells=settings.hidden_cells,
    )


def _clipped(network: nn.Module, kind: type[MAPPOLoss], algorithm: MAPPO | IPPO) -> LossModule:
    assert isinstance(network, AgentNetworks)
    return kind(
        policy(network["actor"]),
        TensorDictModule(network["critic"], ["observation"], ["state_value"]),
        clip_epsilon=algorithm.clip_epsilon,
        entropy_coeff=algorithm.entropy_coeff,
        critic_coeff=algorithm.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=False,  # `RolloutLearner` does, each team by itself
    )
