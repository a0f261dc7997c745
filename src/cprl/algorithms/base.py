"""The base classes of algorithms, and how to write your own.

An algorithm is a frozen dataclass that makes the networks, the loss and the learner of agents. To write one,
subclass `OffPolicy` or `OnPolicy` as a frozen dataclass with a field `settings`, and define `make_network`
and `make_loss`; docs/algorithms.md has an example.
"""

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from inspect import getattr_static
from typing import Annotated, Any, ClassVar

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, QValueActor
from torchrl.objectives import LossModule, ValueEstimators

from cprl.commons.spaces import Spaces
from cprl.learners.choose_update import choose_update
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner, Memory, TrainingEngine as TrainingEngine
from cprl.learners.networks import COMPILED_STEPS, LaneNetworks, Update
from cprl.learners.optimizers import UpdateRule
from cprl.learners.plain import PlainNetworks, PlainReplay, PlainRollouts
from cprl.learners.refusals import check_loss, refuse_other_networks
from cprl.learners.replay import Replay
from cprl.learners.rollouts import Rollouts
from cprl.learners.settings import DEFAULT_HIDDEN_CELLS, DQNSettings, RolloutSettings, along_line
from cprl.learners.transitions import Horizon
from cprl.networks.agent import AgentNetworks, acting_network
from cprl.networks.mlp import MLP
from cprl.networks.recurrent import Recurrent, state_cells_of, state_shape_of
from cprl.networks.specification import Network, new_network
from cprl.networks.team import TeamNetwork
from cprl.objectives.rewards import Reward, reward_name
from cprl.system.compat.torchrl import LaneCategorical
from cprl.values import Custom, Range, Steps, Value, hints_of, refusal

Coefficient = Annotated[float, Range(0, 1e6)]
"""The weight of one term of a loss, 0 or more."""


