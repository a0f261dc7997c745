"""REINFORCE: the policy gradient, with a baseline that is learned."""

from dataclasses import dataclass

from torchrl.objectives import LossModule, ReinforceLoss

from cprl.algorithms.base import OnPolicy, actor_critic_loss
from cprl.networks.agent import AgentNetworks


@dataclass(frozen=True, kw_only=True)
class Reinforce(OnPolicy):
    """REINFORCE with a learned baseline, TorchRL's `ReinforceLoss`; meant for one epoch per rollout.

    Source: Williams, "Simple statistical gradient-following algorithms for connectionist reinforcement
    learning" (1992).
    """

    can_be_recurrent = True
    update = "stacked"

    def make_loss(self, network: AgentNetworks) -> LossModule:
        loss = actor_critic_loss(network, ReinforceLoss, loss_critic_type="l2")
        loss.set_keys(sample_log_prob="action_log_prob")
        return loss
