"""On-policy algorithms: for each agent an actor and a critic, and TorchRL's loss over them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule, ReinforceLoss

from cprl.algorithms.actor_critic import policy
from cprl.commons.game import Game
from cprl.learners.settings import RolloutSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLPNetwork


class OnPolicy(Protocol):
    """What an agent is made of that learns from what its present policy has just done.

    Equal ones learn as lanes of one step, so it should be a value: a frozen dataclass.
    """

    @property
    def settings(self) -> RolloutSettings:
        """The hyper-parameters."""

    def network(self, game: Game) -> nn.Module:
        """New `AgentNetworks` of one agent: "actor", to its policy's logits, and "critic", to one value."""

    def loss(self, network: nn.Module) -> LossModule:
        """TorchRL's loss over them, for "observation", "action", "action_log_prob", "advantage",
        "value_target" and "state_value"."""


@dataclass(frozen=True, kw_only=True)
class PPO:
    """Proximal policy optimisation with a clipped ratio by TorchRL's `ClipPPOLoss`.

    Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017).
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """How far the chance of an action may move from what it was, as a ratio."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5

    def network(self, game: Game) -> nn.Module:
        """See `OnPolicy`."""
        return actor_and_critic(game, self.settings)

    def loss(self, network: nn.Module) -> LossModule:
        """See `OnPolicy`."""
        return clipped_loss(network, ClipPPOLoss, self)


@dataclass(frozen=True, kw_only=True)
class A2C:
    """Advantage actor-critic by TorchRL's `A2CLoss`; one epoch a rollout is meant.

    Source: Mnih et al., "Asynchronous Methods for Deep Reinforcement Learning" (2016), synchronous.
    """

    settings: RolloutSettings
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5

    def network(self, game: Game) -> nn.Module:
        """See `OnPolicy`."""
        return actor_and_critic(game, self.settings)

    def loss(self, network: nn.Module) -> LossModule:
        """See `OnPolicy`."""
        return _loss(
            network,
            A2CLoss,
            entropy_coeff=self.entropy_coeff,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
        )


@dataclass(frozen=True, kw_only=True)
class Reinforce:
    """REINFORCE with a learned baseline by TorchRL's `ReinforceLoss`; one epoch a rollout is meant.

    Source: Williams, "Simple statistical gradient-following algorithms for connectionist reinforcement
    learning" (1992).
    """

    settings: RolloutSettings

    def network(self, game: Game) -> nn.Module:
        """See `OnPolicy`."""
        return actor_and_critic(game, self.settings)

    def loss(self, network: nn.Module) -> LossModule:
        """See `OnPolicy`."""
        loss = _loss(network, ReinforceLoss, loss_critic_type="l2")
        loss.set_keys(sample_log_prob="action_log_prob")
        return loss


def actor_and_critic(game: Game, settings: RolloutSettings) -> AgentNetworks:
    """New networks of one agent, like those of the DQN agents: "actor" and "critic"."""
    sizes = {"actor": len(game.actions), "critic": 1}
    shape = game.observation_shape
    return AgentNetworks({name: rollout_network(game, settings, shape, size) for name, size in sizes.items()})


def rollout_network(game: Game, settings: RolloutSettings, shape: Sequence[int], outputs: int) -> MLPNetwork:
    """A new network from what is seen in a game, of such a shape, to so many outputs."""
    return MLPNetwork(shape, outputs, highest=game.observation.highest, hidden_cells=settings.hidden_cells)


class Clipped(Protocol):
    """What PPO wants to know of an algorithm of its family."""

    @property
    def clip_epsilon(self) -> float:
        """How far the chance of an action may move from what it was, as a ratio."""

    @property
    def entropy_coeff(self) -> float:
        """Of the policy's entropy in the loss."""

    @property
    def critic_coeff(self) -> float:
        """Of the critic's error in the loss."""


def clipped_loss(network: nn.Module, kind: Callable[..., LossModule], algorithm: Clipped) -> LossModule:
    """One of TorchRL's losses with a clipped ratio over "actor" and "critic"."""
    return _loss(
        network,
        kind,
        clip_epsilon=algorithm.clip_epsilon,
        entropy_coeff=algorithm.entropy_coeff,
        critic_coeff=algorithm.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=False,  # `RolloutLearner` does, each lane by itself
    )


def _loss(network: nn.Module, kind: Callable[..., LossModule], **how: object) -> LossModule:
    assert isinstance(network, AgentNetworks)
    critic = TensorDictModule(network["critic"], ["observation"], ["state_value"])
    return kind(policy(network["actor"]), critic, **how)
