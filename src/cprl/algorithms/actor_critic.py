"""Off-policy actor-critic algorithms, whose agents sample actions from a learned policy: SAC and IQL."""

from dataclasses import dataclass
from typing import ClassVar

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteIQLLoss, DiscreteSACLoss, LossModule, ValueEstimators

from cprl.algorithms.base import OffPolicy
from cprl.algorithms.dqn import module_of, network_of, refuse_relu
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.settings import DQNSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.specification import Network
from cprl.system.compat import LaneCategorical


@dataclass(frozen=True, kw_only=True)
class SAC(OffPolicy):
    """Soft actor-critic for discrete actions with twin critics, TorchRL's `DiscreteSACLoss`.

    Each agent learns its own temperature. Source: Christodoulou, "Soft Actor-Critic for Discrete Action
    Settings" (2019).
    """

    settings: DQNSettings
    target_entropy_weight: float = 0.5
    """The target entropy of the temperature, as a fraction of the maximum entropy log A, 0..1."""
    alpha_init: float = 0.1
    """The initial temperature, in units of reward (apples)."""
    loss_function: str = "l2"
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        actions = spaces.actions
        names = "actor", "critic_0", "critic_1"
        return AgentNetworks(
            {name: network_of(spaces, self.settings, self.network, outputs=actions) for name in names}
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        refuse_relu(type(self).__name__, self.settings)
        assert isinstance(network, AgentNetworks)
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
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


@dataclass(frozen=True, kw_only=True)
class IQL(OffPolicy):
    """Implicit (not independent) Q-learning for discrete actions, TorchRL's `DiscreteIQLLoss`.

    Source: Kostrikov, Nair and Levine, "Offline Reinforcement Learning with Implicit Q-Learning" (2021).
    """

    settings: DQNSettings
    expectile: float = 0.7
    """The expectile of the action values that the state value estimates, 0.5..0.999."""
    temperature: float = 3.0
    """The inverse temperature of the advantage weights, in 1/reward (1/apples)."""
    loss_function: str = "l2"
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        actions = spaces.actions
        sizes = {"actor": actions, "critic_0": actions, "critic_1": actions, "value": 1}
        return AgentNetworks(
            {
                name: network_of(spaces, self.settings, self.network, outputs=size)
                for name, size in sizes.items()
            }
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        refuse_relu(type(self).__name__, self.settings)
        assert isinstance(network, AgentNetworks)
        loss = DiscreteIQLLoss(
            policy(network["actor"]),
            [module_of(network[name], "state_action_value") for name in ("critic_0", "critic_1")],
            module_of(network["value"], "state_value"),
            action_space="categorical",
            num_qvalue_nets=2,
            loss_function=self.loss_function,
            temperature=self.temperature,
            expectile=self.expectile,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


def policy(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """TorchRL's categorical policy with a network's outputs as logits; a recurrent network also reads
    "recurrent_state" and "is_init", as `cprl.networks.recurrent` says."""
    return ProbabilisticActor(
        module_of(network, "logits", state="recurrent_state"),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=LaneCategorical,
        return_log_prob=True,
    )
