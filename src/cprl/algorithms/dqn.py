"""Algorithms that learn action values from replay: DQN and its variants, C51, CQL."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import (
    DiscreteCQLLoss,
    DistributionalDQNLoss,
    DQNLoss,
    LossModule,
    ValueEstimators,
)

from cprl.algorithms.base import OffPolicy
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.lola.settings import LOLASettings
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, DQNSettings, RolloutSettings
from cprl.networks.distributional import AtomNetwork
from cprl.networks.mlp import MLP
from cprl.networks.recurrent import state_shape_of
from cprl.networks.specification import Network, new_network
from cprl.objectives.log_cosh import DISTANCES, LOG_COSH, LogCoshDQNLoss
from cprl.system.compat import bootstrap_from_target


@dataclass(frozen=True, kw_only=True)
class DQN(OffPolicy):
    """Deep Q-learning with a target network, TorchRL's `DQNLoss`; the algorithm of the study.

    With a recurrent network, and `sequence_steps` of the settings, it is that of Hausknecht and Stone, "Deep
    Recurrent Q-Learning for Partially Observable MDPs" (2015), but that sequences begin with the states by
    which the agent acted, not with zeros: those are the stored states of Kapturowski et al., "Recurrent
    Experience Replay in Distributed Reinforcement Learning" (2019), without a burn-in.

    Source: Mnih et al., "Human-level control through deep reinforcement learning" (2015).
    """

    settings: DQNSettings
    double: bool = False
    """Whether the network itself, not its target, chooses the action whose value bootstraps (van Hasselt,
    Guez and Silver, "Deep Reinforcement Learning with Double Q-learning", 2016)."""
    loss_function: str = "l2"
    """The loss of the temporal-difference error d: "l2", d^2; "smooth_l1" (Huber); "l1"; or "log_cosh",
    ln cosh d, that of some versions of the study's program (`cprl.objectives.LogCoshDQNLoss`)."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES
    can_be_recurrent: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return q_network_of(spaces, self.settings, self.network)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        is_ours = self.loss_function == LOG_COSH
        make = LogCoshDQNLoss if is_ours else partial(DQNLoss, loss_function=self.loss_function)
        loss = make(q_actor(network), delay_value=True, double_dqn=self.double, action_space="categorical")
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


@dataclass(frozen=True, kw_only=True)
class DistributionalDQN(OffPolicy):
    """C51: learns the distribution of returns over fixed atoms, TorchRL's `DistributionalDQNLoss`.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).
    Theirs bootstraps from the action that the target network values most; TorchRL's loss lets the network
    itself choose it, as double DQN does, and takes its distribution from the target.
    """

    settings: DQNSettings
    atoms: int = 51
    lowest_return: float = 0.0
    highest_return: float = 100.0
    """The range of the atoms: discounted returns in apples. With a discount of 0.995 one apple per step
    amounts to 200."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        atoms = np.linspace(self.lowest_return, self.highest_return, self.atoms, dtype=np.float32)
        if not (np.diff(atoms) > 0).all():
            raise ValueError(
                f"DistributionalDQN.highest_return is {self.highest_return}; allowed: above lowest_return, "
                f"{self.lowest_return}, and so far that float32 tells {self.atoms} atoms apart"
            )

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        actions = spaces.actions
        return AtomNetwork(
            network_of(spaces, self.settings, self.network, outputs=actions * self.atoms),
            actions=actions,
            lowest=self.lowest_return,
            highest=self.highest_return,
            atoms=self.atoms,
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        refuse_relu(type(self).__name__, self.settings)
        assert isinstance(network, AtomNetwork)
        actor = DistributionalQValueActor(
            AtomLogits(network), support=network.support, spec=None, action_space="categorical"
        )
        return DistributionalDQNLoss(actor, gamma=self.settings.gamma, delay_value=True)


class AtomLogits(nn.Module):
    """An `AtomNetwork` with the outputs that TorchRL's distributional actor expects: logits [..., atoms, A].

    Args:
        network: the network, whose weights it shares.
    """

    def __init__(self, network: AtomNetwork) -> None:
        super().__init__()
        self.of = network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """The logits."""
        return self.of.atom_logits(observation)


@dataclass(frozen=True, kw_only=True)
class CQL(OffPolicy):
    """Conservative Q-learning, TorchRL's `DiscreteCQLLoss`: half the temporal-difference loss, plus a
    conservative term that lowers the values of actions that were not taken.

    Source: Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning" (2020).
    """

    settings: DQNSettings
    conservative_weight: float = 0.1
    """The weight of the conservative term. TorchRL's weight is 1, for fixed data sets; with it, agents that
    explore imitate their first random actions (`tests/test_optimum.py`)."""
    loss_function: str = "l2"
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return q_network_of(spaces, self.settings, self.network)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        loss = _WeightedCQLLoss(
            q_actor(network),
            weight=self.conservative_weight,
            delay_value=True,
            loss_function=self.loss_function,
            action_space="categorical",
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        bootstrap_from_target(loss.value_estimator)
        return loss


class _WeightedCQLLoss(DiscreteCQLLoss):
    """`DiscreteCQLLoss` with a weight for the conservative term."""

    def __init__(self, actor: QValueActor, *, weight: float, **how: Any) -> None:
        super().__init__(actor, **how)
        self._weight = weight

    def cql_loss(self, tensordict: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The weighted conservative term."""
        loss, metadata = super().cql_loss(tensordict)
        return self._weight * loss, metadata


