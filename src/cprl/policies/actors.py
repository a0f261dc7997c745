"""Actors: modules that choose the actions of some agents, in all replicas at once.

A lane is one agent of one replica. Each lane acts by its own weights and its own random numbers.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.keys import recurrent_state
from cprl.policies.rng import LaneRng
from cprl.system.compiling import Compiled


class ActorOfLanes(TensorDictModuleBase):
    """The base of actors of S agents of every replica, with independent random numbers for each lane.

    Args:
        seeds: the seed of each lane, lane = replica x S + agent.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica that are played at once, consecutive in the batch.
        count: the random numbers that a lane needs in each step of each world.
    """

    in_keys: tuple[str, ...] = ("observation",)
    out_keys: tuple[str, ...] = ("action",)

    def __init__(self, seeds: Sequence[Sequence[int]], agents: int, worlds: int, count: int) -> None:
        super().__init__()
        self.agents = agents
        self.worlds = worlds
        self.replicas = len(seeds) // agents
        self.rng = LaneRng(seeds, count * worlds)

    def get_extra_state(self) -> dict[str, Any]:
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.rng.load_state_dict(state)


class LaneActor(ActorOfLanes):
    """Chooses epsilon-greedy, stochastic or uniformly random actions for S agents of every replica.

    Agents explore only under `ExplorationType.RANDOM`; else they take the action with the highest value.

    Args:
        values: maps observations [L, k, C, X, Y] of lanes to action values or logits [L, k, A], with
            lane = replica x S + agent. Recurrent networks also read and return states [L, k, H]. None for
            agents that always act at random.
        actions: the number of actions A.
        seeds: the seed of each lane.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica that are played at once, consecutive in the batch.
        stochastic: true if `values` returns the logits of a policy: then exploring agents sample from it,
            and there is no epsilon. Else exploring agents are epsilon-greedy.
        state_cells: the numbers H in a recurrent state; 0 for networks without one.
        compile: whether torch compiles exploration; if that fails, the actor warns once and runs uncompiled.

    Reads "observation" [R x k, S, C, X, Y], writes "action" int64 [R x k, S]; recurrent actors also read and
    write "recurrent_state", float32 [R x k, S, H].
    """

    def __init__(
        self,
        values: Callable[..., Any] | None,
        actions: int,
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        stochastic: bool = False,
        state_cells: int = 0,
        compile: bool = False,
    ) -> None:
        super().__init__(seeds, agents, worlds, 2)
        self.values = values
        self.stochastic = stochastic
        self.actions = actions
        self.state_cells = 0 if values is None else state_cells
        states = (recurrent_state.AFTER,) if self.state_cells else ()
        self.in_keys = ("observation", *states)
        self.out_keys = ("action", *states)
        # A tensor, because compiled code treats other numbers as constants.
        self._epsilon = torch.tensor(0.0 if stochastic else 1.0, dtype=torch.float64)
        # Two functions instead of one with *inputs: compiled code that is shared needs named arguments.
        explore = LaneActor._explore_recurrent if self.state_cells else LaneActor._explore
        self._compiled_explore = Compiled(explore, what="agents act", enabled=compile)

    @property
    def epsilon(self) -> float:
        """Return the probability of a random action, 0..1."""
        return float(self._epsilon)

    @epsilon.setter
    def epsilon(self, epsilon: float) -> None:
        self.explore_with(epsilon)

    def explore_with(self, epsilon: float) -> None:
        """Set `epsilon` if agents have one; faster than setting an attribute of a module."""
        if not self.stochastic:
            self._epsilon.fill_(epsilon)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        chosen = self.choose_with(*(tensordict.get(name) for name in self.in_keys))
        for name, value in zip(self.out_keys, chosen, strict=True):
            tensordict.set(name, value)
        return tensordict

    def choose(self, observation: Tensor) -> Tensor:
        """Return actions, int64 [R x k, S], for observations [R x k, S, C, X, Y]; for actors without a
        state."""
        return self.choose_with(observation)[0]

    def choose_with(self, *inputs: Tensor) -> list[Tensor]:
        """Return actions, int64 [R x k, S], and, from recurrent networks, the states after this turn.

        Args:
            inputs: observations [R x k, S, C, X, Y]; for recurrent networks also the states before this turn,
                [R x k, S, H].
        """
        device = inputs[0].device
        if self.values is None:
            return [self._by_replica(self._random_actions(self._draw_numbers(device)))]
        if exploration_type() not in (ExplorationType.RANDOM, None):
            values, *states_after = self._outputs(*inputs)
            return [self._by_replica(values.argmax(-1)), *states_after]
        form = tuple((entry.shape, entry.dtype) for entry in inputs)
        numbers = self._draw_numbers(device)
        return self._compiled_explore(form, self, numbers, self._epsilon.to(device), *inputs)

    def _explore(self, numbers: Tensor, epsilon: Tensor, observation: Tensor) -> list[Tensor]:
        """Return exploring actions, [R x k, S]."""
        return self._select(numbers, epsilon, *self._outputs(observation))

    def _explore_recurrent(
        self, numbers: Tensor, epsilon: Tensor, observation: Tensor, state: Tensor
    ) -> list[Tensor]:
        """Return exploring actions, [R x k, S], and the states after this turn."""
        return self._select(numbers, epsilon, *self._outputs(observation, state))

    def _select(
        self, numbers: Tensor, epsilon: Tensor, values: Tensor, *states_after: Tensor
    ) -> list[Tensor]:
        """Return exploring actions by the networks' outputs, and the states as they are."""
        if self.stochastic:
            actions = self._sample(values, numbers)
        else:
            explores = numbers[..., 0] < epsilon
            actions = torch.where(explores, self._random_actions(numbers), values.argmax(-1))
        return [self._by_replica(actions), *states_after]

    def action_values(self, *inputs: Tensor) -> Tensor | None:
        """Return the numbers by which agents choose, float [R x k, S, A]: the probabilities of a stochastic
        policy, else the action values; None for agents that act at random.

        The call draws no random numbers, so it does not change the actions that follow.

        Args:
            inputs: see `choose_with`.
        """
        if self.values is None:
            return None
        values = self._by_replica(self._outputs(*inputs)[0])
        return values.softmax(-1) if self.stochastic else values

    def _outputs(self, *inputs: Tensor) -> list[Tensor]:
        """Return the outputs of the lanes' networks, [L, k, A], and the states after this turn, [R x k, S,
        H]."""
        assert self.values is not None
        with torch.no_grad():
            outputs = self.values(*map(self._by_lane, inputs))
        return [outputs[0], self._by_replica(outputs[1])] if self.state_cells else [outputs]

    def _sample(self, logits: Tensor, numbers: Tensor) -> Tensor:
        """Sample actions from each lane's policy, int64 [L, k], by inverting the cumulative distribution at a
        uniform number in 0..1."""
        cumulative = logits.double().softmax(-1).cumsum(-1)
        return (numbers[..., 1:] >= cumulative[..., :-1]).sum(-1)

    def _draw_numbers(self, device: torch.device) -> Tensor:
        """Draw two random numbers for each lane and world, float64 [L, k, 2]: the first says whether an agent
        explores, the second which action it takes then."""
        return self.rng.next().to(device).view(-1, self.worlds, 2)

    def _random_actions(self, numbers: Tensor) -> Tensor:
        """Return uniformly random actions of each lane, int64 [L, k]."""
        return (numbers[..., 1] * self.actions).long()

    def _by_replica(self, values: Tensor) -> Tensor:
        """Reshape [L, k, ...] to [R x k, S, ...]."""
        by_replica = values.view(self.replicas, self.agents, self.worlds, *values.shape[2:]).transpose(1, 2)
        return by_replica.reshape(-1, *by_replica.shape[2:])

    def _by_lane(self, values: Tensor) -> Tensor:
        """Reshape [R x k, S, ...] to [L, k, ...]."""
        by_lane = values.view(self.replicas, self.worlds, *values.shape[1:]).transpose(1, 2)
        return by_lane.reshape(-1, *by_lane.shape[2:])


class RandomActor(TensorDictModuleBase):
    """Chooses uniformly random actions for one agent, given "observation" [..., C, X, Y].

    Args:
        actions: the number of actions A.
    """

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, actions: int, *, device: str | torch.device = "cpu", seed: int = 0) -> None:
        super().__init__()
        self.actions = actions
        self.generator = torch.Generator(device).manual_seed(seed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action", int64 with the TensorDict's batch size."""
        chosen = torch.randint(
            self.actions, tensordict.batch_size, generator=self.generator, device=self.generator.device
        )
        return tensordict.set("action", chosen)
