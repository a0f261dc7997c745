"""Learner: an algorithm, its lanes, their memory and their networks, as the training loop asks them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar, Final, Literal, Protocol, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.networks import LaneNetworks
from cprl.learners.transitions import LaneTurn, TransitionForm
from cprl.networks.agent import acting_part
from cprl.objectives.rewards import RewardModel
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import Purpose, seed_of

_OF_TEAMS: Final = {
    Purpose.WEIGHTS: Purpose.TEAM_WEIGHTS,
    Purpose.TARGET_WEIGHTS: Purpose.TEAM_TARGET_WEIGHTS,
}


TrainingEngine: TypeAlias = Literal["compiled", "eager", "torchrl"]
"""How agents are updated. "compiled": all together, in one update that torch compiles; "eager": the same
update, uncompiled; "torchrl": by TorchRL's stock parts, one agent after the other, see `plain`."""


class AnyAlgorithm(Protocol):
    """What a learner asks of an algorithm; `cprl.algorithms.Algorithm` has it."""

    @property
    def settings(self) -> Any: ...

    stochastic: ClassVar[bool]

    def make_network(self, spaces: Spaces) -> nn.Module: ...

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module: ...

    def make_loss(self, network: Any) -> LossModule: ...

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> "Memory": ...

    def make_lane_networks(
        self,
        networks: Sequence[nn.Module],
        targets: Sequence[nn.Module] | None,
        lanes: Lanes,
        memory: Any,
        engine: TrainingEngine,
    ) -> Any: ...


