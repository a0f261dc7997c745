"""Lanes: who learns at some seats of every replica, their seeds, networks and actors."""

from collections.abc import Callable, Sequence
from typing import Final, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.commons.game import Game
from cprl.learners.engine.base import ListEngine
from cprl.learners.transitions import LaneTurn, RewardKind, lane_turn, seen_next
from cprl.networks.agent import acting_part
from cprl.policies.lanes import LaneActor

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION = range(5)
"""What a lane's random numbers are for."""

_LARGEST_SEED: Final = 2**63 - 1


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """A seed for each lane, replica by replica, of the run's seed, the replica, the agent and the purpose."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    """Under which a lane's networks are kept."""
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """Of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


class Acts(Protocol):
    """What acts by the present weights of many lanes; an `Engine` does."""

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """What the networks give: [L, k, ...] to [L, k, ...]."""

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the present weights of one lane, as the state dict of its acting network."""


class Lanes:
    """R x S agents: seats S of each of R replicas; a lane is one of them, replica by replica.

    Args:
        game: what is played.
        agents: the numbers of the agents.
        replicas: how many replicas R.
        seed: of the run.
        first_replica: the number of the first replica.
        make_network: the networks of an agent, which draw their weights from torch's generator; that is
            seeded for each lane.
        stochastic: whether they act by drawing from the policy whose logits the network gives.
    """

    def __init__(
        self,
        game: Game,
        *,
        agents: Sequence[int],
        replicas: int,
        seed: int,
        first_replica: int,
        make_network: Callable[[], nn.Module],
        stochastic: bool,
    ) -> None:
        self.game, self.agents, self.replicas, self.seed = game, tuple(agents), replicas, seed
        self._numbers = range(first_replica, first_replica + replicas)
        self.make_network, self.stochastic = make_network, stochastic

    def __len__(self) -> int:
        return self.replicas * len(self.agents)

    @property
    def names(self) -> list[str]:
        """See `lane_names`."""
        return lane_names(replicas=self._numbers, agents=self.agents)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Of what a lane sees: (C, X, Y)."""
        return self.game.observation_shape

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Of what a lane does, and of what it is paid in a rollout."""
        return ()

    @property
    def of_replica(self) -> int:
        """Lanes of a replica."""
        return len(self.agents)

    def turn(self, batch: TensorDictBase, reward_kind: RewardKind) -> LaneTurn:
        """A turn of every lane, as replay stores it."""
        return lane_turn(self.agents, batch, reward_kind=reward_kind)

    def rollout_turn(self, batch: TensorDictBase, reward_kind: RewardKind) -> LaneTurn:
        """A turn of every lane, as a rollout keeps it."""
        return lane_turn(self.agents, batch, reward_kind=reward_kind)

    def seen_next(self, batch: TensorDictBase) -> Tensor:
        """What lanes see at the end of a turn, uint8 [L, 1, C, X, Y]."""
        return seen_next(batch)[:, list(self.agents)].flatten(0, 1).unsqueeze(1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """What was told of each lane, [L], of each agent of each replica, [R, S]."""
        return losses.view(self.replicas, len(self.agents))

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """See `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)

    def new_networks(self, purpose: int, device: str | torch.device) -> list[nn.Module]:
        """New networks for each lane."""
        return [init_network(self.make_network, own).to(device) for own in self.seeds(purpose)]

    def actor(self, engine: Acts, *, compile: bool) -> LaneActor:
        """Who acts by the present weights while they learn, each lane by random numbers of its own."""
        return LaneActor(
            engine.outputs,
            len(self.game.actions),
            seeds=self.seeds(EXPLORATION),
            agents=len(self.agents),
            stochastic=self.stochastic,
            compile=compile and not isinstance(engine, ListEngine),
        )

    def evaluation_actor(self, engine: Acts, worlds: int, *, epsilon: float) -> LaneActor:
        """Who acts by the present weights in so many worlds of each replica."""
        actor = LaneActor(
            engine.outputs,
            len(self.game.actions),
            seeds=self.seeds(EVALUATION),
            agents=len(self.agents),
            worlds=worlds,
            stochastic=self.stochastic,
        )
        actor.epsilon = epsilon
        return actor

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each lane's acting network, by the lane's name."""
        return {name: engine.network_state(lane) for lane, name in enumerate(self.names)}

    def networks(self, engine: Acts) -> dict[str, nn.Module]:
        """A copy of each lane's acting network as it is now, by the lane's name."""
        made = {}
        for name, weights in self.states(engine).items():
            made[name] = acting_part(self.make_network())
            made[name].load_state_dict(weights)
        return made


def init_network(make_network: Callable[[], nn.Module], seed: Sequence[int]) -> nn.Module:
    """A network whose weights follow from a seed alone; torch's generator goes on as if nothing happened."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] & _LARGEST_SEED))
        return make_network()
