"""Algorithms that learn from replay: DQN, C51, CQL, SAC, IQL, PR2; and tabular Q-learning."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl import objectives
from torchrl.modules import DistributionalQValueActor, QValueActor
from torchrl.objectives import LossModule

from cprl.algorithms.base import Algorithm, OffPolicy, TrainingEngine, Weight, module_of, policy, q_actor
from cprl.commons.spaces import Spaces
from cprl.learners.base import Learner, LearningAgents
from cprl.learners.engine import Batching
from cprl.learners.settings import TabularSettings
from cprl.learners.tabular import TabularLearner, table_network
from cprl.networks.agent import AgentNetworks, AtomNetwork, JointNetwork, OtherOutputs
from cprl.networks.mlp import MOST_CELLS
from cprl.objectives.pr2 import PR2Loss
from cprl.objectives.td import DISTANCES, LOG_COSH, LogCoshDQNLoss
from cprl.policies.tabular import TableNetwork
from cprl.system.compat import bootstrap_from_target
from cprl.values import Range, Share

Return = Annotated[float, Range(-1e9, 1e9)]


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
    """Whether the network itself, not its target, chooses the action whose value bootstraps (van Hasselt,
    Guez and Silver, "Deep Reinforcement Learning with Double Q-learning", 2016)."""
    loss_function: str = "l2"
    """The loss of the temporal-difference error d: "l2", d^2; "smooth_l1" (Huber); "l1"; or "log_cosh",
    ln cosh d, as in some versions of the study's program (`cprl.objectives.LogCoshDQNLoss`)."""
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES
    can_be_recurrent: ClassVar[bool] = True
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_loss(self, network: nn.Module) -> LossModule:
        is_ours = self.loss_function == LOG_COSH
        make = LogCoshDQNLoss if is_ours else partial(objectives.DQNLoss, loss_function=self.loss_function)
        loss = make(q_actor(network), delay_value=True, double_dqn=self.double, action_space="categorical")
        return self.bootstrapped(loss)


@dataclass(frozen=True, kw_only=True)
class DistributionalDQN(OffPolicy):
    """C51: learns the distribution of returns over fixed atoms, TorchRL's `DistributionalDQNLoss`.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).
    Theirs bootstraps from the action that the target network values most; TorchRL's loss lets the network
    itself choose it, as double DQN does, and takes its distribution from the target.
    """

    atoms: Annotated[int, Range(2, MOST_CELLS)] = 51
    lowest_return: Return = 0.0
    highest_return: Return = 100.0
    """The range of the atoms: discounted returns in apples. With a discount of 0.995 one apple per step
    amounts to 200."""
    batching: ClassVar[Batching | None] = "lane_axis_flat"

    def __post_init__(self) -> None:
        super().__post_init__()
        atoms = np.linspace(self.lowest_return, self.highest_return, self.atoms, dtype=np.float32)
        if not (np.diff(atoms) > 0).all():
            raise ValueError(
                f"DistributionalDQN.highest_return is {self.highest_return}; allowed: above lowest_return, "
                f"{self.lowest_return}, and so far that float32 tells {self.atoms} atoms apart"
            )

    def make_network(self, spaces: Spaces) -> nn.Module:
        actions = spaces.actions
        return AtomNetwork(
            self.new_network(spaces, actions * self.atoms),
            actions=actions,
            lowest=self.lowest_return,
            highest=self.highest_return,
            atoms=self.atoms,
        )

    def make_loss(self, network: AtomNetwork) -> LossModule:
        self.refuse_relu()
        actor = DistributionalQValueActor(
            OtherOutputs(network, "atom_logits"),
            support=network.support,
            spec=None,
            action_space="categorical",
        )
        return objectives.DistributionalDQNLoss(actor, gamma=self.settings.gamma, delay_value=True)


@dataclass(frozen=True, kw_only=True)
class CQL(OffPolicy):
    """Conservative Q-learning, TorchRL's `DiscreteCQLLoss`: half the temporal-difference loss, plus a
    conservative term that lowers the values of actions that were not taken.

    Source: Kumar et al., "Conservative Q-Learning for Offline Reinforcement Learning" (2020).
    """

    conservative_weight: Weight = 0.1
    """The weight of the conservative term. TorchRL's weight is 1, for fixed data sets; with it, agents that
    explore imitate their first random actions (`tests/test_optimum.py`)."""
    loss_function: str = "l2"
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_loss(self, network: nn.Module) -> LossModule:
        loss = _WeightedCQLLoss(
            q_actor(network),
            weight=self.conservative_weight,
            delay_value=True,
            loss_function=self.loss_function,
            action_space="categorical",
        )
        bootstrap_from_target(self.bootstrapped(loss).value_estimator)
        return loss