def q_network_of(spaces: Spaces, settings: DQNSettings, network: Network | Custom | None) -> nn.Module:
    """A new network of one agent, which outputs the value of each action."""
    relu = settings.relu_on_outputs
    return network_of(spaces, settings, network, outputs=spaces.actions, relu_on_outputs=relu)


def refuse_relu(name: str, settings: DQNSettings) -> None:
    """Raises a ValueError for `relu_on_outputs` of an algorithm without Q values to act by.

    It is called where losses are made, not where networks are: runs of earlier versions, which took no notice
    of that setting, can still be loaded.
    """
    if settings.relu_on_outputs:
        raise ValueError(
            f"settings.relu_on_outputs is True; allowed for {name}, whose acting network does not output Q "
            "values: False"
        )


def network_of(
    spaces: Spaces,
    settings: DQNSettings | RolloutSettings | LOLASettings,
    network: Network | Custom | None,
    *,
    outputs: int,
    **how: Any,
) -> nn.Module:
    """A new network of one agent.

    Args:
        spaces: what agents observe.
        settings: the hyperparameters.
        network: the architecture; None for fully connected layers of `settings.hidden_cells`.
        outputs: the number of outputs.
        how: see `new_network`.

    Raises:
        ValueError: see `new_network`; and if `settings.hidden_cells` is set together with a network.
    """
    if network is not None and settings.hidden_cells != DEFAULT_HIDDEN_CELLS:
        raise ValueError(
            f"settings.hidden_cells is {settings.hidden_cells}; allowed: the default, because the algorithm "
            "has a network; set the layers in the network"
        )
    made = MLP(hidden_cells=settings.hidden_cells) if network is None else network
    glorot_uniform = isinstance(settings, DQNSettings) and settings.glorot_uniform
    return new_network(made, spaces, outputs, glorot_uniform=glorot_uniform, **how)


def q_actor(network: nn.Module) -> QValueActor:
    """TorchRL's `QValueActor` with a network's outputs as action values; for recurrent ones see
    `module_of`."""
    return QValueActor(module_of(network, "action_value"), spec=None, action_space="categorical")


def module_of(network: nn.Module, name: str, *, state: str = "recurrent_state") -> TensorDictModule:
    """A network as a TensorDict module.

    Args:
        network: reads "observation".
        name: the entry of its outputs.
        state: the entry of the states before each step, of a recurrent network.
    """
    if state_shape_of(network) is None:
        return TensorDictModule(network, ["observation"], [name])
    return TensorDictModule(network, ["observation", state, "is_init"], [name, f"{state}_after"])
