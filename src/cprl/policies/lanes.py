"""Actors of lanes: some agents of every replica act at once. A lane is one agent of one replica."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons.spaces import Spaces
from cprl.policies.rng import LaneRng
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
        compile: whether torch compiles exploration; if that fails, the actor warns once and runs uncompiled.
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
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.values, self.stochastic, self.actions = values, stochastic, actions
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        # A tensor, because compiled code treats other numbers as constants.
        self._chance = 0.0 if stochastic else 1.0
        self._epsilon = torch.tensor(self._chance, dtype=torch.float64)
        self._seeds = seeds
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
        if chance != self._chance and not self.stochastic:
            self._epsilon.fill_(chance)
            object.__setattr__(self, "_chance", float(chance))

    def of_first_replica(self) -> "LaneActor":
        """An actor of the first replica's agents alone, with the same weights and exploration, and their own
        random numbers from the start."""
        values, replicas, agents = self.values, self.replicas, self.agents

        def of_first(*seen: Tensor) -> Any:
            """What the first of all replicas chooses by, if all see the same."""
            assert values is not None
            given = values(*(each.repeat(replicas, *[1] * (each.ndim - 1)) for each in seen))
            return tuple(each[:agents] for each in given) if isinstance(given, tuple) else given[:agents]

        lanes = {"seeds": self._seeds[:agents], "agents": agents, "worlds": self.worlds}
        actor = self._alike(None if values is None else of_first, **lanes)
        actor.epsilon = self.epsilon
        return actor

    def _alike(self, values: Callable[..., Any] | None, **lanes: Any) -> "LaneActor":
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
        """Continues from that state."""
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
    seeds = [(seed, replica, agent) for replica in range(replicas) for agent in agents]
    return {agents: random_lanes(spaces, seeds=seeds, agents=len(agents), worlds=worlds)}


def random_lanes(
    actions: int | Spaces, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int = 1
) -> LaneActor:
    """An actor of agents that act uniformly at random, given how many actions there are or the spaces."""
    count = actions.actions if isinstance(actions, Spaces) else actions
    return LaneActor(None, count, seeds=seeds, agents=agents, worlds=worlds)


class RecurrentLaneActor(LaneActor):
    """Chooses actions by recurrent networks; other arguments are those of `LaneActor`.

    Args:
        values: maps observations [L, k, ...] and states [L, k, H] to logits or action values [L, k, A] and
            the states afterwards.
        actions: the number of actions A.
        state_cells: the numbers H of a state.

    Reads "observation" and "recurrent_state", float32 [R x k, S, H]; writes "action" and "recurrent_state".
    """

    in_keys = ("observation", "recurrent_state")
    out_keys = ("action", "recurrent_state")

    def __init__(self, values: Callable[..., Any], actions: int, *, state_cells: int, **how: Any) -> None:
        super().__init__(values, actions, **how)
        self.state_cells = state_cells
        is_compiled = bool(how.get("compile", False))
        self._explore = Compiled(type(self)._explored_with, what="agents act", enabled=is_compiled)

    def _alike(self, values: Callable[..., Any] | None, **lanes: Any) -> LaneActor:
        assert values is not None
        how: dict[str, Any] = {"state_cells": self.state_cells, "stochastic": self.stochastic}
        return RecurrentLaneActor(values, self.actions, **how, **lanes)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [R x k, S], and "recurrent_state", from the turn's entries."""
        chosen, after = self.choose_with(tensordict.get("observation"), tensordict.get("recurrent_state"))
        return tensordict.set("action", chosen).set("recurrent_state", after)

    def choose_with(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Actions, int64 [R x k, S], and states afterwards, float32 [R x k, S, H].

        Args:
            observation: [R x k, S, ...].
            state: before this turn, [R x k, S, H].
        """
        if exploration_type() not in (ExplorationType.RANDOM, None):
            values, after = self._step(observation, state)
            return self._by_replica(values.argmax(-1)), after
        device = observation.device
        given = observation, state, self.rng.next().to(device), self._epsilon.to(device)
        form = observation.shape, observation.dtype, state.shape
        chosen, after = self._explore(form, self, *given)
        return chosen, after

    def preferences(self, observation: Tensor, state: Tensor | None = None) -> Tensor | None:
        """As of `LaneActor`, with the states before the turn, [R x k, S, H]."""
        assert state is not None
        values = self._by_replica(self._step(observation, state)[0])
        return values.softmax(-1) if self.stochastic else values

    def _explored_with(
        self, observation: Tensor, state: Tensor, numbers: Tensor, epsilon: Tensor
    ) -> list[Tensor]:
        """Exploring actions, and the states afterwards."""
        values, after = self._step(observation, state)
        return [self._by_replica(self._chosen(values, numbers, epsilon)), after]

    def _step(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs of each lane's network [L, k, A], and the states afterwards [R x k, S, H]."""
        assert self.values is not None
        with torch.no_grad():
            values, after = self.values(self._by_lane(observation), self._by_lane(state))
        return values, self._by_replica(after)


def actor_of_lanes(
    values: Callable[..., Any] | None, spaces: Spaces, *, state_cells: int = 0, **how: Any
) -> LaneActor:
    """The actor for networks with states of so many numbers, or without: a `RecurrentLaneActor` or a
    `LaneActor`."""
    if not state_cells or values is None:
        return LaneActor(values, spaces.actions, **how)
    return RecurrentLaneActor(values, spaces.actions, state_cells=state_cells, **how)


class RandomActor(TensorDictModuleBase):
    """Chooses uniformly random actions for one agent, from "observation" [..., C, X, Y].

    Args:
        actions: the number of actions A.
        device: the device of the actions.
        seed: the seed of its own generator.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, actions: int, *, device: str | torch.device = "cpu", seed: int = 0) -> None:
        super().__init__()
        self.actions = actions
        self.generator = torch.Generator(device).manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 with the TensorDict's batch size."""
        chosen = torch.randint(
            self.actions, tensordict.batch_size, generator=self.generator, device=self.generator.device
        )
        return tensordict.set("action", chosen)
