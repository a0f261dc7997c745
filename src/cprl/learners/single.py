"""The network and the loss of one DQN agent, from its settings."""

from collections.abc import Sequence

from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, ValueEstimators

from cprl.learners.settings import DQNSettings
from cprl.networks.mlp import MLPNetwork


def dqn_loss(network: nn.Module, *, gamma: float) -> DQNLoss:
    """TorchRL's `DQNLoss` of one agent with a target network, squared error and one-step targets.

    Args:
        network: maps "observation" to action values; with a `StackedMLP` the loss is that of many agents.
        gamma: the discount factor per step.
    """
    actor = QValueActor(network, spec=None, action_space="categorical")
    loss = DQNLoss(actor, delay_value=True, loss_function="l2", action_space="categorical")
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    return loss


def q_network(
    observation_shape: Sequence[int], actions: int, *, settings: DQNSettings, highest: float
) -> MLPNetwork:
    """The network that the settings describe; see `MLPNetwork` for the other arguments."""
    return MLPNetwork(
        observation_shape,
        actions,
        highest=highest,
        hidden_cells=settings.hidden_cells,
        relu_on_outputs=settings.relu_on_outputs,
        glorot_uniform=settings.glorot_uniform,
    )
