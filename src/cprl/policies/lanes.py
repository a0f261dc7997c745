"""Lanes: the agents at some seats of every replica, acting at once. A lane is one agent of one replica."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons.game import Game
from cprl.compiling import Compiled
from cprl.policies.rng import LaneRng


class LaneActor(TensorDictModuleBase):
    """Chooses for the agents at some seats of every replica: greedily, or with chance `epsilon` at random.

    It explores under `ExplorationType.RANDOM` alone, by random numbers of each lane's own.

    Args:
        values: the value of each action, from observations [L, k, C, X, Y] to [L, k, A], lane = replica x
            seats + seat; None for agents that choose at random always.
        stochastic: whether what `values` gives are the logits of a policy, from which agents that explore
            draw their actions; `epsilon` is then none.
        actions: how many actions A there are.
        seeds: of each lane's exploration.
        agents: how many seats S of a replica it takes.
        worlds: how many worlds k of each replica are played at once, side by side in the batch.
        compile: whether exploring is compiled by torch; where that fails a warning says so once.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(
        self,
        values: Callable[[Tensor], Tensor] | None,
        actions: int,
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        stochastic: bool = False,
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.values, self.actions, self.stochastic = values, actions, stochastic
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        # As a compiled function takes it: as a tensor, since other numbers are taken for constant.
        self._chance = 0.0 if stochastic else 1.0
        self._epsilon = torch.tensor(self._chance, dtype=torch.float64)
        self.rng = LaneRng(seeds, 2 * worlds)
        self._explore = Compiled(LaneActor._explored, what="agents act", enabled=compile)

    @property
    def epsilon(self) -> float:
        """The chance of a random action."""
        return self._chance

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.explore_with(chance)

    def explore_with(self, chance: float) -> None:
        """Sets `epsilon`, of agents that have one; quicker than through a module's attributes."""
        if chance != self._chance and not self.stochastic:
            self._epsilon.fill_(chance)
            object.__setattr__(self, "_chance", chance)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [replicas x k, S], for "observation" [replicas x k, S, C, X, Y]."""
        return tensordict.set("action", self.choose(tensordict.get("observation")))

    def choose(self, observation: Tensor) -> Tensor:
        """Actions, int64 [replicas x k, S], for what is seen, [replicas x k, S, C, X, Y]."""
        if self.values is None:
            return self._by_replica(self._random(self.rng.next().to(observation.device)))
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return self._by_replica(self._best(observation))
        device = observation.device
        arguments = observation, self.rng.next().to(device), self._epsilon.to(device)
        chosen: Tensor = self._explore((observation.shape, observation.dtype), self, *arguments)
        return chosen

    def _explored(self, observation: Tensor, numbers: Tensor, epsilon: Tensor) -> Tensor:
        """Sampled actions; or the greedy ones, with chance epsilon random ones; int64 [replicas x k, S]."""
        if self.stochastic:
            return self._by_replica(self._sampled(observation, numbers))
        explores = numbers.view(-1, self.worlds, 2)[..., 0] < epsilon
        return self._by_replica(torch.where(explores, self._random(numbers), self._best(observation)))

    def _random(self, numbers: Tensor) -> Tensor:
        """Random actions of each lane, int64 [L, k]."""
        return (numbers.view(-1, self.worlds, 2)[..., 1] * self.actions).long()

    def _by_replica(self, actions: Tensor) -> Tensor:
        """From [L, k] to [replicas x k, S]."""
        chosen = actions.view(self.replicas, self.agents, self.worlds).transpose(1, 2)
        return chosen.reshape(-1, self.agents)

    def get_extra_state(self) -> dict[str, Any]:
        """Where its random numbers stand; part of `state_dict`."""
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `get_extra_state`."""
        self.rng.load_state_dict(state)

    def _best(self, observation: Tensor) -> Tensor:
        """The greedy actions of each lane, int64 [L, k]."""
        return self._values(observation).argmax(-1)

    def _sampled(self, observation: Tensor, numbers: Tensor) -> Tensor:
        """Actions of each lane drawn from its policy, int64 [L, k]: the first beyond whose share of the
        policy's whole a number in 0..1 does not lie."""
        shares = self._values(observation).double().softmax(-1).cumsum(-1)
        drawn = numbers.view(-1, self.worlds, 2)[..., 1:]
        return (drawn >= shares[..., :-1]).sum(-1)

    def _values(self, observation: Tensor) -> Tensor:
        """What each lane's network gives, [L, k, A]."""
        assert self.values is not None
        shape = observation.shape[-3:]
        by_lane = observation.view(self.replicas, self.worlds, self.agents, *shape).transpose(1, 2)
        with torch.no_grad():
            return self.values(by_lane.reshape(-1, self.worlds, *shape))


def random_agents(
    game: Game, agents: tuple[int, ...], *, replicas: int, seed: int, worlds: int = 1
) -> dict[int | tuple[int, ...], nn.Module]:
    """Agents at some seats of every replica to whom every action is equally likely, by where they sit."""
    seeds = [(seed, replica, agent) for replica in range(replicas) for agent in agents]
    return {agents: random_lanes(len(game.actions), seeds=seeds, agents=len(agents), worlds=worlds)}


def random_lanes(actions: int, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int = 1) -> LaneActor:
    """Agents to whom every action is equally likely; see `LaneActor`."""
    return LaneActor(None, actions, seeds=seeds, agents=agents, worlds=worlds)