class Algorithm(Value, stored=False):
    """The base of algorithms: it makes the networks, memory, loss and learner of agents.

    Agents whose specifications are equal, algorithm included, learn as lanes of one update. So an algorithm
    must be a frozen dataclass, whose values can be compared.
    """

    settings: Any
    """The hyperparameters."""
    network: Any
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic: ClassVar[bool] = False
    """True if the acting network outputs the logits of a policy, from which actions are sampled; else it
    outputs action values, and actions are epsilon-greedy."""
    shares_reward: ClassVar[bool] = False
    """True if the members of a team must learn from the team reward; else each can have its own."""
    can_share_parameters: ClassVar[bool] = False
    """True if the members of a team can share one network."""
    can_be_recurrent: ClassVar[bool] = False
    """True if the networks can be recurrent. Then the loss must pass on the states of sequences, see
    `cprl.algorithms.base.module_of`."""
    supports_torchrl: ClassVar[bool] = False
    """True if the engine "torchrl" can update the agents, see `cprl.learners.plain`."""

    update: ClassVar[Update | None] = None
    """How the lanes are updated, see `cprl.learners.networks.Update`. A class declares it for its own loss
    and networks, see `declared_update`. Without a declaration "vmapped" is taken if torch can vmap the loss,
    else "list", see `choose_update`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        name = type(self).__name__
        self._refuse_unread(getattr(self, "loss", None))
        network = getattr(self, "network", None)
        if isinstance(network, Recurrent) and not self.can_be_recurrent:
            raise ValueError(
                f"{name}.network is {network}; allowed for {name}, which does not learn from sequences: MLP, "
                "Conv, Custom; DQN, PPO, A2C, Reinforce, IPPO and MAPPO learn recurrent networks, and "
                "torchrl.envs.CatFrames shows any agent its latest observations"
            )

    def _refuse_unread(self, loss: Custom | None) -> None:
        """Raise a ValueError if the user gives a loss, and also changes a field that only the default loss
        reads."""
        if loss is None:
            return
        for name in hints_of(type(self)):
            value = getattr(self, name)
            default = getattr(type(self), name, None)
            if name not in ("settings", "network", "loss") and value != default:
                allowed = f"{default!r} with a loss of your own, {loss.target}"
                raise refusal(f"{type(self).__name__}.{name}", value, allowed)

    def new_network(self, spaces: Spaces, outputs: int, **options: Any) -> nn.Module:
        """Return a new network of the algorithm's architecture.

        Args:
            outputs: the number of outputs.
            options: further arguments of `cprl.networks.specification.new_network`.

        Raises:
            ValueError: if both the network and the settings say the hidden layers.
        """
        network = self.network
        cells = self.settings.hidden_cells
        if network is not None and cells != DEFAULT_HIDDEN_CELLS:
            raise ValueError(
                f"settings.hidden_cells is {cells}; allowed: the default, because the algorithm has a "
                "network; set the layers in the network"
            )
        options["glorot_uniform"] = getattr(self.settings, "glorot_uniform", False)
        return new_network(network or MLP(hidden_cells=cells), spaces, outputs, **options)

    def new_networks(self, spaces: Spaces, **outputs: int) -> AgentNetworks:
        """Return several new networks of an agent, e.g. `new_networks(spaces, actor=7, critic=1)`.

        Args:
            outputs: the number of outputs of each network, by its name, the acting network first.
        """
        return AgentNetworks({name: self.new_network(spaces, count) for name, count in outputs.items()})

    def make_network(self, spaces: Spaces) -> nn.Module:
        """Return the new network of one agent, which maps observations [..., *shape] to [..., A].

        Several networks are `AgentNetworks`, the acting one first. Weights are drawn from torch's global
        generator, which the caller has seeded.
        """
        raise NotImplementedError(f"{type(self).__name__} must define make_network(spaces)")

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """Return the networks of a team: `AgentNetworks`, the acting `cprl.networks.team.TeamNetwork` first.

        Args:
            members: what `make_network` returned for each member; members that share parameters have the
                same network. Networks that the team adds are drawn from torch's global generator.
        """
        raise NotImplementedError(f"{type(self).__name__} must define make_team(members, spaces)")

    def make_loss(self, network: Any) -> LossModule:
        """Return TorchRL's loss over a network, or networks, that `make_network` or `make_team` returned."""
        raise NotImplementedError(f"{type(self).__name__} must define make_loss(network)")

    def declared_update(self) -> Update | None:
        """Return the `update` that holds for this algorithm; None if no declaration does.

        A class declares `update` for the methods and the loss that it has. So the declaration holds for
        subclasses only if they override nothing but defaults of fields. It does not hold for a network or a
        loss of the user's.
        """
        declaring_class = self._declaring_class()
        return None if declaring_class is None else declaring_class.update

    def _declaring_class(self) -> type["Algorithm"] | None:
        """Return the class whose `update` holds for this algorithm, see `declared_update`."""
        if isinstance(self.network, Custom) or getattr(self, "loss", None) is not None:
            return None
        kind = type(self)
        declaring_class: Any = next(base for base in kind.__mro__ if "update" in vars(base))
        if declaring_class.update is None:
            return None
        names = {name for name in dir(declaring_class) if not name.startswith("__")}
        names -= {*hints_of(declaring_class), "_called"}  # fields may have other defaults
        for name in names:
            if getattr_static(kind, name) is not getattr_static(declaring_class, name):
                return None
        return declaring_class

    def custom_loss(self, loss: Custom, network: nn.Module) -> LossModule:
        """Return a loss of the user's over the networks of `make_network`.

        Raises:
            ValueError: if it is not a `LossModule`.
        """
        module = loss.make(network, self.settings)
        if not isinstance(module, LossModule):
            raise ValueError(
                f"the loss {loss.target} is a {type(module).__name__}; allowed: a function of (network, "
                "settings) that returns a torchrl.objectives.LossModule"
            )
        return module

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Memory:
        """Return the new memory of some lanes, a `Replay` or `Rollouts`.

        Args:
            network: the networks of one lane, for their architecture.
        """
        raise NotImplementedError(f"{type(self).__name__} must define make_memory(lanes, network, engine)")

    def make_lane_networks(
        self,
        networks: Sequence[nn.Module],
        targets: Sequence[nn.Module] | None,
        lanes: Lanes,
        memory: Memory,
        engine: TrainingEngine,
    ) -> LaneNetworks | PlainNetworks:
        """Return the networks of all lanes, which act and learn together.

        Args:
            networks: the networks of each lane.
            targets: the networks with each lane's initial target weights; None for copies of `networks`.
            memory: the memory of the lanes, which makes synthetic batches to try losses with.
        """
        loss_share = 1.0
        if getattr(self.settings, "mean_over_all_outputs", False):
            loss_share = 1 / lanes.spaces.actions
        rule = UpdateRule.of(self.settings, loss_share=loss_share)
        if engine == "torchrl":
            plain_networks = PlainNetworks(networks, self.make_loss, rule, target_networks=targets)
            check_loss(self.make_loss(deepcopy(networks[0])), memory.example(1)[0])
            return plain_networks
        update = self.declared_update()
        declaring_class = self._declaring_class()
        is_from_cprl = declaring_class is not None and declaring_class.__module__.startswith("cprl.")
        if update is None or not is_from_cprl:  # the declaration of a user's class is checked
            update = choose_update(
                networks, self.make_loss, memory.example, declared=update, sharing=lanes.sharing
            )
        return LaneNetworks(
            networks,
            self.make_loss,
            rule,
            update=update,
            target_networks=targets,
            sharing=lanes.sharing,
            compile=engine == "compiled" and memory.form.sequence_steps <= COMPILED_STEPS,
        )

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> Learner:
        """Return the learner of some agents in every replica.

        Raises:
            ValueError: if the algorithm does not support these agents, or the engine not the algorithm.
        """
        if engine == "torchrl" and not self.supports_torchrl:
            raise ValueError(
                f'{type(self).__name__} does not support engine="torchrl", which trains independent agents '
                'one after the other; allowed: engine="compiled" or "eager"'
            )
        return Learner(self, lanes, engine)


