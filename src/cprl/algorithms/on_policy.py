"""On-policy algorithms: each agent has an actor and a critic, and TorchRL's loss over them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule, ReinforceLoss

from cprl.algorithms.base import OnPolicy, Weight, module_of, policy
from cprl.learners.engine import Batching
from cprl.networks.agent import AgentNetworks
from cprl.values import Range

ClipEpsilon = Annotated[float, Range(1e-6, 0.999)]


@dataclass(frozen=True, kw_only=True)
class Clipped(OnPolicy, stored=False):
    """What algorithms with a clipped ratio have in common."""

    clip_epsilon: ClipEpsilon = 0.2
    """The largest change of an action's probability, as a ratio minus 1."""
    entropy_coeff: Weight = 0.01
    critic_coeff: Weight = 0.5
    can_be_recurrent: ClassVar[bool] = True
    loss_kind: ClassVar[Callable[..., LossModule]]
    """TorchRL's loss."""

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return _loss(
            network,
            self.loss_kind,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coeff,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=False,  # `RolloutLearner` normalises them per lane
        )


@dataclass(frozen=True, kw_only=True)
class PPO(Clipped):
    """Proximal policy optimisation with a clipped ratio, TorchRL's `ClipPPOLoss`.

    Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017).
    """

    loss_kind: ClassVar[Callable[..., LossModule]] = ClipPPOLoss
    batching: ClassVar[Batching | None] = "lane_axis"


@dataclass(frozen=True, kw_only=True)
class A2C(OnPolicy):
    """Advantage actor-critic, TorchRL's `A2CLoss`; meant for one epoch per rollout.

    Source: Mnih et al., "Asynchronous Methods for Deep Reinforcement Learning" (2016), here synchronous.
    """

    entropy_coeff: Weight = 0.01
    critic_coeff: Weight = 0.5
    can_be_recurrent: ClassVar[bool] = True
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_loss(self, network: AgentNetworks) -> LossModule:
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

    can_be_recurrent: ClassVar[bool] = True
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_loss(self, network: AgentNetworks) -> LossModule:
        loss = _loss(network, ReinforceLoss, loss_critic_type="l2")
        loss.set_keys(sample_log_prob="action_log_prob")
        return loss


def _loss(network: AgentNetworks, kind: Callable[..., LossModule], **options: object) -> LossModule:
    critic = module_of(network["critic"], "state_value", state="critic_recurrent_state")
    return kind(policy(network["actor"]), critic, **options)