class Memory(Protocol):
    """What lanes learn from: it stores every turn, and says when there is something to learn from."""

    form: TransitionForm
    """What it stores of a turn."""
    sequence_steps: int
    """Consecutive turns of a sample; 1 for single ones."""

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None: ...

    def due(self, networks: Any) -> Iterator[Draw]:
        """The batches to learn from now, one after the other; none between updates."""
        ...

    def example(self, lanes: int) -> TensorDict:
        """A made-up batch of so many lanes, in the form of those that are due."""
        ...

    def values(self, networks: Any, turn: Turn) -> Tensor:
        """Estimates of the value of the state after a turn, [L, W, ..]."""
        ...

    def cut(self, networks: Any) -> None:
        """What is stored next does not follow what was stored last."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class Learner:
    """Learns for S agents of each of R replicas: stores every turn, and takes a step for each batch that its
    memory gives.

    Each lane has its own network, targets, optimiser state, memory and random numbers, and learns exactly as
    it would alone.

    Args:
        algorithm: how they learn.
        lanes: who learns.
        engine: how they are updated.
    """

    def __init__(self, algorithm: AnyAlgorithm, lanes: Lanes, engine: TrainingEngine = "compiled") -> None:
        self.algorithm, self.lanes, self.settings = algorithm, lanes, algorithm.settings
        self.agents, self.replicas, self.worlds = lanes.agents, lanes.replicas, lanes.worlds
        self.rewards = RewardModel(lanes.reward)
        self.steps = 0
        self._episodes = torch.zeros(lanes.replicas, dtype=torch.int64)
        networks = new_networks(algorithm, lanes, Purpose.WEIGHTS)
        self._acting: Any = deepcopy(acting_part(networks[0]))
        """Of a team its architecture matters alone."""
        self.memory = algorithm.make_memory(lanes, networks[0], engine)
        targets = None
        if getattr(self.settings, "own_target_weights", False):
            targets = new_networks(algorithm, lanes, Purpose.TARGET_WEIGHTS)
        self.lane_networks: LaneNetworks = algorithm.make_lane_networks(
            networks, targets, lanes, self.memory, engine
        )
        compiles = engine == "compiled" and self.lane_networks.update != "list"
        # The members of a team that learns by LOLA may act by other weights than their present ones.
        acting = getattr(self.lane_networks, "playing", self.lane_networks.outputs)
        self.actor = self._actor(acting, Purpose.EXPLORATION, lanes.worlds, compile=compiles)
        self._follow_schedules()

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def begin(self) -> None:
        """Called before the first turn of a training: what is stored of an earlier one does not go on."""
        self.memory.cut(self.lane_networks)

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Stores one turn of every world, of batch size [B]."""
        turn = Turn.of(batch)
        rewards, done = turn.next_agents["reward"], turn.next_world[keys.DONE]
        wanted = self.rewards.add(rewards[..., 0], done[..., 0])
        self.memory.write(turn, self.lanes.turn(turn, wanted, self.memory.form))
        self.steps += self.worlds
        self._follow_schedules()

    def update(self) -> Tensor | None:
        """Learns from all batches that are due; returns the mean losses [R, S], or None if none is."""
        networks = self.lane_networks
        losses = [networks.learn(draw) for draw in self.memory.due(networks)]
        if not losses:
            return None
        return self.lanes.by_agent(torch.stack(losses).mean(0) if len(losses) > 1 else losses[0])

    def end_episode(self, ended: Tensor) -> None:
        """Counts an episode of the marked worlds, bool [B]: the weights of a replica are copied to targets
        every `target_every_episodes` episodes. With `tau` these move after every update instead, and with
        `target_every_updates` they are copied between updates."""
        before = self._episodes
        self._episodes = before + ended.view(self.replicas, self.worlds).sum(1)
        rule, every = self.lane_networks.rule, getattr(self.settings, "target_every_episodes", None)
        if every is None or rule.tau is not None or rule.target_every_updates is not None:
            return
        due = self._episodes // every > before // every
        if due.any():
            self.lane_networks.copy_to_targets(self.lanes.by_network(due))

    @torch.no_grad()
    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [B, S]: its highest action value,
        or its critic's; NaN without either."""
        return self.lanes.by_world(self.memory.values(self.lane_networks, Turn.of(batch)))

    def finite(self) -> Tensor:
        """Whether everything that is kept of each agent is finite, bool [R, S]."""
        return self.lanes.by_agent(self.lane_networks.finite())

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """An actor with the current weights and the exploration of evaluation."""
        actor = self._actor(self.lane_networks.outputs, Purpose.EVALUATION, worlds, compile=False)
        actor.epsilon = getattr(self.settings, "epsilon_evaluation", 0.0)
        return actor

    def _follow_schedules(self) -> None:
        """Sets exploration and the learning rate to those of the present step; agents that sample from a
        policy do not explore."""
        epsilon = getattr(self.settings, "epsilon", None)
        self.actor.explore_with(0.0 if epsilon is None else epsilon(self.steps))
        if self.lane_networks.rule.falls:
            self.lane_networks.learning_rate = self.settings.learning_rate_at(self.steps)

    def _actor(
        self, outputs: Callable[..., Any], purpose: Purpose, worlds: int, *, compile: bool
    ) -> LaneActor:
        """An actor with random numbers of its own for each agent and purpose."""
        lanes = self.lanes
        return LaneActor(
            _of_members(outputs, len(lanes.agents)) if lanes.are_teams else outputs,
            lanes.spaces.actions,
            seeds=lanes.agent_seeds(purpose),
            agents=len(lanes.agents),
            worlds=worlds,
            stochastic=self.algorithm.stochastic,
            state_cells=self.memory.form.state_cells,
            compile=compile,
        )

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's acting network, by "replica_0/agent_0" and so on."""
        made = {}
        for name, weights in self._weights().items():
            made[name] = acting_part(self.algorithm.make_network(self.lanes.spaces))
            made[name].load_state_dict(weights)
        return made

    def _weights(self) -> dict[str, dict[str, Tensor]]:
        """The state dict of each agent's acting network, by the agent's name."""
        return {name: self._weights_of(place) for place, name in enumerate(self.lanes.names)}

    def _weights_of(self, place: int) -> dict[str, Tensor]:
        if not self.lanes.are_teams:
            return self.lane_networks.network_state(place // self.lanes.sharing)
        replica, member = divmod(place, len(self.agents))
        weights: dict[str, Tensor] = self._acting.member_state(
            self.lane_networks.network_state(replica), member
        )
        return weights

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes, of which "networks" repeats weights as `cprl.load` reads them."""
        return {
            "networks": self._weights(),
            "lane_networks": self.lane_networks.state_dict(),
            "memory": self.memory.state_dict(),
            "exploration": self.actor.rng.state_dict(),
            "rewards": self.rewards.state_dict(),
            "steps": self.steps,
            "episodes": self._episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self.lane_networks.load_state_dict(state["lane_networks"])
        self.memory.load_state_dict(state["memory"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.rewards.load_state_dict(state["rewards"])
        self.steps, self._episodes = int(state["steps"]), state["episodes"].clone()
        self._follow_schedules()


def _of_members(outputs: Callable[..., Any], size: int) -> Callable[..., Any]:
    """The outputs of the S members of teams, [R x S, k, ...] to [R x S, k, A], through those of teams, of
    [R, k, S, ...]; of recurrent ones also states, likewise."""

    def of_members(*seen: Tensor) -> Any:
        by_team = (entry.reshape(-1, size, *entry.shape[1:]).transpose(1, 2) for entry in seen)
        given = outputs(*by_team)
        if isinstance(given, tuple):
            return tuple(output.transpose(1, 2).flatten(0, 1) for output in given)
        return given.transpose(1, 2).flatten(0, 1)

    return of_members


def new_networks(algorithm: AnyAlgorithm, lanes: Lanes, purpose: Purpose) -> list[nn.Module]:
    """New networks of each lane, or of each replica whose agents share one; the acting ones with the weights
    to start from, if there are any."""
    sharing = len(lanes.agents) if lanes.share_parameters else 1
    seeds = lanes.agent_seeds(purpose)[::sharing]
    networks = [init_network(lambda: algorithm.make_network(lanes.spaces), seed) for seed in seeds]
    starts = [lanes.start_from.get(name, {}) for name in lanes.names]
    for place, network in enumerate(networks):
        start, *same = starts[place * sharing : (place + 1) * sharing]
        if any(not _equal(start, weights) for weights in same):
            raise ValueError(
                f"the agents {list(lanes.agents)} would start from different weights; allowed for agents "
                "that share parameters: a run in which they shared them too"
            )
        if start:
            acting_part(network).load_state_dict(start)
    if lanes.are_teams:
        networks = _teams(algorithm, lanes, networks, _OF_TEAMS[purpose])
    return [network.to(lanes.device) for network in networks]


def _teams(
    algorithm: AnyAlgorithm, lanes: Lanes, networks: Sequence[nn.Module], purpose: Purpose
) -> list[nn.Module]:
    """The networks of each replica's team, of those of its members; members that share one have the same."""
    teams, size = [], len(networks) // lanes.replicas
    for replica, seed in enumerate(lanes.seeds(purpose)):
        different = networks[replica * size : (replica + 1) * size]
        members = [network for network in different for _ in range(len(lanes.agents) // size)]

        def make_team(members: Sequence[nn.Module] = members) -> nn.Module:
            return algorithm.make_team(members, lanes.spaces)

        teams.append(init_network(make_team, seed))
    return teams


def _equal(weights: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    return weights.keys() == others.keys() and all(
        torch.equal(value, others[name]) for name, value in weights.items()
    )


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose initial weights depend on a seed alone; torch's generator is left unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_of(seed))
        return make_network()
