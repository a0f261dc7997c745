"""The base classes of algorithms: frozen dataclasses that make the networks, loss and learner of agents.

To write an algorithm, subclass `OffPolicy` or `OnPolicy` as a frozen dataclass with a field `settings`, and
define `make_network` and `make_loss`; docs/algorithms.md has an example.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, QValueActor
from torchrl.objectives import LossModule, ValueEstimators

from cprl.commons.spaces import Spaces
from cprl.learners.base import Learner, LearningAgents
from cprl.learners.engine import Batching
from cprl.learners.lanes import Method
from cprl.learners.reference import TorchRLReplayLearner, TorchRLRolloutLearner
from cprl.learners.replay import ReplayLearner
from cprl.learners.rollouts import RolloutLearner
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, DQNSettings, RolloutSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLP
from cprl.networks.recurrent import Recurrent, state_shape_of
from cprl.networks.specification import Network, new_network
from cprl.objectives.preferences import Preference, named
from cprl.objectives.td import TORCHRL_DISTANCES
from cprl.system.compat import LaneCategorical
from cprl.values import Custom, Range, Value, Where, checked

TrainingEngine: TypeAlias = Literal["compiled", "eager", "torchrl"]
"""How agents are updated. "compiled": all together, in one update that torch compiles; "eager": the same
update, uncompiled; "torchrl": by TorchRL's stock parts, one agent after the other."""
Weight = Annotated[float, Range(0, 1e6)]
"""Of a term of a loss."""


class Algorithm(Value, stored=False):
    """How an agent learns: hyperparameters, networks, loss and learner.

    Agents with equal algorithms learn as lanes of one stacked update, so an algorithm must be a frozen
    dataclass.
    """

    settings: Any
    """The hyperparameters."""
    network: Any
    """The architecture of its networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind: ClassVar[type[Any]] = object
    """The class of the settings."""
    stochastic: ClassVar[bool] = False
    """Whether the acting network outputs the logits of a policy, from which actions are sampled; else it
    outputs action values, and actions are epsilon-greedy."""
    loss_functions: ClassVar[tuple[str, ...]] = TORCHRL_DISTANCES
    """What its field `loss_function` may be, if it has one."""
    can_share_parameters: ClassVar[bool] = False
    """Whether agents of a team can share one network."""
    can_be_recurrent: ClassVar[bool] = False
    """Whether its networks can be recurrent: its loss must pass on the states of sequences, see
    `cprl.algorithms.base.module_of`."""

    batching: ClassVar[Batching | None] = None
    """How lanes are updated, see `cprl.learners.engine.Batching`. Each class says it for its own loss, with
    networks of cprl; where it does not, a trial finds the fastest way that works."""

    def __post_init__(self) -> None:
        super().__post_init__()
        name, functions = type(self).__name__, self.loss_functions
        checked(f"{name}.settings", self.settings, self.settings_kind)
        if hasattr(self, "loss_function"):
            allowed = Where(lambda function: function in functions, ", ".join(map(repr, functions)))
            checked(f"{name}.loss_function", self.loss_function, Annotated[str, allowed])
        network = getattr(self, "network", None)
        if isinstance(network, Recurrent) and not self.can_be_recurrent:
            raise ValueError(
                f"{name}.network is {network}; allowed for {name}, which does not learn from sequences: MLP, "
                "Conv, Custom; DQN, PPO, A2C, Reinforce, IPPO and MAPPO learn recurrent networks, and "
                "torchrl.envs.CatFrames shows any agent its latest observations"
            )

    def new_network(self, spaces: Spaces, outputs: int, **options: Any) -> nn.Module:
        """Return a new network of the algorithm's architecture; `options` are those of
        `cprl.networks.specification.new_network`."""
        network, cells = self.network, self.settings.hidden_cells
        if network is not None and cells != DEFAULT_HIDDEN_CELLS:
            raise ValueError(
                f"settings.hidden_cells is {cells}; allowed: the default, because the algorithm has a "
                "network; set the layers in the network"
            )
        options["glorot_uniform"] = getattr(self.settings, "glorot_uniform", False)
        return new_network(network or MLP(hidden_cells=cells), spaces, outputs, **options)

    def new_networks(self, spaces: Spaces, **outputs: int) -> AgentNetworks:
        """Return new networks by name, each with so many outputs; the acting one first."""
        return AgentNetworks({name: self.new_network(spaces, count) for name, count in outputs.items()})

    def make_network(self, spaces: Spaces) -> nn.Module:
        """New networks of one agent, initialised from torch's generator. They map observations [..., *shape]
        to [..., A]; several networks are `AgentNetworks`, the acting one first."""
        raise NotImplementedError(f"{type(self).__name__} must define make_network(spaces)")

    def make_loss(self, network: Any) -> LossModule:
        """TorchRL's loss over networks of `make_network`."""
        raise NotImplementedError(f"{type(self).__name__} must define make_loss(network)")

    def method(self, spaces: Spaces) -> Method:
        """What learners ask of the algorithm, for such observations and actions."""
        return Method(
            settings=self.settings,
            make_network=lambda: self.make_network(spaces),
            make_loss=self.make_loss,
            batching=None if isinstance(self.network, Custom) else vars(type(self)).get("batching"),
            stochastic=self.stochastic,
        )

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        """The learner of these agents in every replica; raises a ValueError where the algorithm does not
        support them, or the engine not the algorithm."""
        raise NotImplementedError(f"{type(self).__name__} must define make_learner(who, engine)")

    def _refuse_torchrl(self, engine: TrainingEngine) -> None:
        if engine == "torchrl":
            raise ValueError(
                f'{type(self).__name__} does not support engine="torchrl", which trains independent agents '
                'one after the other; allowed: engine="compiled" or "eager"'
            )


