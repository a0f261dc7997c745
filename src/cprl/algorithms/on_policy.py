"""On-policy algorithms: each agent has an actor and a critic, and TorchRL's loss over them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import nn
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule, ReinforceLoss

from cprl.algorithms.actor_critic import policy
from cprl.algorithms.base import OnPolicy
from cprl.algorithms.dqn import module_of, network_of
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.lola.settings import LOLASettings
from cprl.learners.settings import RolloutSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.specification import Network


@dataclass(frozen=True, kw_only=True)
class PPO(OnPolicy):
    """Proximal policy optimisation with a clipped ratio, TorchRL's `ClipPPOLoss`.

    Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017).
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """The largest change of an action's probability, as a ratio minus 1; 1e-6..0.999."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_be_recurrent: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return actor_and_critic(spaces, self.settings, self.network)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return clipped_loss(network, ClipPPOLoss, self)


@dataclass(frozen=True, kw_only=True)
class A2C(OnPolicy):
    """Advantage actor-critic, TorchRL's `A2CLoss`; meant for one epoch per rollout.

    Source: Mnih et al., "Asynchronous Methods for Deep Reinforcement Learning" (2016), here synchronous.
    """

    settings: RolloutSettings
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_be_recurrent: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return actor_and_critic(spaces, self.settings, self.network)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return _loss(
            network,
            A2CLoss,
            entropy_coeff=self.entropy_coeff,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
        )


@dataclass(frozen=True, kw_only=True)
class Reinforce(OnPolicy):
    """REINFORCE with a learned baseline, TorchRL's `ReinforceLoss`; meant for one epoch per rollout.

    Source: Williams, "Simple statistical gradient-following algorithms for connectionist reinforcement
    learning" (1992).
    """

    settings: RolloutSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_be_recurrent: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return actor_and_critic(spaces, self.settings, self.network)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        loss = _loss(network, ReinforceLoss, loss_critic_type="l2")
        loss.set_keys(sample_log_prob="action_log_prob")
        return loss


def actor_and_critic(
    spaces: Spaces, settings: RolloutSettings | LOLASettings, network: Network | Custom | None
) -> AgentNetworks:
    """New networks of one agent: "actor" and "critic"."""
    sizes = {"actor": spaces.actions, "critic": 1}
    return AgentNetworks(
        {name: network_of(spaces, settings, network, outputs=size) for name, size in sizes.items()}
    )


class Clipped(Protocol):
    """The fields of algorithms with a clipped loss."""

    @property
    def clip_epsilon(self) -> float:
        """The largest change of an action's probability, as a ratio minus 1."""

    @property
    def entropy_coeff(self) -> float:
        """The weight of the policy's entropy in the loss."""

    @property
    def critic_coeff(self) -> float:
        """The weight of the critic's error in the loss."""


def clipped_loss(network: nn.Module, kind: Callable[..., LossModule], algorithm: Clipped) -> LossModule:
    """A TorchRL loss with a clipped ratio over "actor" and "critic"."""
    return _loss(
        network,
        kind,
        clip_epsilon=algorithm.clip_epsilon,
        entropy_coeff=algorithm.entropy_coeff,
        critic_coeff=algorithm.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=False,  # `RolloutLearner` normalises them per lane
    )


def _loss(network: nn.Module, kind: Callable[..., LossModule], **how: object) -> LossModule:
    assert isinstance(network, AgentNetworks)
    critic = module_of(network["critic"], "state_value", state="critic_recurrent_state")
    return kind(policy(network["actor"]), critic, **how)
