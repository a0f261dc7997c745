"""Lanes: the agents that a learner trains in every replica, with their seeds, networks and actors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import Annotated, Any, Final, Protocol, TypeAlias

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.learners.engine import Engine, MakeLoss, SharedEngine, is_list
from cprl.learners.preferences import Preference, WantedRewards, check_preference
from cprl.learners.transitions import LaneTurn, array_of, joint_actions, lane_turn, seen_next
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_cells_of
from cprl.networks.specification import refuse_unseen
from cprl.policies.lanes import LaneActor
from cprl.system.memory import check_memory
from cprl.values import Natural, Range, Value

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION, EXHIBITION, NOISE = range(7)
"""The purposes of a lane's random numbers; each has its own seed."""

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""The state dict of the acting network with which each lane starts, by the lane's name."""

MakeTeam = Callable[[Sequence[nn.Module]], nn.Module]
"""Makes the networks of a team from those of its members: `AgentNetworks`, a `cprl.networks.team.Team` first.
Members that share parameters are one and the same network."""

_SHARED: Final = 1
"""The last number of the seed of the parts that a team adds to its members' networks."""
_COPIES: Final = 6
"""Of a lane's weights while it trains: as made, stacked, target, gradient and two of the optimiser."""
_LARGEST_SEED: Final = 2**63 - 1
_LEAST_BYTES: Final = 4096
"""Of a lane, whatever it learns by: its name, seeds and random number generators."""


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """The seed of each lane, replica by replica: (seed of the run, replica, agent, purpose)."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """The name of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


class Acts(Protocol):
    """Evaluates the current networks of many lanes; an `Engine` does."""

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """The outputs of the networks: [L, k, ...] to [L, k, ...]; recurrent ones read and give states."""

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the current weights of one lane, as the state dict of its acting network."""


@dataclass(frozen=True)
class LearningAgents(Value, stored=False):
    """Who learns: S agents of each of R replicas, what they want, and what they start from.

    Made and checked once, then handed whole to the learner.
    """

    spaces: Spaces
    """The shape and dtype of observations, and the number of actions A."""
    _: KW_ONLY
    agents: tuple[Natural, ...]
    """The indices of the agents, each once."""
    replicas: Annotated[int, Range(1, 2**20)]
    """The number of replicas R."""
    seed: int = 0
    """The seed of the run."""
    first_replica: int = 0
    """The index of the first replica, so that replica r can be trained alone."""
    reward_kind: Preference = "individual"
    """What they want, see `cprl.learners.preferences`."""
    start_from: StartFrom = field(default_factory=dict)
    """The weights with which acting networks, and their targets, start, by the lane's name; the others, such
    as critics, are new."""
    share_parameters: bool = False
    """Whether the agents of a replica share one network, which learns from all of them."""
    device: str | torch.device = "cpu"
    """The torch device of networks, stored turns and updates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        agents, everyone = self.agents, self.spaces.agents
        check_preference("reward_kind", self.reward_kind, everyone)
        if not agents or len(set(agents)) < len(agents) or not set(agents) <= set(range(everyone)):
            raise ValueError(
                f"agents is {agents}; allowed: one or more of the agents 0 to {everyone - 1}, each once"
            )
        lanes = len(agents) * self.replicas
        check_memory(
            f"{self.replicas} replicas of {len(agents)} agents", lanes * _LEAST_BYTES, "fewer replicas"
        )

    @property
    def names(self) -> list[str]:
        """The name of each agent's networks, see `lane_names`."""
        return lane_names(replicas=self._numbers, agents=self.agents)

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """The seed of each agent of each replica, see `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)

    @property
    def _numbers(self) -> range:
        return range(self.first_replica, self.first_replica + self.replicas)


@dataclass(frozen=True, kw_only=True)
class Method:
    """How agents learn: what an algorithm says of its networks and its loss, see `cprl.algorithms.base`."""

    settings: Any
    make_network: Callable[[], nn.Module]
    """Makes the networks of one agent. It draws weights from torch's generator, which is seeded for each
    lane."""
    make_loss: MakeLoss
    """Makes a lane's loss from its networks."""
    make_team: MakeTeam | None = None
    """Makes the networks of a team from those of its members; a lane is then the team of a replica."""
    own_rewards: bool = False
    """Whether each member of a team learns from what it wants itself, with rewards [.., S, 1]; else all have
    the team reward, [.., 1]."""
    noise_numbers: int = 0
    """How many uniform numbers the loss reads for each transition, of each member of a team: the entry
    "noise", float32 [.., noise_numbers] or [.., S, noise_numbers], from random numbers of each lane's own."""
    stochastic: bool = False
    """Whether networks output the logits of a policy from which actions are sampled, with no epsilon; else
    action values, with `epsilon` of the settings."""
    sees_peers: bool = False
    """Whether a lane's stored action is that of all N agents, see `transitions.joint_actions`."""