class _WeightedCQLLoss(objectives.DiscreteCQLLoss):
    """`DiscreteCQLLoss` with a weight for the conservative term."""

    def __init__(self, actor: QValueActor, *, weight: float, **options: Any) -> None:
        super().__init__(actor, **options)
        self._weight = weight

    def cql_loss(self, tensordict: TensorDictBase) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        loss, metadata = super().cql_loss(tensordict)
        return self._weight * loss, metadata


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
    loss_function: str = "l2"
    stochastic: ClassVar[bool] = True
    batching: ClassVar[Batching | None] = "vmapped"

    def make_network(self, spaces: Spaces) -> nn.Module:
        actions = spaces.actions
        return self.new_networks(spaces, actor=actions, critic_0=actions, critic_1=actions)

    def make_loss(self, network: AgentNetworks) -> LossModule:
        self.refuse_relu()
        loss = objectives.DiscreteSACLoss(
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


@dataclass(frozen=True, kw_only=True)
class IQL(OffPolicy):
    """Implicit (not independent) Q-learning for discrete actions, TorchRL's `DiscreteIQLLoss`.

    Source: Kostrikov, Nair and Levine, "Offline Reinforcement Learning with Implicit Q-Learning" (2021).
    """

    expectile: Annotated[float, Range(0.5, 0.999)] = 0.7
    """The expectile of the action values that the state value estimates, 0.5..0.999."""
    temperature: Weight = 3.0
    """The inverse temperature of the advantage weights, in 1/reward (1/apples)."""
    loss_function: str = "l2"
    stochastic: ClassVar[bool] = True
    batching: ClassVar[Batching | None] = "vmapped"

    def make_network(self, spaces: Spaces) -> nn.Module:
        actions = spaces.actions
        return self.new_networks(spaces, actor=actions, critic_0=actions, critic_1=actions, value=1)

    def make_loss(self, network: AgentNetworks) -> LossModule:
        self.refuse_relu()
        loss = objectives.DiscreteIQLLoss(
            policy(network["actor"]),
            [module_of(network[name], "state_action_value") for name in ("critic_0", "critic_1")],
            module_of(network["value"], "state_value"),
            action_space="categorical",
            num_qvalue_nets=2,
            loss_function=self.loss_function,
            temperature=self.temperature,
            expectile=self.expectile,
        )
        return self.bootstrapped(loss)


Temperature = Annotated[float, Range(1e-6, 1e6)]


@dataclass(frozen=True, kw_only=True)
class PR2(OffPolicy):
    """Probabilistic recursive reasoning with discrete actions, `cprl.objectives.PR2Loss`.

    The agent learns the values of joint actions from the actions that all agents took, expects its peers to
    answer each of its actions as suits the agent itself, and draws its action from the soft values that
    result. Acting takes its own observation alone. With more than two agents values are sums over pairs of
    the agent and a peer. The peers may learn by anything, or not at all.

    Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement Learning" (2019).
    """

    temperature: Temperature = 0.1
    """Of the policy and of the peers' expected answers, in units of reward (apples), 1e-6..1e6."""
    entropy_bonus: bool = True
    """Whether values contain the entropy of the joint action, as in the paper, which pays agents for every
    step that they live; see `PR2Loss`."""
    loss_function: str = "l2"
    """As `DQN.loss_function`."""
    stochastic: ClassVar[bool] = True
    sees_peers_actions: ClassVar[bool] = True
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_network(self, spaces: Spaces) -> nn.Module:
        if spaces.agents < 2:
            raise ValueError(
                f"{type(self).__name__} learns from the actions of its peers, and the game has "
                f"{spaces.agents} agent; allowed: games of 2 agents or more; for one agent use DQN or SAC"
            )
        peers, actions = spaces.agents - 1, spaces.actions
        options = {"relu_on_outputs": self.settings.relu_on_outputs}
        values = self.new_network(spaces, peers * actions * actions, **options)
        return JointNetwork(values, actions=actions, peers=peers, temperature=self.temperature)

    def make_loss(self, network: JointNetwork) -> LossModule:
        loss = PR2Loss(
            OtherOutputs(network, "joint_values"),
            temperature=self.temperature,
            entropy_bonus=self.entropy_bonus,
            loss_function=self.loss_function,
        )
        return self.bootstrapped(loss)


@dataclass(frozen=True, kw_only=True)
class Tabular(Algorithm):
    """Tabular Q-learning; see `TabularLearner`."""

    settings: TabularSettings
    settings_kind: ClassVar[type[Any]] = TabularSettings

    def make_network(self, spaces: Spaces) -> TableNetwork:
        return table_network(spaces)

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        # Tables are neither compiled nor on a GPU.
        self._refuse_torchrl(engine)
        self.make_network(who.spaces)
        return TabularLearner(who, self.settings)
