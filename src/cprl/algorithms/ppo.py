"""PPO: an actor and a critic, learned from rollouts by a clipped ratio."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

from torchrl.objectives import ClipPPOLoss, LossModule

from cprl.algorithms.base import ActorCritic, actor_critic_loss
from cprl.networks.agent import AgentNetworks
from cprl.values import Custom, Range

ClipEpsilon = Annotated[float, Range(1e-6, 0.999)]


@dataclass(frozen=True, kw_only=True)
class Clipped(ActorCritic, stored=False):
    """The base of algorithms with a clipped ratio."""

    clip_epsilon: ClipEpsilon = 0.2
    """The largest change of an action's probability, as a ratio minus 1."""
    can_be_recurrent = True
    loss_kind: ClassVar[Callable[..., LossModule]]
    """TorchRL's loss."""

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return actor_critic_loss(
            network,
            self.loss_kind,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coeff,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=False,  # `Rollouts` normalises them per lane
        )


@dataclass(frozen=True, kw_only=True)
class PPO(Clipped):
    """Proximal policy optimisation with a clipped ratio, TorchRL's `ClipPPOLoss`.

    Source: Schulman et al., "Proximal Policy Optimization Algorithms" (2017).
    """

    loss: Custom | None = None
    """A loss of your own in place of `ClipPPOLoss`: a function of (networks, settings) that returns a
    `LossModule`; `networks["actor"]` gives logits [.., A], `networks["critic"]` values [.., 1]."""
    loss_kind = ClipPPOLoss
    update = "stacked"

    def make_loss(self, network: AgentNetworks) -> LossModule:
        if self.loss is not None:
            return self.custom_loss(self.loss, network)
        return super().make_loss(network)
