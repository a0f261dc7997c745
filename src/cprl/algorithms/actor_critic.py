"""Off-policy algorithms whose agents draw their actions from a policy that they learn: SAC and IQL."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteIQLLoss, DiscreteSACLoss, LossModule, ValueEstimators

from cprl.algorithms.dqn import network_of
from cprl.commons.game import Game
from cprl.learners.settings import DQNSettings
from cprl.networks.agent import AgentNetworks


@dataclass(frozen=True, kw_only=True)
class SAC:
    """Soft actor-critic for discrete actions, twin critics, by TorchRL's `DiscreteSACLoss`.

    Each agent has a temperature of its own. Source: Christodoulou, "Soft Actor-Critic for Discrete Action
    Settings" (2019).
    """

    settings: DQNSettings
    target_entropy_weight: float = 0.5
    """The share of the highest entropy, log A, that the temperature holds the policy at."""
    alpha_init: float = 0.1
    """The temperature at first, in apples."""
    loss_function: str = "l2"
    stochastic: ClassVar[bool] = True

    def network(self, game: Game) -> nn.Module:
        """See `OffPolicy`."""
        actions = len(game.actions)
        names = "actor", "critic_0", "critic_1"
        return AgentNetworks({name: network_of(game, self.settings, outputs=actions) for name in names})

    def loss(self, network: nn.Module) -> LossModule:
        """See `OffPolicy`."""
        assert isinstance(network, AgentNetworks)
        loss = DiscreteSACLoss(
            policy(network["actor"]),
            [_module(network[name], "action_value") for name in ("critic_0", "critic_1")],
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
class IQL:
    """Implicit (not: independent) Q-learning for discrete actions by TorchRL's `DiscreteIQLLoss`.

    Source: Kostrikov, Nair and Levine, "Offline Reinforcement Learning with Implicit Q-Learning" (2021).
    """

    settings: DQNSettings
    expectile: float = 0.7
    """Which expectile of the actions' values the state's value is, 0.5 to 1."""
    temperature: float = 3.0
    """Of the weights of actions by their advantage, in 1/apples."""
    loss_function: str = "l2"
    stochastic: ClassVar[bool] = True

    def network(self, game: Game) -> nn.Module:
        """See `OffPolicy`."""
        actions = len(game.actions)
        sizes = {"actor": actions, "critic_0": actions, "critic_1": actions, "value": 1}
        return AgentNetworks(
            {name: network_of(game, self.settings, outputs=size) for name, size in sizes.items()}
        )

    def loss(self, network: nn.Module) -> LossModule:
        """See `OffPolicy`."""
        assert isinstance(network, AgentNetworks)
        loss = DiscreteIQLLoss(
            policy(network["actor"]),
            [_module(network[name], "state_action_value") for name in ("critic_0", "critic_1")],
            _module(network["value"], "state_value"),
            action_space="categorical",
            num_qvalue_nets=2,
            loss_function=self.loss_function,
            temperature=self.temperature,
            expectile=self.expectile,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


def policy(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """A network's outputs as the logits of TorchRL's categorical policy."""
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["logits"]),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )


def _module(network: nn.Module, name: str) -> TensorDictModule:
    return TensorDictModule(network, ["observation"], [name])