class Lanes:
    """R x S agents: S agents of each of R replicas. A lane is one of them, in order of replicas."""

    member_shape: tuple[int, ...] = ()
    """The axes of the members of a lane: none, since it is one agent."""

    def __init__(self, who: LearningAgents, method: Method) -> None:
        refuse_unseen(who.spaces)
        self.who, self.method = who, method
        self.spaces, self.agents, self.replicas = who.spaces, who.agents, who.replicas
        self.make_network = method.make_network
        self.sharing = len(self.agents) if who.share_parameters else 1
        """The number of agents that share a network."""
        self.state_cells = 0
        """The numbers H of the state of an acting network; known once there are networks, 0 for those without
        a state."""

    def __len__(self) -> int:
        return self.replicas * len(self.agents)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The shape of a lane's observation: (C, X, Y), (S, C, X, Y) of a team."""
        return *self.member_shape, *self.spaces.observation_shape

    @property
    def action_shape(self) -> tuple[int, ...]:
        """The shape of a lane's stored action: (), or (N,) if it sees those of peers; (S,) of a team."""
        return (*self.member_shape, self.spaces.agents) if self.method.sees_peers else self.member_shape

    @property
    def reward_shape(self) -> tuple[int, ...]:
        """The shape of a lane's reward in a replay buffer: (S,) if members of a team have their own."""
        return ()

    def turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every lane, as a replay buffer stores it; see `lane_turn`."""
        turn = lane_turn(self.agents, batch, rewards)
        if self.method.sees_peers:
            turn = turn._replace(action=joint_actions(self.agents, batch))
        if self.state_cells:
            states = self.recurrent_state(batch), self.recurrent_state(batch, keys.RECURRENT_STATE)
            before, after = map(array_of, states)
            turn = turn._replace(recurrent_state=before, next_recurrent_state=after)
        return turn

    def rollout_turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every lane, as a rollout stores it; see `lane_turn`."""
        return lane_turn(self.agents, batch, rewards)

    def seen_next(self, batch: TensorDictBase) -> Tensor:
        """The observations of lanes after a turn, uint8 [L, 1, *observation_shape]."""
        return seen_next(batch)[:, list(self.agents)].flatten(0, 1).unsqueeze(1)

    def recurrent_state(
        self, batch: TensorDictBase, entry: tuple[str, str] = keys.RECURRENT_STATE_BEFORE
    ) -> Tensor:
        """The states that lanes had before a turn, or by another entry after it, float32 [L, H], of teams
        [L, S, H]."""
        states: Tensor = batch.get(entry)
        return states[:, list(self.agents), : self.state_cells].flatten(0, 1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """Values of lanes, [L], as values of the agents of each replica, [R, S]."""
        return losses.view(self.replicas, len(self.agents))

    def of_replicas(self, marked: Tensor) -> Tensor:
        """Flags of replicas, [R], as flags of lanes, [L]."""
        return marked.repeat_interleave(len(self) // self.replicas)

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """The seed of each lane; that of a team is its first member's."""
        return self.who.seeds(purpose)

    def new_networks(self, purpose: int) -> list[nn.Module]:
        """New networks for each lane, or for each replica whose agents share one; the acting ones with the
        weights to start from, if there are any.
        """
        first, *others = self.who.seeds(purpose)[:: self.sharing]
        networks = [init_network(self.make_network, first)]
        _check_networks(networks[0], 1 + len(others), self.who.device)
        self.state_cells = state_cells_of(acting_part(networks[0]))
        networks += [init_network(self.make_network, seed) for seed in others]
        for place, network in enumerate(networks):
            names = self.who.names[place * self.sharing : (place + 1) * self.sharing]
            start, *same = (self.who.start_from.get(name, {}) for name in names)
            if any(not _equal(start, weights) for weights in same):
                raise ValueError(
                    f"the agents {list(self.agents)} would start from different weights; allowed for agents "
                    "that share parameters: a run in which they shared them too"
                )
            if start:
                acting_part(network).load_state_dict(start)
        return [network.to(self.who.device) for network in networks]

    def by_lane(self, engine: Engine) -> Engine:
        """An engine of the lanes, from that of their networks."""
        return SharedEngine(engine, self.sharing) if self.sharing > 1 else engine

    def by_member(self, engine: Acts) -> Acts:
        """The networks of all agents, from those of the lanes."""
        return engine

    def actor(self, engine: Acts, *, compile: bool) -> LaneActor:
        """The actor of training: the current weights, and random numbers of its own for each agent."""
        compile = compile and not is_list(engine)
        return self._actor(self.by_member(engine), EXPLORATION, compile=compile)

    def evaluation_actor(self, engine: Acts, worlds: int, *, epsilon: float) -> LaneActor:
        actor = self._actor(self.by_member(engine), EVALUATION, worlds=worlds)
        actor.epsilon = epsilon
        return actor

    def _actor(self, members: Acts, purpose: int, *, worlds: int = 1, compile: bool = False) -> LaneActor:
        return LaneActor(
            members.outputs,
            self.spaces.actions,
            seeds=self.who.seeds(purpose),
            agents=len(self.agents),
            worlds=worlds,
            stochastic=self.method.stochastic,
            state_cells=self.state_cells,
            compile=compile,
        )

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each agent's acting network, by "replica_0/agent_0" and so on."""
        members = self.by_member(engine)
        return {name: members.network_state(lane) for lane, name in enumerate(self.who.names)}

    def networks(self, engine: Acts) -> dict[str, nn.Module]:
        made = {}
        for name, weights in self.states(engine).items():
            made[name] = acting_part(self.make_network())
            made[name].load_state_dict(weights)
        return made


class Teams(Lanes):
    """Lanes that hold all members of a team instead of one agent: lane r is the team of replica r.

    Each member has the seeds of initial weights and exploration that it would have as an independent agent.
    Parts that `make_team` adds are initialised from torch's generator, which is seeded for each team.
    """

    def __init__(self, who: LearningAgents, method: Method) -> None:
        super().__init__(who, method)
        assert method.make_team is not None
        if method.sees_peers:
            raise ValueError(
                "sees_peers is True; allowed for a team: False; its members' actions are stored together"
            )
        self._make_team = make_team = method.make_team
        self.member_shape = (len(self.agents),)
        form = init_network(
            lambda: make_team(self._shared([self.make_network() for _ in range(self._networks)])),
            self.seeds(0)[0],
        )
        self._acting: Any = acting_part(form)

    def __len__(self) -> int:
        return self.replicas

    @property
    def _networks(self) -> int:
        """The number of networks of a team's members."""
        return len(self.agents) // self.sharing

    def _shared(self, networks: Sequence[nn.Module]) -> list[nn.Module]:
        """The network of each member, from the different ones."""
        return [network for network in networks for _ in range(self.sharing)]

    @property
    def reward_shape(self) -> tuple[int, ...]:
        return self.member_shape if self.method.own_rewards else ()

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        return self.who.seeds(purpose)[:: len(self.agents)]

    def new_networks(self, purpose: int) -> list[nn.Module]:
        members, size = super().new_networks(purpose), self._networks
        made = []
        for replica, seed in enumerate(self.seeds(purpose)):
            of_team = self._shared(members[replica * size : (replica + 1) * size])
            made.append(init_network(partial(self._make_team, of_team), (*seed, _SHARED)).to(self.who.device))
        return made

    def turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every team, as a replay buffer stores it: observations [R, S, C, X, Y], actions
        [R, S] and team rewards [R], or with `own_rewards` those of each member, [R, S].

        Args:
            rewards: of all agents, [R, N]; those of a team without `own_rewards` all the same.
        """
        turn = self.rollout_turn(batch, rewards)
        return turn if self.method.own_rewards else turn._replace(reward=turn.reward[:, 0])

    def rollout_turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every team, as a rollout stores it: as `turn`, with rewards [R, S]."""
        turn, size = super().rollout_turn(batch, rewards), (len(self), len(self.agents))
        of_members = {
            name: getattr(turn, name).reshape(*size, *getattr(turn, name).shape[1:])
            for name in ("observation", "action", "next_observation", "reward")
        }
        flags = {name: getattr(turn, name).reshape(size)[:, 0] for name in ("done", "terminated")}
        return turn._replace(**of_members, **flags)

    def seen_next(self, batch: TensorDictBase) -> Tensor:
        return seen_next(batch)[:, list(self.agents)].unsqueeze(1)

    def recurrent_state(
        self, batch: TensorDictBase, entry: tuple[str, str] = keys.RECURRENT_STATE_BEFORE
    ) -> Tensor:
        return super().recurrent_state(batch, entry).view(len(self), *self.member_shape, -1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """Values of teams, [R], repeated for each of their members, [R, S]."""
        return losses[:, None].expand(-1, len(self.agents))

    def by_lane(self, engine: Engine) -> Engine:
        return engine

    def by_member(self, engine: Acts) -> Acts:
        return _Members(engine, self._acting, len(self.agents))


class BaseLearner:
    """What learners of S agents of each of R replicas have in common."""

    def __init__(self, who: LearningAgents, settings: Any) -> None:
        self.who, self.settings, self.wants = who, settings, WantedRewards(who.reward_kind)
        self.spaces, self.agents, self.replicas = who.spaces, who.agents, who.replicas
        self.steps = 0

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def end_episode(self, ended: Tensor) -> None:
        """Does nothing where an episode has ended in the marked replicas, bool [R]."""


class LaneLearner(BaseLearner):
    """What learners have in common whose lanes are updated together by an engine."""

    engine: Any
    actor: LaneActor

    def __init__(self, who: LearningAgents, method: Method) -> None:
        super().__init__(who, method.settings)
        self._lanes = Teams(who, method) if method.make_team else Lanes(who, method)

    @property
    def lanes(self) -> int:
        """The number of lanes L = R x S, or of teams, R."""
        return len(self._lanes)

    @property
    def present(self) -> Acts:
        acts: Acts = self.engine
        return acts

    def evaluation_actor(self, worlds: int) -> LaneActor:
        return self._lanes.evaluation_actor(self.present, worlds, epsilon=0.0)

    def networks(self) -> dict[str, nn.Module]:
        return self._lanes.networks(self.present)

    def finite(self) -> Tensor:
        return self._lanes.by_agent(self.engine.finite())

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes; the tensors themselves, not copies.

        The entry "networks" repeats the weights of "update" in the form that `cprl.load` reads.
        """
        return {
            "networks": self._lanes.states(self.present),
            "update": self.engine.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "wants": self.wants.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.engine.load_state_dict(state["update"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.wants.load_state_dict(state["wants"])


class _Members:
    """Presents an engine of teams as one of their members, with lane = replica x S + member.

    Args:
        form: the acting network of a team, of which architecture alone matters.
    """

    def __init__(self, engine: Acts, form: Any, members: int) -> None:
        self._engine, self._form, self._members = engine, form, members

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """[R x S, k, C, X, Y] to [R x S, k, A], through networks of [R, k, S, ...]; of recurrent ones also
        states, likewise."""
        inputs = (
            seen.view(-1, self._members, *seen.shape[1:]).transpose(1, 2)
            for seen in (observation, *recurrent)
        )
        given = self._engine.outputs(*inputs, part=part)
        if isinstance(given, tuple):
            return tuple(output.transpose(1, 2).flatten(0, 1) for output in given)
        return given.transpose(1, 2).flatten(0, 1)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        replica, member = divmod(lane, self._members)
        state: dict[str, Tensor] = self._form.member_state(self._engine.network_state(replica), member)
        return state


def _equal(weights: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    return weights.keys() == others.keys() and all(
        torch.equal(value, others[name]) for name, value in weights.items()
    )


def _check_networks(network: nn.Module, lanes: int, device: str | torch.device) -> None:
    """Raises a TooLargeError if a device has too little memory to train a network like this for each lane."""
    size = sum(value.numel() * value.element_size() for value in network.parameters())
    check_memory(
        f"the networks of {lanes} learners, {size / 2**20:,.1f} MiB each, with targets and optimisers",
        lanes * size * _COPIES,
        "smaller networks or fewer replicas",
        device=device,
    )


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose initial weights depend on a seed alone; torch's generator is left unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_of(seed))
        return make_network()


def seed_of(seed: Sequence[int]) -> int:
    """The seed of a lane as one for a generator of torch."""
    return int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED)
