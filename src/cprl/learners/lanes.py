"""Lanes: the agents that a learner trains in every replica, with their seeds, networks and actors."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar, Final, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cprl import keys
from cprl.keys import Turn
from cprl.learners.base import Learner, LearningAgents
from cprl.learners.engine import WAYS, Batching, Engine, ListEngine, MakeLoss, UpdateRule, make_engine
from cprl.learners.ring import Horizon, TransitionForm
from cprl.learners.transitions import LaneTurn, by_lane, joint_actions, lane_turn
from cprl.learners.trial import TRIAL_LANES, fitting_engine
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_cells_of
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import EVALUATION, seed_of

MakeTeam = Callable[[Sequence[nn.Module]], nn.Module]
"""Makes the networks of a team from those of its members: `AgentNetworks`, a `cprl.networks.team.Team` first.
Members that share parameters are one and the same network."""

STATE_BEFORE, STATE = keys.RECURRENT_STATE_BEFORE[-1], keys.RECURRENT_STATE[-1]
"""Entries of the states of recurrent networks in a turn."""
_SHARED: Final = 1
"""The last number of the seed of the parts that a team adds to its members' networks."""


class Acts(Protocol):
    """Evaluates the current networks of many lanes, as an `Engine` does."""

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any: ...

    def network_state(self, lane: int) -> dict[str, Tensor]: ...


@dataclass(frozen=True, kw_only=True)
class Method:
    """How agents learn: what an algorithm says of its networks and its loss, see `cprl.algorithms.base`."""

    settings: Any
    make_network: Callable[[], nn.Module]
    """Makes the networks of one agent. It draws weights from torch's generator, which is seeded for each
    lane."""
    make_loss: MakeLoss
    """Makes a lane's loss from its networks."""
    batching: Batching | None = None
    """How lanes are updated; None for the fastest way that works, see `cprl.learners.trial`."""
    make_team: MakeTeam | None = None
    """Makes the networks of a team from those of its members; a lane is then the team of a replica."""
    own_rewards: bool = False
    """Whether each member of a team learns from what it wants itself, with rewards [.., S, 1]; else all have
    the team reward, [.., 1]."""
    noise_numbers: int = 0
    """See `cprl.algorithms.OffPolicy`; the numbers are each lane's own."""
    stochastic: bool = False
    """See `cprl.algorithms.Algorithm`."""
    sees_peers: bool = False
    """Whether a lane's stored action is that of all N agents, see `transitions.joint_actions`."""