@dataclass(frozen=True, kw_only=True)
class OffPolicy(Algorithm, stored=False):
    """The base of algorithms that learn from a replay buffer.

    Their loss reads transitions: "observation", "action", and under "next" "observation", "reward" [.., 1],
    "done" and "terminated".
    """

    settings: DQNSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_share_parameters: ClassVar[bool] = True
    supports_torchrl: ClassVar[bool] = True
    sees_peers_actions: ClassVar[bool] = False
    """True if the loss reads the actions of all N agents of the game: "action" is [.., N] in place of [..],
    first the agent's own action, then the others' in the order of their indices. The others may learn by any
    algorithm. Agents still act on their own observations alone."""
    noise_numbers: ClassVar[int] = 0
    """The number of uniform numbers in 0..1 by which the loss samples, for each transition, or for each
    member of a team in it: the entry "noise", float32 [.., noise_numbers] or [.., S, noise_numbers]. A loss
    that drew from torch's global generator instead would make replicas depend on each other."""

    def make_network(self, spaces: Spaces) -> nn.Module:
        relu = self.settings.relu_on_outputs
        return self.new_network(spaces, spaces.actions, relu_on_outputs=relu)

    def bootstrapped(self, loss: LossModule) -> LossModule:
        """Return a loss after setting its target, r + gamma times the next value, or r after a terminal turn,
        with gamma of the settings."""
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss

    def refuse_relu(self) -> None:
        """Raise a ValueError if the settings have `relu_on_outputs`; for algorithms that do not act by Q
        values."""
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
        settings = self.settings
        options: dict[str, Any] = {}
        if self.sees_peers_actions:
            options["action_shape"] = (lanes.spaces.agents,)
        if self.shares_reward:
            options["reward_shape"] = ()
        if self.noise_numbers:
            options["noise_shape"] = (*lanes.members, self.noise_numbers)
        if settings.n_steps > 1:
            options["horizon"] = Horizon(settings.n_steps, settings.gamma)
        cells = state_cells_of(acting_network(network))
        form = lanes.form(state_cells=cells, sequence_steps=settings.sequence_steps, **options)
        loss = self.make_loss(deepcopy(network))
        make_replay = PlainReplay if engine == "torchrl" else Replay
        return make_replay(lanes, settings, form, loss, stochastic=self.stochastic)


