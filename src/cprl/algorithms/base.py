"""The base classes of algorithms: frozen dataclasses that make the networks, loss and learner of agents.

To write an algorithm, subclass `OffPolicy` or `OnPolicy` as a frozen dataclass with a field `settings`, and
define `make_network` and `make_loss`; docs/algorithms.md has an example.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, QValueActor
from torchrl.objectives import LossModule, ValueEstimators

from cprl.commons.spaces import Spaces
from cprl.learners.base import AnyLearner
from cprl.learners.choose_update import choose_update
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner, Memory
from cprl.learners.learner import TrainingEngine as TrainingEngine
from cprl.learners.networks import COMPILED_STEPS, LaneNetworks, Update
from cprl.learners.optimizers import UpdateRule
from cprl.learners.plain import PlainNetworks, PlainReplay, PlainRollouts
from cprl.learners.refusals import check_loss, refuse_other_parts
from cprl.learners.replay import Replay
from cprl.learners.rollouts import Rollouts
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, DQNSettings, RolloutSettings
from cprl.learners.transitions import Horizon
from cprl.networks.agent import AgentNetworks, acting_part
from cprl.networks.mlp import MLP
from cprl.networks.recurrent import Recurrent, state_cells_of, state_shape_of
from cprl.networks.specification import Network, new_network
from cprl.networks.team import Team
from cprl.objectives.rewards import Reward, reward_name
from cprl.objectives.td import TORCHRL_DISTANCES
from cprl.system.compat import LaneCategorical
from cprl.values import Custom, Range, Value, Where, checked, hints_of, refusal

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
    shares_reward: ClassVar[bool] = False
    """Whether the members of a team must get the team reward; else each has its own."""
    can_share_parameters: ClassVar[bool] = False
    """Whether agents of a team can share one network."""
    can_be_recurrent: ClassVar[bool] = False
    """Whether its networks can be recurrent: its loss must pass on the states of sequences, see
    `cprl.algorithms.base.module_of`."""

    update: ClassVar[Update | None] = None
    """How its lanes are updated. A class says it of its own loss and networks, see `said_update`; where none
    is said, "vmapped" is taken if that works, else "list", see `choose_update`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        name, functions = type(self).__name__, self.loss_functions
        checked(f"{name}.settings", self.settings, self.settings_kind)
        if hasattr(self, "loss_function"):
            allowed = Where(lambda function: function in functions, ", ".join(map(repr, functions)))
            checked(f"{name}.loss_function", self.loss_function, Annotated[str, allowed])
        self._refuse_unread(getattr(self, "loss", None))
        network = getattr(self, "network", None)
        if isinstance(network, Recurrent) and not self.can_be_recurrent:
            raise ValueError(
                f"{name}.network is {network}; allowed for {name}, which does not learn from sequences: MLP, "
                "Conv, Custom; DQN, PPO, A2C, Reinforce, IPPO and MAPPO learn recurrent networks, and "
                "torchrl.envs.CatFrames shows any agent its latest observations"
            )

    def _refuse_unread(self, loss: Custom | None) -> None:
        """Refuse what a loss of the user's own does not read, of an algorithm that has one."""
        if loss is None:
            return
        for name in hints_of(type(self)):
            value = getattr(self, name)
            default = getattr(type(self), name, None)
            if name not in ("settings", "network", "loss") and value != default:
                allowed = f"{default!r} with a loss of your own, {loss.target}"
                raise refusal(f"{type(self).__name__}.{name}", value, allowed)

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

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """The networks of a team from those of its members: `AgentNetworks`, the acting
        `cprl.networks.team.Team` first. Members that share parameters are one and the same network; added
        networks are initialised from torch's generator."""
        raise NotImplementedError(f"{type(self).__name__} must define make_team(members, spaces)")

    def make_loss(self, network: Any) -> LossModule:
        """TorchRL's loss over networks of `make_network`."""
        raise NotImplementedError(f"{type(self).__name__} must define make_loss(network)")

    def said_update(self) -> Update | None:
        """The `update` that its class says, or the one it is a subclass of; None where none is said.

        It is said of all that the class has, so it holds for subclasses that change the defaults of fields
        alone, or add what their parent does not have. It is not said of a network or a loss of a user's.
        """
        said_by = self._said_by()
        return None if said_by is None else said_by.update

    def _said_by(self) -> type["Algorithm"] | None:
        """The class whose `update` holds for this algorithm."""
        if isinstance(self.network, Custom) or getattr(self, "loss", None) is not None:
            return None
        kinds = type(self).__mro__
        place = next(place for place, kind in enumerate(kinds) if "update" in vars(kind))
        said_by: Any = kinds[place]
        if said_by.update is None:
            return None
        defined = {name for kind in kinds[:place] for name in vars(kind) if hasattr(said_by, name)}
        defined -= {*hints_of(said_by), "_called"}
        changes = any(not name.startswith("__") for name in defined)
        return None if changes or kinds[place:] != said_by.__mro__ else said_by

    def own_loss(self, loss: Custom, network: nn.Module) -> LossModule:
        """Return the loss of a user's own over a network, or networks, of `make_network`."""
        made = loss.make(network, self.settings)
        if not isinstance(made, LossModule):
            raise ValueError(
                f"the loss {loss.target} is a {type(made).__name__}; allowed: a function of (network, "
                "settings) that returns a torchrl.objectives.LossModule"
            )
        return made

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Memory:
        """What lanes learn from: a new `Replay` or `Rollouts`, for networks like this one of a lane."""
        raise NotImplementedError(f"{type(self).__name__} must define make_memory(lanes, network, engine)")

    def make_lane_networks(
        self,
        networks: Sequence[nn.Module],
        targets: Sequence[nn.Module] | None,
        lanes: Lanes,
        memory: Memory,
        engine: TrainingEngine,
    ) -> LaneNetworks | PlainNetworks:
        """The networks of all lanes, made of those of each; without `targets` these start as copies."""
        is_mean = getattr(self.settings, "mean_over_all_outputs", False)
        rule = UpdateRule.of(self.settings, loss_share=1 / lanes.spaces.actions if is_mean else 1.0)
        if engine == "torchrl":
            made = PlainNetworks(networks, self.make_loss, rule, target_networks=targets)
            check_loss(self.make_loss(deepcopy(networks[0])), memory.example(1)[0])
            return made
        sharing, update, said_by = lanes.sharing, self.said_update(), self._said_by()
        if update is None or said_by is None or not said_by.__module__.startswith("cprl."):
            update = choose_update(networks, self.make_loss, memory.example, said=update, sharing=sharing)
        return LaneNetworks(
            networks,
            self.make_loss,
            rule,
            update=update,
            target_networks=targets,
            sharing=sharing,
            compile=engine == "compiled" and memory.sequence_steps <= COMPILED_STEPS,
        )

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> AnyLearner:
        """The learner of these agents in every replica; raises a ValueError where the algorithm does not
        support them, or the engine not the algorithm."""
        return Learner(self, lanes, engine)

    def refuse_torchrl(self, engine: TrainingEngine) -> None:
        """Raises a ValueError for the engine that trains independent agents alone."""
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

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Replay:
        if lanes.are_teams and self.sees_peers_actions:
            raise ValueError(
                "sees_peers_actions is True; allowed for a team, whose actions are stored together: False"
            )
        settings, members = self.settings, lanes.members
        form = lanes.form(
            action_shape=(lanes.spaces.agents,) if self.sees_peers_actions else members,
            reward_shape=() if self.shares_reward else members,
            noise_shape=(*members, self.noise_numbers) if self.noise_numbers else (),
            horizon=Horizon(settings.n_steps, settings.gamma) if settings.n_steps > 1 else None,
            state_cells=state_cells_of(acting_part(network)),
            sequence_steps=settings.sequence_steps,
        )
        loss = self.make_loss(deepcopy(network))
        kind = PlainReplay if engine == "torchrl" else Replay
        return kind(lanes, settings, form, loss, stochastic=self.stochastic)


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

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Rollouts:
        refuse_other_parts(network)
        kind = PlainRollouts if engine == "torchrl" else Rollouts
        return kind(lanes, self.settings, network, self.make_loss(deepcopy(network)))


