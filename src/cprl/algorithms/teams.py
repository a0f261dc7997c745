"""Algorithms of teams: agents that learn together and act independently, on their own observations.

A lane is then a team. VDN, QMIX and MAPPO change the social dilemma: their agents share one reward.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any, ClassVar, Literal

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import VDNMixer
from torchrl.objectives import LossModule
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss, QMixerLoss

from cprl.algorithms.base import OffPolicy, TeamAlgorithm, TrainingEngine, Weight, policy, q_actor
from cprl.algorithms.on_policy import Clipped
from cprl.commons.spaces import Spaces
from cprl.learners.base import Learner, LearningAgents
from cprl.learners.engine import Batching
from cprl.learners.lanes import Method
from cprl.learners.lola import LOLALearner
from cprl.learners.settings import LOLASettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLP, Cells, MLPNetwork
from cprl.networks.specification import Network
from cprl.networks.team import CentralCritic, JointCritics, Mixing, Team
from cprl.objectives import LOLADiCELoss, LOLALoss
from cprl.objectives.maddpg import NUMBERS, MADDPGLoss
from cprl.objectives.td import DISTANCES
from cprl.values import Custom

_CHOSEN, _OF_TEAM = "chosen_action_value", "team_value"


@dataclass(frozen=True, kw_only=True)
class VDN(TeamAlgorithm, OffPolicy):
    """Value decomposition: the team's value is the sum of its members' values, TorchRL's `QMixerLoss`.

    Source: Sunehag et al., "Value-Decomposition Networks For Cooperative Multi-Agent Learning" (2017).
    """

    batching: ClassVar[Batching | None] = "vmapped"

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        mixer = VDNMixer(len(members), device="cpu")
        return AgentNetworks({"actor": _team(members, spaces), "mixer": mixer})

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return self.bootstrapped(_mixed(network, [_CHOSEN]))


@dataclass(frozen=True, kw_only=True)
class QMIX(TeamAlgorithm, OffPolicy):
    """Monotonic mixing: the team's value never falls as a member's value rises. TorchRL's `QMixerLoss`.

    The mixing network reads the observations of all members. Source: Rashid et al., "QMIX: Monotonic Value
    Function Factorisation for Deep Multi-Agent Reinforcement Learning" (2018). Here members share no weights,
    unless `Team.share_parameters` says so, and their networks are not recurrent.
    """

    mixing_cells: Cells = 32
    """Units of the mixing layer."""
    fewest_members: ClassVar[int] = 2
    batching: ClassVar[Batching | None] = "vmapped"

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        mixer = Mixing(
            spaces.observation_shape,
            members=len(members),
            cells=self.mixing_cells,
            highest=spaces.observation_scale,
        )
        return AgentNetworks({"actor": _team(members, spaces), "mixer": mixer})

    def make_loss(self, network: AgentNetworks) -> LossModule:
        return self.bootstrapped(_mixed(network, [_CHOSEN, "observation"]))


@dataclass(frozen=True, kw_only=True)
class MAPPO(TeamAlgorithm, Clipped):
    """PPO with an actor per member and a central critic of all observations, TorchRL's `MAPPOLoss`.

    Source: Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games" (2022); here
    without value normalisation, and members share no weights, unless `Team.share_parameters` says so.
    """

    loss_kind: ClassVar[Callable[..., LossModule]] = MAPPOLoss
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_network(spaces, spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        everything = len(members), *spaces.observation_shape
        critic = self.new_network(spaces, 1, shape=everything)
        return AgentNetworks({"actor": _team(members, spaces), "critic": CentralCritic(critic, len(members))})


@dataclass(frozen=True, kw_only=True)
class IPPO(TeamAlgorithm, Clipped):
    """PPO with an actor and a critic per member, TorchRL's `IPPOLoss`.

    Unlike agents that each learn with `PPO`, members share gradient clipping and the normalisation of
    advantages. Source: de Witt et al., "Is Independent Learning All You Need in the
    StarCraft Multi-Agent Challenge?" (2020).
    """

    loss_kind: ClassVar[Callable[..., LossModule]] = IPPOLoss
    shares_reward: ClassVar[bool] = False
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        of_each: Sequence[Any] = members
        return AgentNetworks(
            {name: _team([member[name] for member in of_each], spaces) for name in ("actor", "critic")}
        )


def _team(members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
    return Team(members, observation_dims=len(spaces.observation_shape))


def _mixed(network: AgentNetworks, seen_by_mixer: Sequence[str]) -> LossModule:
    """`QMixerLoss` over a team's "actor" and "mixer", with entries at the root of the TensorDict."""
    loss = QMixerLoss(
        q_actor(network["actor"]),
        TensorDictModule(network["mixer"], list(seen_by_mixer), [_OF_TEAM]),
        delay_value=True,
        action_space="categorical",
    )
    loss.set_keys(action="action", action_value="action_value", local_value=_CHOSEN, global_value=_OF_TEAM)
    return loss


