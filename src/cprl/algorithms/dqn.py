"""Off-policy algorithms: for each agent its networks and TorchRL's loss over them.

Each is a plain value with three answers, which a loss of one's own gives as well (docs/algorithms.md has one
of twenty lines): `settings`, `network(game)` and `loss(network)`, and `stochastic`, how it acts.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import (
    DiscreteCQLLoss,
    DistributionalDQNLoss,
    DQNLoss,
    LossModule,
    ValueEstimators,
)
from torchrl.objectives.value import ValueEstimatorBase

from cprl.commons.game import Game
from cprl.learners.settings import DQNSettings
from cprl.networks.distributional import AtomNetwork
from cprl.networks.mlp import MLPNetwork


class OffPolicy(Protocol):
    """What an agent that learns from a replay buffer is made of.

    Equal ones learn as lanes of one step, so it should be a value: a frozen dataclass.
    """

    @property
    def settings(self) -> DQNSettings:
        """The hyper-parameters."""

    @property
    def stochastic(self) -> bool:
        """Whether the network gives logits of a policy, from which actions are drawn; else values of actions,
        of which the highest is taken but for chance epsilon."""

    def network(self, game: Game) -> nn.Module:
        """New networks of one agent, which draw their weights from torch's generator: from uint8
        [..., C, X, Y] to [..., A]; several as `AgentNetworks`, the acting one first."""

    def loss(self, network: nn.Module) -> LossModule:
        """TorchRL's loss over them, for transitions of "observation", "action" and "next": "observation",
        "reward" [.., 1], "done", "terminated"."""


@dataclass(frozen=True, kw_only=True)
class DQN:
    """Deep Q-learning with a target network by TorchRL's `DQNLoss`; the study's agents.

    Source: Mnih et al., "Human-level control through deep reinforcement learning" (2015).
    """

    settings: DQNSettings
    double: bool = False
    """Whether the action whose value bootstraps is chosen by the network itself, not by its target (van
    Hasselt, Guez and Silver, "Deep Reinforcement Learning with Double Q-learning", 2016)."""
    loss_function: str = "l2"
    """Of the temporal difference: "l2", "smooth_l1" (Huber) or "l1"."""
    stochastic: ClassVar[bool] = False

    def network(self, game: Game) -> nn.Module:
        """See `OffPolicy`."""
        return q_network_of(game, self.settings)

    def loss(self, network: nn.Module) -> LossModule:
        """See `OffPolicy`."""
        loss = DQNLoss(
            q_actor(network),
            delay_value=True,
            double_dqn=self.double,
            loss_function=self.loss_function,
            action_space="categorical",
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


@dataclass(frozen=True, kw_only=True)
class DistributionalDQN:
    """C51, the distribution of returns over fixed atoms, by TorchRL's `DistributionalDQNLoss`.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).
    """

    settings: DQNSettings
    atoms: int = 51
    lowest_return: float = 0.0
    highest_return: float = 100.0
    """Discounted returns that can be told: apples, by a discount of 0.995 at most 200 for one a step."""
    stochastic: ClassVar[bool] = False

    def network(self, game: Game) -> nn.Module:
        """See `OffPolicy`."""
        actions = len(game.actions)
        return AtomNetwork(
            network_of(game, self.settings, outputs=actions * self.atoms),
            actions=actions,
            lowest=self.lowest_return,
            highest=self.highest_return,
            atoms=self.atoms,
        )

    def loss(self, network: nn.Module) -> LossModule:
        """See `OffPolicy`."""
        assert isinstance(network, AtomNetwork)
        actor = DistributionalQValueActor(
            AtomLogits(network), support=network.support, spec=None, action_space="categorical"
        )
        return DistributionalDQNLoss(actor, gamma=self.settings.gamma, delay_value=True)


class AtomLogits(nn.Module):
    """An `AtomNetwork` as TorchRL's distributional actor wants it: logits [..., atoms, A].

    Args:
        network: whose weights it has.
    """

    def __init__(self, network: AtomNetwork) -> None:
        super().__init__()
        self.of = network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """The logits."""
        return self.of.atom_logits(observation)


@dataclass(frozen=True, kw_only=True)
class CQL:
    """Conservative Q-learning by TorchRL's `DiscreteCQLLoss`: half the temporal difference's loss, and what
    holds down the values of actions that were not taken.

    Source: Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning" (2020).
    """

    settings: DQNSettings
    conservative_weight: float = 0.1
    """Of the second term. TorchRL adds it whole, as for data that stay as they are; then agents who explore
    imitate what they happened to do first (`tests/test_optimum.py`)."""
    loss_function: str = "l2"
    stochastic: ClassVar[bool] = False

    def network(self, game: Game) -> nn.Module:
        """See `OffPolicy`."""
        return q_network_of(game, self.settings)

    def loss(self, network: nn.Module) -> LossModule:
        """See `OffPolicy`."""
        loss = _WeightedCQLLoss(
            q_actor(network),
            weight=self.conservative_weight,
            delay_value=True,
            loss_function=self.loss_function,
            action_space="categorical",
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        _bootstrap_from_target(loss.value_estimator)
        return loss


class _WeightedCQLLoss(DiscreteCQLLoss):
    """The same with a weight of its conservative term."""

    def __init__(self, actor: QValueActor, *, weight: float, **how: Any) -> None:
        super().__init__(actor, **how)
        self._weight = weight

    def cql_loss(self, tensordict: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The term."""
        loss, told = super().cql_loss(tensordict)
        return self._weight * loss, told


def _bootstrap_from_target(estimator: ValueEstimatorBase) -> None:
    """`DiscreteCQLLoss` of TorchRL 0.14.1 hands its target's weights on as `params`, of which its estimator
    takes no notice: it would bootstrap from the network itself."""
    estimate = estimator.value_estimate

    def by_target(tensordict: TensorDictBase, *, params: TensorDictBase) -> torch.Tensor:
        target: torch.Tensor = estimate(tensordict, target_params=params)
        return target

    estimator.value_estimate = by_target


def q_network_of(game: Game, settings: DQNSettings) -> MLPNetwork:
    """A new network of one agent: the value of each of its actions."""
    return network_of(game, settings, outputs=len(game.actions), relu=settings.relu_on_outputs)


def network_of(game: Game, settings: DQNSettings, *, outputs: int, relu: bool = False) -> MLPNetwork:
    return MLPNetwork(
        game.observation_shape,
        outputs,
        highest=game.observation.highest,
        hidden_cells=settings.hidden_cells,
        relu_on_outputs=relu,
        glorot_uniform=settings.glorot_uniform,
    )


def q_actor(network: nn.Module) -> QValueActor:
    """A network's outputs as the values of TorchRL's actor."""
    return QValueActor(network, spec=None, action_space="categorical")