@dataclass(frozen=True, kw_only=True)
class OnPolicy(Algorithm, stored=False):
    """The base of algorithms that learn from rollouts of the current policy.

    Their `make_network` returns `AgentNetworks`: "actor" outputs the policy's logits, "critic" one value.
    Their loss reads "observation", "action", "action_log_prob", "advantage", "value_target" and
    "state_value".
    """

    settings: RolloutSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic: ClassVar[bool] = True
    can_share_parameters: ClassVar[bool] = True
    supports_torchrl: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_networks(spaces, actor=spaces.actions, critic=1)

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Rollouts:
        refuse_other_networks(network)
        make_rollouts = PlainRollouts if engine == "torchrl" else Rollouts
        return make_rollouts(lanes, self.settings, network, self.make_loss(deepcopy(network)))


@dataclass(frozen=True, kw_only=True)
class ActorCritic(OnPolicy, stored=False):
    """The base of algorithms whose loss has a weight for the policy's entropy, and one for the critic."""

    entropy_coeff: Coefficient = 0.01
    """The weight of the policy's entropy in the loss."""
    entropy_coeff_end: Coefficient | None = None
    """The weight after the linear change; None for a constant one."""
    entropy_decay_steps: Steps = 1_000_000
    """Environment steps of the linear change, from the first step on, as
    `RolloutSettings.learning_rate_decay_steps`."""
    critic_coeff: Coefficient = 0.5
    """The weight of the critic's loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.entropy_coeff == 0 and self.entropy_coeff_end:  # A2CLoss then computes no entropy at all
            name = f"{type(self).__name__}.entropy_coeff_end"
            raise refusal(name, self.entropy_coeff_end, "None with an entropy_coeff of 0")

    def entropy_coeff_at(self, step: int) -> float:
        """Return the weight of the entropy at a step, counted from 0."""
        if self.entropy_coeff_end is None:
            return self.entropy_coeff
        return along_line(self.entropy_coeff, self.entropy_coeff_end, step / self.entropy_decay_steps)


class TeamAlgorithm(Algorithm, stored=False):
    """The base of algorithms that train a team: S agents that learn together and act on their own
    observations.

    Their `make_network` returns the networks of one member. Their loss reads the observations [.., S, *shape]
    and actions [.., S] of all members. Transitions from replay have rewards [.., 1], or [.., S, 1] if
    `shares_reward` is False; rollouts have advantages [.., S, 1].
    """

    shares_reward: ClassVar[bool] = True
    supports_torchrl: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 1
    """The smallest team that the algorithm supports."""
    is_one_lane: ClassVar[bool] = True
    """True if a team is one lane; else each member is a lane of its own."""

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> Learner:
        self.check_team(len(lanes.agents), lanes.reward)
        return super().make_learner(replace(lanes, are_teams=self.is_one_lane), engine)

    def check_team(self, members: int, reward: Reward) -> None:
        """Raise a ValueError if the algorithm supports no team of this size, or not its reward."""
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
    """Return a network as a TensorDict module that reads "observation".

    A recurrent network also reads the states before each step and "is_init", and writes the states after
    each step.

    Args:
        name: the entry that the outputs become.
        state: the entry with the states before each step; the states after it get "_after" behind this name.
    """
    if state_shape_of(network) is None:
        return TensorDictModule(network, ["observation"], [name])
    return TensorDictModule(network, ["observation", state, "is_init"], [name, f"{state}_after"])


def q_actor(network: nn.Module) -> QValueActor:
    """Return TorchRL's `QValueActor` with a network's outputs as action values."""
    return QValueActor(module_of(network, "action_value"), spec=None, action_space="categorical")


def policy(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """Return TorchRL's `ProbabilisticActor` of a categorical policy with a network's outputs as logits."""
    return ProbabilisticActor(
        module_of(network, "logits"),
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=LaneCategorical,
        return_log_prob=True,
    )


def actor_critic_loss(
    network: AgentNetworks, loss_class: Callable[..., LossModule], **options: object
) -> LossModule:
    """Return a loss of TorchRL's over the "actor" and the "critic" of an agent or a team.

    Args:
        loss_class: makes the loss of an actor and a critic, e.g. `A2CLoss`.
        options: further arguments of it.
    """
    critic = module_of(network["critic"], "state_value", state="critic_recurrent_state")
    return loss_class(policy(network["actor"]), critic, **options)


def team_of(members: Sequence[nn.Module], spaces: Spaces) -> TeamNetwork:
    """Return the networks of the members of a team as one network."""
    return TeamNetwork(members, observation_dims=len(spaces.observation_shape))
