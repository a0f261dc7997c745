"""Lanes: the agents that a learner trains in every replica, with their seeds, networks and actors."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Protocol, TypeAlias

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.arguments import object_of
from cprl.commons.spaces import Spaces
from cprl.learners.checks import check_networks
from cprl.learners.engine.shared import is_list
from cprl.learners.transitions import LaneTurn, array_of, joint_actions, lane_turn, seen_next
from cprl.networks.agent import acting_part
from cprl.networks.recurrent import state_cells_of
from cprl.networks.specification import refuse_unseen
from cprl.policies.lanes import LaneActor
from cprl.policies.recurrent import actor_of_lanes

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION, EXHIBITION, NOISE = range(7)
"""The purposes of a lane's random numbers; each has its own seed."""

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""The state dict of the acting network with which each lane starts, by the lane's name."""

_LARGEST_SEED: Final = 2**63 - 1


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """The seed of each lane, replica by replica: (seed of the run, replica, agent, purpose)."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    """The name under which a lane's networks are stored."""
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """The name of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


Outputs = Callable[..., Any]
"""The outputs of acting networks: [l, k, ...] to [l, k, ...] for l lanes; of recurrent ones also states."""


class Acts(Protocol):
    """Evaluates the current networks of many lanes; an `Engine` does."""

    def outputs(self, observation: Tensor, *, part: int = 0) -> Any:
        """The outputs of the networks: [L, k, ...] to [L, k, ...]; recurrent ones read and give states."""

    def first(self, lanes: int) -> Outputs:
        """`outputs` of the first l lanes alone, with their weights as they are at each call."""

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the current weights of one lane, as the state dict of its acting network."""


def weights_to_start(start_from: StartFrom | None) -> StartFrom:
    """The weights to start from, none as an empty table; refuses what is no table."""
    object_of("start_from", start_from, Mapping | None, "weights by the name of the lane, or None")
    return start_from or {}