@dataclass(frozen=True, kw_only=True)
class OffPolicy(Algorithm, stored=False):
    """Learns from a replay buffer.

    The loss reads transitions with "observation", "action" and "next": "observation", "reward" [.., 1],
    "done", "terminated".
    """

    settings: DQNSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind: ClassVar[type[Any]] = DQNSettings
    can_share_parameters: ClassVar[bool] = True
    sees_peers_actions: ClassVar[bool] = False
    """Whether "action" is [.., N] in place of [..]: first the agent's own action, then those of the others in
    the order of their indices, whatever they learn by. Agents still act on their own observations alone."""
    noise_numbers: ClassVar[int] = 0
    """How many uniform numbers in 0..1 the loss reads for each transition, of each member of a team, to
    sample by: the entry "noise", float32 [.., noise_numbers] or [.., S, noise_numbers]. A loss that samples
    by torch's generator instead would make replicas depend on each other."""

    def make_network(self, spaces: Spaces) -> nn.Module:
        relu = self.settings.relu_on_outputs
        return self.new_network(spaces, spaces.actions, relu_on_outputs=relu)

    def bootstrapped(self, loss: LossModule) -> LossModule:
        """Return a loss, with targets that bootstrap after one step by the discount of the settings."""
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss

    def refuse_relu(self) -> None:
        """Raises a ValueError for `relu_on_outputs`, of algorithms without Q values to act by."""
        if self.settings.relu_on_outputs:
            raise ValueError(
                f"settings.relu_on_outputs is True; allowed for {type(self).__name__}, whose acting network "
                "does not output Q values: False"
            )

    def method(self, spaces: Spaces) -> Method:
        return replace(
            super().method(spaces), sees_peers=self.sees_peers_actions, noise_numbers=self.noise_numbers
        )

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        if engine == "torchrl":
            return TorchRLReplayLearner(who, self.method(who.spaces))
        return ReplayLearner(who, self.method(who.spaces), compile=engine == "compiled")


@dataclass(frozen=True, kw_only=True)
class OnPolicy(Algorithm, stored=False):
    """Learns from rollouts of the current policy.

    `make_network` returns `AgentNetworks`: "actor" outputs the policy's logits, "critic" one value. The loss
    reads "observation", "action", "action_log_prob", "advantage", "value_target" and "state_value".
    """

    settings: RolloutSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind: ClassVar[type[Any]] = RolloutSettings
    stochastic: ClassVar[bool] = True
    can_share_parameters: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_networks(spaces, actor=spaces.actions, critic=1)

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        if engine == "torchrl":
            return TorchRLRolloutLearner(who, self.method(who.spaces))
        return RolloutLearner(who, self.method(who.spaces), compile=engine == "compiled")


class TeamAlgorithm(Algorithm, stored=False):
    """Trains a team: agents that learn together and act independently, on their own observations.

    `make_network` returns the networks of one member. The loss reads observations [.., S, *shape] and actions
    [.., S] of S members. From replay, rewards are [.., 1], or [.., S, 1] where `shares_reward` is False; from
    rollouts, advantages are [.., S, 1].
    """

    shares_reward: ClassVar[bool] = True
    """Whether the members must get the team reward; else each has its own."""
    fewest_members: ClassVar[int] = 1
    """The smallest team that the algorithm supports."""

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """Makes the networks of a team from those of its members: `AgentNetworks`, the acting
        `cprl.networks.team.Team` first. Added networks are initialised from torch's generator."""
        raise NotImplementedError(f"{type(self).__name__} must define make_team(members, spaces)")

    def method(self, spaces: Spaces) -> Method:
        return replace(
            super().method(spaces),
            make_team=lambda members: self.make_team(members, spaces),
            own_rewards=not self.shares_reward,
        )

    def make_learner(self, who: LearningAgents, engine: TrainingEngine = "compiled") -> Learner:
        self._refuse_torchrl(engine)
        self._check_team(len(who.agents), who.reward_kind)
        return super().make_learner(who, engine)

    def _check_team(self, members: int, reward: Preference) -> None:
        name = type(self).__name__
        if self.shares_reward and reward != "team":
            raise ValueError(
                f'reward is {named(reward)}; allowed for {name}: "team", the sum over all agents; '
                f"DQN, PPO, IPPO, LOLA and MADDPG support {named(reward)}"
            )
        if members < self.fewest_members:
            raise ValueError(
                f"the team has {members} agents; allowed for {name}: at least {self.fewest_members}; DQN and "
                "VDN support fewer"
            )


def module_of(network: nn.Module, name: str, *, state: str = "recurrent_state") -> TensorDictModule:
    """A network as a TensorDict module.

    Args:
        state: the entry of the states before each step, of a recurrent network.
    """
    if state_shape_of(network) is None:
        return TensorDictModule(network, ["observation"], [name])
    return TensorDictModule(network, ["observation", state, "is_init"], [name, f"{state}_after"])


def q_actor(network: nn.Module) -> QValueActor:
    """TorchRL's `QValueActor` with a network's outputs as action values."""
    return QValueActor(module_of(network, "action_value"), spec=None, action_space="categorical")


def policy(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """TorchRL's categorical policy with a network's outputs as logits."""
    return ProbabilisticActor(
        module_of(network, "logits"),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=LaneCategorical,
        return_log_prob=True,
    )
