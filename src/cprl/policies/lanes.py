"""Actors of lanes: some agents of every replica act at once. A lane is one agent of one replica."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl import arguments
from cprl.commons.spaces import Spaces
from cprl.policies.rng import MOST_LANES, LaneRng, check_lanes
from cprl.system.compiling import Compiled


class LaneActor(TensorDictModuleBase):
    """Chooses epsilon-greedy, stochastic or uniformly random actions for S agents of every replica.

    It explores only under `ExplorationType.RANDOM`; each lane has its own random numbers.

    Args:
        values: maps observations [L, k, C, X, Y] to action values [L, k, A], with lane = replica x S + agent;
            None for agents that always act at random.
        stochastic: whether `values` returns the logits of a policy from which exploring agents sample, with
            no epsilon; else exploring agents are epsilon-greedy.
        actions: the number of actions A.
        seeds: the exploration seed of each lane.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica that are played at once, consecutive in the batch.
        first: makes the function `values` of the first replica's lanes alone, [S, k, ...] to [S, k, A].
        compile: whether torch compiles exploration; if that fails, the actor warns once and runs uncompiled.

    Raises:
        ValueError: if a number is no integer or below 1, or there is not one seed per lane; for an `epsilon`
            outside 0..1.
    """

    in_keys: tuple[str, ...] = ("observation",)
    out_keys: tuple[str, ...] = ("action",)
    state_cells = 0
    """The numbers of a recurrent state of each agent that it reads and writes."""

    def __init__(
        self,
        values: Callable[..., Any] | None,
        actions: int,
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        stochastic: bool = False,
        first: Callable[[], Callable[..., Any]] | None = None,
        compile: bool = False,
    ) -> None:
        super().__init__()
        arguments.switch("stochastic", stochastic)
        self.values, self.stochastic = values, stochastic
        self.actions = arguments.integer("actions", actions, 1)
        self.agents, self.worlds, self.replicas = check_lanes(seeds, agents=agents, worlds=worlds)
        # A tensor, because compiled code treats other numbers as constants.
        self._chance = 0.0 if stochastic else 1.0
        self._epsilon = torch.tensor(self._chance, dtype=torch.float64)
        self._seeds, self._first = seeds, first
        self.rng = LaneRng(seeds, 2 * self.worlds)
        self._explore = Compiled(type(self)._explored, what="agents act", enabled=compile)

    @property
    def epsilon(self) -> float:
        """The probability of a random action, 0..1."""
        return self._chance

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.explore_with(chance)

    def explore_with(self, chance: float) -> None:
        """Sets `epsilon` of agents that have one; faster than through attributes of a module."""
        if type(chance) is not float:
            chance = arguments.number("epsilon", chance, low=0, high=1, allowed="0..1")
        if chance != self._chance and not self.stochastic:
            arguments.number("epsilon", chance, low=0, high=1, allowed="0..1")
            self._epsilon.fill_(chance)
            object.__setattr__(self, "_chance", chance)

    def of_first_replica(self) -> "LaneActor | None":
        """An actor of the first replica's agents alone, with the same weights and exploration, and their own
        random numbers from the start; None where `values` are not known for them alone."""
        if self._first is None:
            return None
        lanes = {"seeds": self._seeds[: self.agents], "agents": self.agents, "worlds": self.worlds}
        actor = self._alike(self._first(), **lanes)
        actor.epsilon = self.epsilon
        return actor

    def _alike(self, values: Callable[..., Any], **lanes: Any) -> "LaneActor":
        """An actor for other lanes that chooses as this one does."""
        return LaneActor(values, self.actions, stochastic=self.stochastic, **lanes)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [R x k, S], for "observation" [R x k, S, C, X, Y]."""
        return tensordict.set("action", self.choose(tensordict.get("observation")))

    def choose(self, observation: Tensor) -> Tensor:
        """Actions, int64 [R x k, S], for observations [R x k, S, C, X, Y]."""
        if self.values is None:
            return self._by_replica(self._random(self.rng.next().to(observation.device)))
        if exploration_type() not in (ExplorationType.RANDOM, None):
            return self._by_replica(self._best(observation))
        device = observation.device
        arguments = observation, self.rng.next().to(device), self._epsilon.to(device)
        chosen: Tensor = self._explore((observation.shape, observation.dtype), self, *arguments)
        return chosen

    def _explored(self, observation: Tensor, numbers: Tensor, epsilon: Tensor) -> Tensor:
        """Exploring actions, int64 [R x k, S]."""
        return self._by_replica(self._chosen(self._values(observation), numbers, epsilon))

    def _chosen(self, values: Tensor, numbers: Tensor, epsilon: Tensor) -> Tensor:
        """Sampled actions of a stochastic policy, else epsilon-greedy actions; int64 [L, k]."""
        if self.stochastic:
            return self._sampled(values, numbers)
        explores = numbers.view(-1, self.worlds, 2)[..., 0] < epsilon
        return torch.where(explores, self._random(numbers), values.argmax(-1))

    def _random(self, numbers: Tensor) -> Tensor:
        """Random actions of each lane, int64 [L, k]."""
        return (numbers.view(-1, self.worlds, 2)[..., 1] * self.actions).long()

    def _by_replica(self, actions: Tensor) -> Tensor:
        """Reshapes [L, k, ...] to [R x k, S, ...]."""
        more = actions.shape[2:]
        chosen = actions.view(self.replicas, self.agents, self.worlds, *more).transpose(1, 2)
        return chosen.reshape(-1, self.agents, *more)

    def preferences(self, observation: Tensor, state: Tensor | None = None) -> Tensor | None:
        """What it chooses by: the probabilities of a stochastic policy, else the action values, for
        observations [R x k, S, C, X, Y]; float [R x k, S, A], None for agents that act at random.

        It draws nothing, so the actions that follow stay the same.
        """
        if self.values is None:
            return None
        values = self._by_replica(self._values(observation))
        return values.softmax(-1) if self.stochastic else values

    def get_extra_state(self) -> dict[str, Any]:
        """The state of its random numbers; part of `state_dict`."""
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `get_extra_state`."""
        self.rng.load_state_dict(state)

    def _best(self, observation: Tensor) -> Tensor:
        """The greedy actions of each lane, int64 [L, k]."""
        return self._values(observation).argmax(-1)

    def _sampled(self, logits: Tensor, numbers: Tensor) -> Tensor:
        """Actions sampled from each lane's policy, int64 [L, k], by inverting the cumulative distribution at
        a uniform number in 0..1."""
        shares = logits.double().softmax(-1).cumsum(-1)
        drawn = numbers.view(-1, self.worlds, 2)[..., 1:]
        return (drawn >= shares[..., :-1]).sum(-1)

    def _values(self, observation: Tensor) -> Tensor:
        """The outputs of each lane's network, [L, k, A]."""
        assert self.values is not None
        with torch.no_grad():
            values: Tensor = self.values(self._by_lane(observation))
        return values

    def _by_lane(self, seen: Tensor) -> Tensor:
        """Reshapes [R x k, S, ...] to [L, k, ...]."""
        shape = seen.shape[2:]
        by_lane = seen.view(self.replicas, self.worlds, self.agents, *shape).transpose(1, 2)
        return by_lane.reshape(-1, self.worlds, *shape)


def random_agents(
    spaces: Spaces, agents: tuple[int, ...], *, replicas: int, seed: int, worlds: int = 1
) -> dict[int | tuple[int, ...], nn.Module]:
    """Uniformly random actors of some agents of every replica, by the indices of the agents."""
    arguments.object_of("spaces", spaces, Spaces, "a cprl.commons.spaces.Spaces")
    agents = arguments.listed("agents", agents, "the indices of agents")
    replicas, seed = arguments.integer("replicas", replicas, 1, MOST_LANES), arguments.seed(seed)
    seeds = [(seed, replica, agent) for replica in range(replicas) for agent in agents]
    return {agents: random_lanes(spaces, seeds=seeds, agents=len(agents), worlds=worlds)}


def random_lanes(
    actions: int | Spaces, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int = 1
) -> LaneActor:
    """An actor of agents that act uniformly at random, given how many actions there are or the spaces."""
    count = actions.actions if isinstance(actions, Spaces) else actions
    return LaneActor(None, count, seeds=seeds, agents=agents, worlds=worlds)