class Lanes:
    """What learns apart: each of R x S agents, or the team of S agents of each replica; in order of replicas.

    Members of a team have the seeds of initial weights and exploration that they would have as independent
    agents.
    """

    def __init__(self, who: LearningAgents, method: Method) -> None:
        self.who, self.method = who, method
        self.spaces, self.agents, self.replicas = who.spaces, who.agents, who.replicas
        self.worlds = who.worlds
        size, self.is_team = len(who.agents), method.make_team is not None
        if self.is_team and method.sees_peers:
            raise ValueError(
                "sees_peers is True; allowed for a team, whose actions are stored together: False"
            )
        self.member_shape = (size,) if self.is_team else ()
        """The axes of the members of a lane: (S,) of a team, () of one agent."""
        self._sharing = size if who.share_parameters else 1
        self.state_cells = 0
        """The numbers H of the state of an acting network, 0 without one; known once there are networks."""
        self._acting: Any = None
        """The acting network of a team, of which architecture alone matters; likewise."""

    def __len__(self) -> int:
        return self.replicas * (1 if self.is_team else len(self.agents))

    @property
    def sharing(self) -> int:
        """How many lanes share a network; those of teams share within theirs."""
        return 1 if self.is_team else self._sharing

    def form(self, horizon: Horizon | None = None, sequence_steps: int = 1) -> TransitionForm:
        """What is stored of a turn and sampled, see `TransitionForm`."""
        noise = self.method.noise_numbers
        return TransitionForm(
            observation_shape=(*self.member_shape, *self.spaces.observation_shape),
            observation_dtype=self.spaces.observation_dtype,
            action_shape=(self.spaces.agents,) if self.method.sees_peers else self.member_shape,
            reward_shape=self.member_shape if self.method.own_rewards else (),
            noise_shape=(*self.member_shape, noise) if noise else (),
            horizon=horizon,
            state_cells=self.state_cells,
            sequence_steps=sequence_steps,
        )

    @property
    def columns(self) -> Tensor:
        """Where the worlds of each lane stand in a `LaneTurn`, int64 [L, W]."""
        return self.by_lane(torch.arange(len(self) * self.worlds))

    def by_lane(self, columns: Any) -> Tensor:
        """A field of a `LaneTurn`, [C, ...], as one of lanes and their worlds, [L, W, ...]."""
        return by_lane(torch.as_tensor(columns), replicas=self.replicas, worlds=self.worlds)

    def by_world(self, values: Tensor) -> Tensor:
        """Values of lanes in their worlds, [L, W, 1], of teams [L, W, S, 1], as those of the agents of each
        world, [B, S]."""
        by_replica = values.reshape(self.replicas, -1, self.worlds, prod(self.member_shape))
        return by_replica.transpose(1, 2).reshape(-1, len(self.agents))

    def turn(self, turn: Turn, rewards: Any) -> LaneTurn:
        """One transition of every lane in each of its worlds; see `lane_turn`.

        Args:
            rewards: of all agents, [B, N]; those of a team without `own_rewards` all the same.
        """
        lanes = lane_turn(self.agents, turn, rewards, are_team=self.is_team)
        if self.is_team and not self.method.own_rewards:
            lanes = lanes._replace(reward=lanes.reward[:, 0])
        if self.method.sees_peers:
            lanes = lanes._replace(action=joint_actions(self.agents, turn))
        if self.state_cells:
            before, after = (self.states_in(turn, name) for name in (STATE_BEFORE, STATE))
            lanes = lanes._replace(recurrent_state=before, next_recurrent_state=after)
        return lanes

    def seen_next(self, turn: Turn) -> Tensor:
        """The observations of lanes after a turn, uint8 [L, W, *observation_shape]."""
        seen = torch.as_tensor(turn.next_agents["observation"])[:, list(self.agents)]
        return self.by_lane(seen.reshape(-1, *self.member_shape, *self.spaces.observation_shape))

    def states_in(self, turn: Turn, name: str = STATE_BEFORE) -> Any:
        """The states of recurrent networks before a turn, or by their other name after it, float32 [C, H], of
        teams [C, S, H]; an array as those of a `LaneTurn`."""
        states = turn.agents[name][:, list(self.agents), : self.state_cells]
        return states.reshape(-1, *self.member_shape, self.state_cells)

    def by_agent(self, values: Tensor) -> Tensor:
        """Values of networks as values of the agents of each replica, [R, S]; members of a team, and agents
        that share a network, have the same."""
        return values.view(self.replicas, -1).expand(-1, len(self.agents))

    def of_replicas(self, marked: Tensor) -> Tensor:
        """Flags of replicas, [R], as flags of networks."""
        return marked.repeat_interleave(len(self) // self.sharing // self.replicas)

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """The seed of each lane; that of a team is its first member's."""
        return self.who.seeds(purpose)[:: len(self.agents) if self.is_team else 1]

    def new_networks(self, purpose: int) -> list[nn.Module]:
        """New networks for each lane, or for each replica whose agents share one; the acting ones with the
        weights to start from, if there are any.
        """
        make_network = self.method.make_network
        first, *others = self.who.seeds(purpose)[:: self._sharing]
        networks = [init_network(make_network, first)]
        self.state_cells = state_cells_of(acting_part(networks[0]))
        networks += [init_network(make_network, seed) for seed in others]
        starts = [self.who.start_from.get(name, {}) for name in self.who.names]
        for place, network in enumerate(networks):
            start, *same = starts[place * self._sharing : (place + 1) * self._sharing]
            if any(not _equal(start, weights) for weights in same):
                raise ValueError(
                    f"the agents {list(self.agents)} would start from different weights; allowed for agents "
                    "that share parameters: a run in which they shared them too"
                )
            if start:
                acting_part(network).load_state_dict(start)
        if self.method.make_team is not None:
            networks = self._teams(self.method.make_team, networks, purpose)
            self._acting = deepcopy(acting_part(networks[0]))
        return [network.to(self.who.device) for network in networks]

    def _teams(self, make_team: MakeTeam, networks: list[nn.Module], purpose: int) -> list[nn.Module]:
        teams, size = [], len(self.agents) // self._sharing
        for replica, seed in enumerate(self.seeds(purpose)):
            different = networks[replica * size : (replica + 1) * size]
            members = [network for network in different for _ in range(self._sharing)]
            teams.append(init_network(lambda members=members: make_team(members), (*seed, _SHARED)))  # type: ignore[misc]
        return teams

    def actor(self, engine: Acts, purpose: int, *, worlds: int = 1, compile: bool = False) -> LaneActor:
        """An actor with the current weights, and random numbers of its own for each agent and purpose."""
        return LaneActor(
            _of_members(engine, len(self.agents)) if self.is_team else engine.outputs,
            self.spaces.actions,
            seeds=self.who.seeds(purpose),
            agents=len(self.agents),
            worlds=worlds,
            stochastic=self.method.stochastic,
            state_cells=self.state_cells,
            compile=compile and not isinstance(engine, ListEngine),
        )

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each agent's acting network, by "replica_0/agent_0" and so on."""
        return {name: self._state(engine, place) for place, name in enumerate(self.who.names)}

    def _state(self, engine: Acts, place: int) -> dict[str, Tensor]:
        if not self.is_team:
            return engine.network_state(place // self.sharing)
        replica, member = divmod(place, len(self.agents))
        state: dict[str, Tensor] = self._acting.member_state(engine.network_state(replica), member)
        return state


def _of_members(engine: Acts, size: int) -> Callable[..., Any]:
    """The networks of the S members of teams: [R x S, k, ...] to [R x S, k, A], through those of teams, of
    [R, k, S, ...]; of recurrent ones also states, likewise."""

    def outputs(*seen: Tensor) -> Any:
        by_team = (entry.reshape(-1, size, *entry.shape[1:]).transpose(1, 2) for entry in seen)
        given = engine.outputs(*by_team)
        if isinstance(given, tuple):
            return tuple(output.transpose(1, 2).flatten(0, 1) for output in given)
        return given.transpose(1, 2).flatten(0, 1)

    return outputs


class LaneLearner(Learner):
    """What learners have in common whose lanes are updated together by an engine."""

    engine: Any
    actor: LaneActor
    ways: ClassVar[Sequence[Batching]] = WAYS
    """How it may update lanes, beside "list"."""

    def __init__(self, who: LearningAgents, method: Method) -> None:
        super().__init__(who, method.settings)
        self._lanes = Lanes(who, method)

    @property
    def lanes(self) -> int:
        """The number of lanes L = R x S, or of teams, R."""
        return len(self._lanes)

    @property
    def present(self) -> Acts:
        """The networks as they are now."""
        acts: Acts = self.engine
        return acts

    def _make_engine(
        self,
        networks: Sequence[nn.Module],
        targets: Sequence[nn.Module] | None = None,
        *,
        rule: UpdateRule,
        compile: bool,
    ) -> Engine:
        """The engine of all lanes, whose targets start as copies or as networks of their own."""
        method, batching = self._lanes.method, self._lanes.method.batching
        if batching is None or batching not in self.ways:
            few = networks[:TRIAL_LANES]
            batching = fitting_engine(few, method.make_loss, self._trial(len(few)), self.ways)
        options: dict[str, Any] = {"target_networks": targets, "sharing": self._lanes.sharing}
        make_loss = method.make_loss
        return make_engine(networks, make_loss, rule, batching=batching, compile=compile, **options)

    def _trial(self, lanes: int) -> TensorDict:
        """A synthetic batch of so many lanes, as the loss reads it."""
        raise NotImplementedError

    def evaluation_actor(self, worlds: int) -> LaneActor:
        actor = self._lanes.actor(self.present, EVALUATION, worlds=worlds)
        actor.epsilon = getattr(self.settings, "epsilon_evaluation", 0.0)
        return actor

    def networks(self) -> dict[str, nn.Module]:
        made = {}
        for name, weights in self._lanes.states(self.present).items():
            made[name] = acting_part(self._lanes.method.make_network())
            made[name].load_state_dict(weights)
        return made

    def finite(self) -> Tensor:
        return self._lanes.by_agent(self.engine.finite())

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes, of which "networks" repeats weights as `cprl.load` reads them."""
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


def _equal(weights: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    return weights.keys() == others.keys() and all(
        torch.equal(value, others[name]) for name, value in weights.items()
    )


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose initial weights depend on a seed alone; torch's generator is left unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_of(seed))
        return make_network()
