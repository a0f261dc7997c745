"""Learner: the agents that learn by one algorithm, with their actor, memory and networks.

A learner stores each turn in its memory. The memory says when there is a batch to learn from; the lane
networks take an update for each batch.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any, Final, Literal, Protocol, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes, outputs_by_agent
from cprl.learners.networks import LaneNetworks
from cprl.learners.settings import LearningRateDecay
from cprl.learners.transitions import LaneTurn, TransitionForm
from cprl.networks.agent import acting_network
from cprl.objectives.rewards import RewardModel
from cprl.policies.actors import LaneActor
from cprl.policies.rng import Purpose, seed_of

_TEAM_PURPOSES: Final = {
    Purpose.WEIGHTS: Purpose.TEAM_WEIGHTS,
    Purpose.TARGET_WEIGHTS: Purpose.TEAM_TARGET_WEIGHTS,
}
"""By the purpose of a member's random numbers, that of the networks that its team adds, such as mixers."""


TrainingEngine: TypeAlias = Literal["compiled", "eager", "torchrl"]
"""How agents are updated. "compiled": all together, in one update that torch compiles; "eager": the same
update, uncompiled; "torchrl": one agent after the other, by TorchRL's stock parts, see
`cprl.learners.plain`."""


class Memory(Protocol):
    """The memory of lanes: it stores every turn, and yields batches when an update is due."""

    form: TransitionForm
    """The shapes of what it stores of a turn, and of what it samples."""

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Store a turn.

        Args:
            turn: the turn of all agents of all worlds.
            lane_turn: the same turn as transitions of the lanes.
        """

    def due(self, networks: Any) -> Iterator[Draw]:
        """Yield the batches that are to be learned from after the latest turn; none if no update is due."""
        ...

    def example(self, lanes: int) -> TensorDict:
        """Return a synthetic batch of a number of lanes, in the shapes of the batches that `due` yields."""
        ...

    def values(self, networks: Any, turn: Turn) -> Tensor:
        """Estimate the value of the state after a turn, [L, W, ..]."""
        ...

    def cut(self, networks: Any) -> None:
        """End the running episodes: the next turn that is stored does not follow the latest one."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class Learner:
    """The learner of S agents of each of R replicas, by one algorithm.

    Each lane has its own network, targets, optimiser state, memory and random numbers, and learns exactly as
    it would alone. The training loop calls `begin` once, `store` after each turn, `update` after every
    `update_every` turns, and `end_episode` where episodes have ended.

    Args:
        algorithm: a `cprl.algorithms.Algorithm`, which makes the networks, the memory and the loss.
        lanes: the agents that learn.
        engine: how they are updated.
    """

    def __init__(self, algorithm: Any, lanes: Lanes, engine: TrainingEngine = "compiled") -> None:
        self.algorithm = algorithm
        self.lanes = lanes
        self.settings = algorithm.settings
        self.agents = lanes.agents
        self.replicas = lanes.replicas
        self.worlds = lanes.worlds
        self.rewards = RewardModel(lanes.reward)
        self.steps = 0
        self._episodes = torch.zeros(lanes.replicas, dtype=torch.int64)
        networks = new_networks(algorithm, lanes, Purpose.WEIGHTS)
        self._acting_template: Any = deepcopy(acting_network(networks[0]))
        """An acting network of a lane, for its architecture; its weights are not those of the lane."""
        self.memory = algorithm.make_memory(lanes, networks[0], engine)
        targets = None
        if getattr(self.settings, "own_target_weights", False):
            targets = new_networks(algorithm, lanes, Purpose.TARGET_WEIGHTS)
        self.lane_networks: LaneNetworks = algorithm.make_lane_networks(
            networks, targets, lanes, self.memory, engine
        )
        compiles = engine == "compiled" and self.lane_networks.update != "list"
        # Members of a LOLA team play some rollouts with the weights that they expect after the next update.
        outputs = getattr(self.lane_networks, "playing", self.lane_networks.outputs)
        self.actor = self._actor(outputs, Purpose.EXPLORATION, lanes.worlds, compile=compiles)
        self._follow_schedules()

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def begin(self) -> None:
        """Prepare for a training: its first turn does not follow the last turn of an earlier training."""
        self.memory.cut(self.lane_networks)

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Store one turn of every world, a TensorDict [B]."""
        turn = Turn.of(batch)
        rewards = turn.next_agents["reward"][..., 0]
        shaped = self.rewards.add(rewards, turn.next_world[keys.DONE][..., 0])
        self.memory.write(turn, self.lanes.turn(turn, shaped, self.memory.form))
        self.steps += self.worlds
        self._follow_schedules()

    def update(self) -> Tensor | None:
        """Learn from all batches that are due; return the mean loss of each agent, [R, S], or None if no
        batch is due."""
        networks = self.lane_networks
        losses = [networks.learn(draw) for draw in self.memory.due(networks)]
        if not losses:
            return None
        mean = torch.stack(losses).mean(0) if len(losses) > 1 else losses[0]
        return self.lanes.by_agent(mean)

    def end_episode(self, ended: Tensor) -> None:
        """Count the episodes that have ended in the marked worlds, bool [B].

        Copy the weights of a replica to its targets every `target_every_episodes` episodes, unless the
        settings say `tau` or `target_every_updates`: then the updates themselves change targets.
        """
        episodes_before = self._episodes
        self._episodes = episodes_before + ended.view(self.replicas, self.worlds).sum(1)
        settings = self.settings
        period = getattr(settings, "target_every_episodes", None)
        if period is None or settings.tau is not None or settings.target_every_updates is not None:
            return
        is_due = self._episodes // period > episodes_before // period
        if is_due.any():
            self.lane_networks.copy_to_targets(self.lanes.by_network(is_due))

    @torch.no_grad()
    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Estimate the value of the state after a turn for each agent, [B, S]: the highest action value, or
        the critic's value; NaN if the agent has neither."""
        return self.lanes.by_world(self.memory.values(self.lane_networks, Turn.of(batch)))

    def finite(self) -> Tensor:
        """Return for each agent whether its weights, targets and optimiser state are finite, bool [R, S]."""
        return self.lanes.by_agent(self.lane_networks.finite())

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """Return an actor with the current weights and the exploration of evaluation."""
        actor = self._actor(self.lane_networks.outputs, Purpose.EVALUATION, worlds, compile=False)
        actor.epsilon = getattr(self.settings, "epsilon_evaluation", 0.0)
        return actor

    def _follow_schedules(self) -> None:
        """Set epsilon, the learning rate and the entropy's weight to their values at the current step."""
        schedule = getattr(self.settings, "epsilon", None)
        epsilon = 0.0 if schedule is None else schedule(self.steps)  # stochastic policies have no epsilon
        self.actor.explore_with(epsilon)
        if isinstance(self.settings, LearningRateDecay):
            self.lane_networks.learning_rate = self.settings.learning_rate_at(self.steps)
        if getattr(self.algorithm, "entropy_coeff_end", None) is not None:
            self.lane_networks.set_entropy_coeff(self.algorithm.entropy_coeff_at(self.steps))

    def _actor(
        self, outputs: Callable[..., Any], purpose: Purpose, worlds: int, *, compile: bool
    ) -> LaneActor:
        """Return an actor of all agents, with independent random numbers for each agent and purpose.

        Args:
            outputs: computes the acting networks' outputs of lanes.
            worlds: the number of worlds in which each replica plays.
        """
        lanes = self.lanes
        if lanes.are_teams:
            outputs = outputs_by_agent(outputs, len(lanes.agents))
        return LaneActor(
            outputs,
            lanes.spaces.actions,
            seeds=lanes.agent_seeds(purpose),
            agents=len(lanes.agents),
            worlds=worlds,
            stochastic=self.algorithm.stochastic,
            state_cells=self.memory.form.state_cells,
            compile=compile,
        )

    def networks(self) -> dict[str, nn.Module]:
        """Return copies of the agents' acting networks, by name: "replica_0/agent_0" and so on."""
        networks = {}
        for name, weights in self._weights().items():
            networks[name] = acting_network(self.algorithm.make_network(self.lanes.spaces))
            networks[name].load_state_dict(weights)
        return networks

    def _weights(self) -> dict[str, dict[str, Tensor]]:
        """Return the state dict of each agent's acting network, by the agent's name."""
        weights = {}
        for index, name in enumerate(self.lanes.names):
            if self.lanes.are_teams:
                replica, member = divmod(index, len(self.agents))
                team_weights = self.lane_networks.network_state(replica)
                weights[name] = self._acting_template.member_state(team_weights, member)
            else:
                weights[name] = self.lane_networks.network_state(index // self.lanes.sharing)
        return weights

    def state_dict(self) -> dict[str, Any]:
        """Return the full state of all lanes.

        "networks" repeats the weights of "lane_networks", in the form in which `cprl.load` reads them.
        """
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
        """Continue from a state that `state_dict` returned."""
        self.lane_networks.load_state_dict(state["lane_networks"])
        self.memory.load_state_dict(state["memory"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.rewards.load_state_dict(state["rewards"])
        self.steps = int(state["steps"])
        self._episodes = state["episodes"].clone()
        self._follow_schedules()


def new_networks(algorithm: Any, lanes: Lanes, purpose: Purpose) -> list[nn.Module]:
    """Return new networks, one for each lane, or for all agents of a replica that share parameters.

    Acting networks get the weights that `lanes.start_from` says.

    Args:
        purpose: `Purpose.WEIGHTS`, or `Purpose.TARGET_WEIGHTS` for targets that start with other weights.

    Raises:
        ValueError: if agents that share a network would start from different weights.
    """
    sharing = len(lanes.agents) if lanes.share_parameters else 1
    seeds = lanes.agent_seeds(purpose)[::sharing]
    networks = [init_network(lambda: algorithm.make_network(lanes.spaces), seed) for seed in seeds]
    starts = [lanes.start_from.get(name, {}) for name in lanes.names]
    for index, network in enumerate(networks):
        start, *other_starts = starts[index * sharing : (index + 1) * sharing]
        if any(not _are_equal(start, other) for other in other_starts):
            raise ValueError(
                f"the agents {list(lanes.agents)} would start from different weights; allowed for agents "
                "that share parameters: a run in which they shared them too"
            )
        if start:
            acting_network(network).load_state_dict(start)
    if lanes.are_teams:
        networks = _make_teams(algorithm, lanes, networks, _TEAM_PURPOSES[purpose])
    return [network.to(lanes.device) for network in networks]


def _make_teams(
    algorithm: Any, lanes: Lanes, networks: Sequence[nn.Module], purpose: Purpose
) -> list[nn.Module]:
    """Return the networks of each replica's team.

    Args:
        networks: of all members, replica by replica; one for each replica if members share it.
        purpose: the purpose of the random numbers of the networks that a team adds.
    """
    teams = []
    networks_per_team = len(networks) // lanes.replicas  # 1 if members share a network, else S
    members_per_network = len(lanes.agents) // networks_per_team
    for replica, seed in enumerate(lanes.seeds(purpose)):
        team_networks = networks[replica * networks_per_team : (replica + 1) * networks_per_team]
        members = [network for network in team_networks for _ in range(members_per_network)]
        teams.append(init_network(partial(algorithm.make_team, members, lanes.spaces), seed))
    return teams


def _are_equal(weights: Mapping[str, Tensor], other_weights: Mapping[str, Tensor]) -> bool:
    return weights.keys() == other_weights.keys() and all(
        torch.equal(weight, other_weights[name]) for name, weight in weights.items()
    )


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """Return a network whose initial weights depend on a seed alone.

    Torch's global generator is the same afterwards as before.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_of(seed))
        return make_network()
