"""A2C: an actor and a critic, learned from rollouts in one step."""

from dataclasses import dataclass

from torchrl.objectives import A2CLoss, LossModule

from cprl.algorithms.base import ActorCritic, actor_critic_loss
from cprl.networks.agent import AgentNetworks


@dataclass(frozen=True, kw_only=True)
class A2C(ActorCritic):
    """Advantage actor-critic, TorchRL's `A2CLoss`; meant for one epoch per rollout.

    Source: Mnih et al., "Asynchronous Methods for Deep Reinforcement Learning" (2016), here synchronous.
    """

    can_be_recurrent = True
    update = "stacked"

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return actor_critic_loss(
            network,
            A2CLoss,
            entropy_coeff=self.entropy_coeff,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
        )
