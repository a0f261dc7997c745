"""Agents with continuous actions, for tests: DDPG as TorchRL has it."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss, ValueEstimators

from cprl.algorithms.base import OffPolicy
from cprl.algorithms.dqn import network_of
from cprl.learners.settings import DQNSettings
from cprl.networks import AgentNetworks
from cprl.networks.bounded import BoundedNetwork
from cprl.networks.mlp import MLPNetwork


class Critic(nn.Module):
    """The value of an action, [..., 1], in units that suit the game of two hills."""

    def __init__(self, network):
        super().__init__()
        self.of = network

    def forward(self, observation, action):
        return 30 * self.of(torch.cat([observation, action / 10], -1))


@dataclass(frozen=True, kw_only=True)
class DDPG(OffPolicy):
    """Deep deterministic policy gradient (Lillicrap et al. 2016)."""

    settings: DQNSettings
    action_noise: float = 0.0
    has_continuous_actions: ClassVar[bool] = True

    def make_network(self, spaces):
        actor = network_of(spaces, self.settings, None, outputs=spaces.action_size)
        inputs = spaces.observation_shape[0] + spaces.action_size
        critic = MLPNetwork((inputs,), 1, hidden_cells=self.settings.hidden_cells, highest=1.0)
        bounded = BoundedNetwork(actor, low=spaces.action_low, high=spaces.action_high)
        return AgentNetworks({"actor": bounded, "critic": critic})

    def make_loss(self, network):
        actor, critic = network.values()
        loss = DDPGLoss(
            TensorDictModule(actor, ["observation"], ["action"]),
            TensorDictModule(Critic(critic), ["observation", "action"], ["state_action_value"]),
            loss_function="l2",
            delay_actor=True,
            delay_value=True,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


def small_ddpg():
    """With settings for a few steps."""
    settings = DQNSettings(hidden_cells=(8,), learning_starts=8, buffer_size=40, batch_size=4, tau=0.05)
    return DDPG(settings=settings, action_noise=0.5)


def slow_ddpg():
    """With settings for some thousand steps."""
    settings = DQNSettings(
        hidden_cells=(32, 32),
        learning_starts=300,
        buffer_size=3000,
        batch_size=32,
        tau=0.01,
        learning_rate=1e-3,
        epsilon_hold_steps=500,
        epsilon_decay_steps=1000,
        epsilon_end=0.0,
    )
    return DDPG(settings=settings, action_noise=0.5)