@dataclass(frozen=True, kw_only=True)
class MADDPG(TeamAlgorithm, OffPolicy):
    """Multi-agent deep deterministic policy gradient for discrete actions, `cprl.objectives.MADDPGLoss`.

    Each member has a policy of what it observes itself and a critic of what all members observe and do, and
    learns from its own reward: members may cooperate, compete or both. Agents outside the team are part of
    the environment: critics see nothing of them. Members sample their actions from their policies, in
    training and in evaluation.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017); how
    this differs is listed in docs/opponents.md.
    """

    logit_penalty: Weight = 1e-3
    """The weight of the mean squared logit in the actors' loss, 0..1e6; 1e-3 in the published program."""
    loss_function: str = "l2"
    """The loss of the critics' temporal-difference errors, as `DQN.loss_function`."""
    network: Network | Custom | None = None
    """As `DQN.network`. The critics' fully connected layers read observations and actions side by side.
    Another network maps the observations of all members to as many features as the last of
    `settings.hidden_cells` has units, and one more layer of that size joins them with the actions."""
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 2
    stochastic: ClassVar[bool] = True
    noise_numbers: ClassVar[int] = NUMBERS
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES
    batching: ClassVar[Batching | None] = "lane_axis"

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_network(spaces, spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        return AgentNetworks({"actor": _team(members, spaces), "critic": self._critics(len(members), spaces)})

    def _critics(self, members: int, spaces: Spaces) -> JointCritics:
        everything = members, *spaces.observation_shape
        dims, joint = len(everything), members * spaces.actions
        cells, encoders, features = self.settings.hidden_cells, None, prod(everything)
        if isinstance(self.network, MLP):
            cells = self.network.hidden_cells
        elif self.network is not None:
            features, cells = cells[-1], cells[-1:]
            each = [self.new_network(spaces, features, shape=everything) for _ in range(members)]
            encoders = Team(each, observation_dims=dims)
        options = {name: getattr(self.settings, name) for name in ("relu_on_outputs", "glorot_uniform")}
        shape = (features + joint,)
        heads = [MLPNetwork(shape, 1, hidden_cells=cells, highest=1.0, **options) for _ in range(members)]
        return JointCritics(
            Team(heads, observation_dims=1),
            encoders,
            observation_dims=dims - 1,
            highest=spaces.observation_scale,
        )

    def make_loss(self, network: AgentNetworks) -> LossModule:
        loss = MADDPGLoss(
            TensorDictModule(network["actor"], ["observation"], ["logits"]),
            TensorDictModule(network["critic"], ["observation", "joint_action"], ["state_action_value"]),
            loss_function=self.loss_function,
            logit_penalty=self.logit_penalty,
        )
        return self.bootstrapped(loss)


@dataclass(frozen=True, kw_only=True)
class LOLA(TeamAlgorithm):
    """Learning with opponent-learning awareness: each member expects the others to take a naive learning
    step, which depends on what it does, and learns what is good for it after that step.

    Members read each other's weights when they learn; they act on their own observations. Meant for rewards
    of their own, `Team(LOLA(...), agents=(0, 1), reward="individual")`. With more than two members the terms
    of all pairs are summed. Losses: `cprl.objectives.LOLALoss`, `LOLADiCELoss`. The engine "compiled"
    compiles acting alone.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), and "DiCE: The Infinitely
    Differentiable Monte Carlo Estimator" (2018); docs/opponents.md lists the departures.
    """

    settings: LOLASettings
    estimator: Literal["policy_gradient", "dice"] = "policy_gradient"
    """How the others' step is judged: "policy_gradient", to first order, from two rollouts of the present
    weights; "dice", by a rollout for each member in which the others act as after their step. All rollouts
    are turns of the training's own episodes; evaluation always has the present weights."""
    entropy_coeff: Weight = 0.0
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind: ClassVar[type[Any]] = LOLASettings
    stochastic: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 2

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_networks(spaces, actor=spaces.actions, critic=1)

    def make_loss(self, network: Any) -> LossModule:
        actors = [policy(member["actor"]) for member in network]
        make = LOLADiCELoss if self.estimator == "dice" else LOLALoss
        rate, gamma = self.settings.look_ahead_rate, self.settings.gamma
        return make(actors, look_ahead_rate=rate, gamma=gamma, entropy_coeff=self.entropy_coeff)

    def method(self, spaces: Spaces) -> Method:
        return replace(super().method(spaces), make_team=None)  # members are lanes of their own

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        self._refuse_torchrl(engine)
        self._check_team(len(who.agents), who.reward_kind)
        return LOLALearner(who, self.method(who.spaces), compile=engine == "compiled")
