"""SAC: a policy that is paid for its entropy, with two critics."""

from dataclasses import dataclass
from typing import Annotated

from torch import nn
from torchrl.objectives import DiscreteSACLoss, LossModule

from cprl.algorithms.base import OffPolicy, module_of, policy
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks
from cprl.objectives.td import TorchRLDistance
from cprl.values import Range, Share


@dataclass(frozen=True, kw_only=True)
class SAC(OffPolicy):
    """Soft actor-critic for discrete actions with twin critics, TorchRL's `DiscreteSACLoss`.

    Each agent learns its own temperature. Source: Christodoulou, "Soft Actor-Critic for Discrete Action
    Settings" (2019).
    """

    target_entropy_weight: Share = 0.5
    """The target entropy of the temperature, as a fraction of the maximum entropy log A, 0..1."""
    alpha_init: Annotated[float, Range(1e-12, 1e6)] = 0.1
    """The initial temperature, in units of reward (apples)."""
    loss_function: TorchRLDistance = "l2"
    stochastic = True
    update = "vmapped"

    def make_network(self, spaces: Spaces) -> nn.Module:
        actions = spaces.actions
        return self.new_networks(spaces, actor=actions, critic_0=actions, critic_1=actions)

    def make_loss(self, network: AgentNetworks) -> LossModule:
        self.refuse_relu()
        loss = DiscreteSACLoss(
            policy(network["actor"]),
            [module_of(network[name], "action_value") for name in ("critic_0", "critic_1")],
            action_space="categorical",
            num_actions=network["actor"].outputs,
            num_qvalue_nets=2,
            loss_function=self.loss_function,
            alpha_init=self.alpha_init,
            target_entropy_weight=self.target_entropy_weight,
        )
        return self.bootstrapped(loss)