class Lanes:
    """R x S agents: S agents of each of R replicas. A lane is one of them, in order of replicas.

    Args:
        spaces: the shape and dtype of observations, and the number of actions A.
        agents: the indices of the agents.
        replicas: the number of replicas R.
        seed: the seed of the run.
        first_replica: the index of the first replica.
        make_network: makes the networks of one agent. It draws weights from torch's generator, which is
            seeded for each lane.
        stochastic: whether the network outputs the logits of a policy from which actions are sampled.
        start_from: the weights with which the acting networks of lanes start, see `StartFrom`.
        share_parameters: whether the agents of a replica share one network, initialised as that of the first.
        sees_peers: whether a lane's stored action is that of all N agents, see `transitions.joint_actions`.

    Raises:
        ValueError: if agents observe entries that networks do not read.
    """

    def __init__(
        self,
        spaces: Spaces,
        *,
        agents: Sequence[int],
        replicas: int,
        seed: int,
        first_replica: int,
        make_network: Callable[[], nn.Module],
        stochastic: bool,
        start_from: StartFrom | None = None,
        share_parameters: bool = False,
        sees_peers: bool = False,
    ) -> None:
        refuse_unseen(spaces)
        self.spaces, self.agents, self.replicas, self.seed = spaces, tuple(agents), replicas, seed
        self._numbers = range(first_replica, first_replica + replicas)
        self.make_network, self.stochastic = make_network, stochastic
        self._start_from, self.sees_peers = weights_to_start(start_from), sees_peers
        self.sharing = len(self.agents) if share_parameters else 1
        """The number of agents that share a network."""
        self.state_cells = 0
        """The numbers H of the state of an acting network; known once there are networks, 0 for those without
        a state."""

    def __len__(self) -> int:
        return self.replicas * len(self.agents)

    @property
    def names(self) -> list[str]:
        """See `lane_names`."""
        return lane_names(replicas=self._numbers, agents=self.agents)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The shape of a lane's observation: (C, X, Y)."""
        return self.spaces.observation_shape

    @property
    def action_shape(self) -> tuple[int, ...]:
        """The shape of a lane's stored action: (), or (N,) if it sees those of peers."""
        return (self.spaces.agents,) if self.sees_peers else ()

    @property
    def member_shape(self) -> tuple[int, ...]:
        """The axes of the members of a lane: none, since it is one agent."""
        return ()

    @property
    def reward_shape(self) -> tuple[int, ...]:
        """The shape of a lane's reward in a replay buffer."""
        return ()

    @property
    def of_replica(self) -> int:
        """The number of lanes of a replica."""
        return len(self.agents)

    def turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every lane, as a replay buffer stores it; see `lane_turn`."""
        turn = lane_turn(self.agents, batch, rewards)
        if self.sees_peers:
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
        """The observations of lanes after a turn, uint8 [L, 1, C, X, Y]."""
        return seen_next(batch)[:, list(self.agents)].flatten(0, 1).unsqueeze(1)

    def recurrent_state(
        self, batch: TensorDictBase, entry: tuple[str, str] = keys.RECURRENT_STATE_BEFORE
    ) -> Tensor:
        """The states that lanes had before a turn, or by another entry after it, float32 [L, H]."""
        states: Tensor = batch.get(entry)
        return states[:, list(self.agents), : self.state_cells].flatten(0, 1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """Values of lanes, [L], as values of the agents of each replica, [R, S]."""
        return losses.view(self.replicas, len(self.agents))

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """See `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)

    def new_networks(self, purpose: int, device: str | torch.device) -> list[nn.Module]:
        """New networks for each lane, or for each replica whose agents share one; the acting ones with the
        weights to start from, if there are any.

        Raises:
            TooLargeError: if the device has less memory than training all of them takes.
            ValueError: if agents that share a network would start from different weights.
        """
        first, *others = self.seeds(purpose)[:: self.sharing]
        networks = [init_network(self.make_network, first)]
        check_networks(networks[0], 1 + len(others), device)
        self.state_cells = state_cells_of(acting_part(networks[0]))
        networks += [init_network(self.make_network, own) for own in others]
        for place, network in enumerate(networks):
            start, *same = (
                self._start_from.get(name, {})
                for name in self.names[place * self.sharing : (place + 1) * self.sharing]
            )
            if any(not _equal(start, own) for own in same):
                raise ValueError(
                    f"the agents {list(self.agents)} would start from different weights; allowed for agents "
                    "that share parameters: a run in which they shared them too"
                )
            if start:
                acting_part(network).load_state_dict(start)
        return [network.to(device) for network in networks]

    def actor(self, engine: Acts, *, compile: bool) -> LaneActor:
        """The actor of training: the current weights, and random numbers of its own for each lane."""
        return actor_of_lanes(
            engine.outputs,
            self.spaces,
            seeds=self.seeds(EXPLORATION),
            agents=len(self.agents),
            stochastic=self.stochastic,
            state_cells=self.state_cells,
            compile=compile and not is_list(engine),
        )

    def evaluation_actor(self, engine: Acts, worlds: int, *, epsilon: float) -> LaneActor:
        """The actor of evaluation: the current weights, for `worlds` worlds of each replica."""
        actor = actor_of_lanes(
            engine.outputs,
            self.spaces,
            seeds=self.seeds(EVALUATION),
            agents=len(self.agents),
            worlds=worlds,
            stochastic=self.stochastic,
            state_cells=self.state_cells,
            first=partial(engine.first, len(self.agents)),
        )
        actor.epsilon = epsilon
        return actor

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each lane's acting network, by the lane's name."""
        return {name: engine.network_state(lane) for lane, name in enumerate(self.names)}

    def networks(self, engine: Acts) -> dict[str, nn.Module]:
        """A copy of each lane's current acting network, by the lane's name."""
        made = {}
        for name, weights in self.states(engine).items():
            made[name] = acting_part(self.make_network())
            made[name].load_state_dict(weights)
        return made


def _equal(weights: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    return weights.keys() == others.keys() and all(
        torch.equal(value, others[name]) for name, value in weights.items()
    )


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose initial weights depend on a seed alone; torch's generator is left unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED))
        return make_network()
