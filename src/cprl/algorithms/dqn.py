"""DQN, the algorithm of the study: Q-learning with a network and a copy of it for targets."""

from dataclasses import dataclass
from functools import partial

from torch import nn
from torchrl.objectives import DQNLoss, LossModule

from cprl.algorithms.base import OffPolicy, q_actor
from cprl.objectives.td import Distance, LogCoshDQNLoss
from cprl.values import Custom


@dataclass(frozen=True, kw_only=True)
class DQN(OffPolicy):
    """Deep Q-learning with a target network, TorchRL's `DQNLoss`; the algorithm of the study.

    With a recurrent network, and `sequence_steps` of the settings, it follows Hausknecht and Stone, "Deep
    Recurrent Q-Learning for Partially Observable MDPs" (2015), except that sequences begin with the states by
    which the agent acted, not with zeros: the stored states of Kapturowski et al., "Recurrent
    Experience Replay in Distributed Reinforcement Learning" (2019), without a burn-in.

    Source: Mnih et al., "Human-level control through deep reinforcement learning" (2015).
    """

    double: bool = False
    """True if the network itself, not its target, chooses the action whose value bootstraps (van Hasselt,
    Guez and Silver, "Deep Reinforcement Learning with Double Q-learning", 2016)."""
    loss_function: Distance = "l2"
    """The loss of the temporal-difference error d: "l2", d^2; "smooth_l1" (Huber); "l1"; or "log_cosh",
    ln cosh d, as in some versions of the study's program (`cprl.objectives.LogCoshDQNLoss`)."""
    loss: Custom | None = None
    """A loss of your own in place of `DQNLoss`: a function of (network, settings) that returns a
    `LossModule`; the network maps observations [.., *shape] to action values [.., A]."""
    can_be_recurrent = True
    update = "stacked"

    def make_loss(self, network: nn.Module) -> LossModule:
        if self.loss is not None:
            return self.custom_loss(self.loss, network)
        is_ours = self.loss_function == "log_cosh"
        make = LogCoshDQNLoss if is_ours else partial(DQNLoss, loss_function=self.loss_function)
        loss = make(q_actor(network), delay_value=True, double_dqn=self.double, action_space="categorical")
        return self.bootstrapped(loss)