class TeamAlgorithm(Algorithm, stored=False):
    """Trains a team: agents that learn together and act independently, on their own observations.

    `make_network` returns the networks of one member. The loss reads observations [.., S, *shape] and actions
    [.., S] of S members. From replay, rewards are [.., 1], or [.., S, 1] where `shares_reward` is False; from
    rollouts, advantages are [.., S, 1].
    """

    shares_reward: ClassVar[bool] = True
    fewest_members: ClassVar[int] = 1
    """The smallest team that the algorithm supports."""

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> AnyLearner:
        self.refuse_torchrl(engine)
        self.check_team(len(lanes.agents), lanes.reward)
        return Learner(self, replace(lanes, are_teams=True), engine)

    def check_team(self, members: int, reward: Reward) -> None:
        """Raises a ValueError for a team that it cannot train, or another reward."""
        name = type(self).__name__
        if self.shares_reward and reward != "team":
            raise ValueError(
                f'reward is {reward_name(reward)}; allowed for {name}: "team", the sum over all agents; '
                f"DQN, PPO, IPPO, LOLA and MADDPG support {reward_name(reward)}"
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


def actor_critic_loss(
    network: AgentNetworks, kind: Callable[..., LossModule], **options: object
) -> LossModule:
    """Return a loss of TorchRL's over the "actor" and the "critic" of an agent or a team."""
    critic = module_of(network["critic"], "state_value", state="critic_recurrent_state")
    return kind(policy(network["actor"]), critic, **options)


def team_of(members: Sequence[nn.Module], spaces: Spaces) -> Team:
    """Return the networks of the members of a team as one."""
    return Team(members, observation_dims=len(spaces.observation_shape))
