"""Actors of lanes: some agents of every replica act at once. A lane is one agent of one replica."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl import recurrent_state
from cprl.commons.spaces import Spaces
from cprl.policies.rng import LaneRng, Purpose, lane_seeds
from cprl.system.compiling import Compiled


class ActorOfLanes(TensorDictModuleBase):
    """What actors of S agents of every replica share: `count` random numbers a step of each lane's own.

    Args:
        seeds: of each lane, lane = replica x S + agent.
        agents: the number of agents S of each replica.
        worlds: the number of worlds k of each replica that are played at once, consecutive in the batch.
        count: of each world.
    """

    in_keys: tuple[str, ...] = ("observation",)
    out_keys: tuple[str, ...] = ("action",)

    def __init__(self, seeds: Sequence[Sequence[int]], agents: int, worlds: int, count: int) -> None:
        super().__init__()
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        self.rng = LaneRng(seeds, count * worlds)

    def get_extra_state(self) -> dict[str, Any]:
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.rng.load_state_dict(state)


class LaneActor(ActorOfLanes):
    """Chooses epsilon-greedy, stochastic or uniformly random actions for S agents of every replica.

    It explores only under `ExplorationType.RANDOM`; each lane has its own random numbers.

    Args:
        values: maps observations [L, k, C, X, Y] to action values [L, k, A], with lane = replica x S + agent;
            None for agents that always act at random. Recurrent networks also read states [L, k, H], and give
            those afterwards.
        stochastic: whether `values` returns the logits of a policy from which exploring agents sample, with
            no epsilon; else exploring agents are epsilon-greedy.
        state_cells: the numbers H of a recurrent state; 0 for networks without one.
        compile: whether torch compiles exploration; if that fails, the actor warns once and runs uncompiled.

    Reads "observation" [R x k, S, C, X, Y], writes "action" int64 [R x k, S]; with a state also reads and
    writes "recurrent_state", float32 [R x k, S, H].
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
        self.values, self.stochastic, self.actions = values, stochastic, actions
        self.state_cells = 0 if values is None else state_cells
        states = (recurrent_state.AFTER,) if self.state_cells else ()
        self.in_keys, self.out_keys = ("observation", *states), ("action", *states)
        # A tensor, because compiled code treats other numbers as constants.
        self._chance = 0.0 if stochastic else 1.0
        self._epsilon = torch.tensor(self._chance, dtype=torch.float64)
        # Of named arguments, since compiled code that is shared asks for those of a call by their names.
        explored = LaneActor._explored_with if self.state_cells else LaneActor._explored
        self._explore = Compiled(explored, what="agents act", enabled=compile)

    @property
    def epsilon(self) -> float:
        """The probability of a random action, 0..1."""
        return self._chance

    @epsilon.setter
    def epsilon(self, chance: float) -> None:
        self.explore_with(chance)

    def explore_with(self, chance: float) -> None:
        """Set `epsilon` of agents that have one; faster than through attributes of a module."""
        if chance != self._chance and not self.stochastic:
            self._epsilon.fill_(chance)
            object.__setattr__(self, "_chance", float(chance))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        chosen = self.choose_with(*(tensordict.get(name) for name in self.in_keys))
        for name, value in zip(self.out_keys, chosen, strict=True):
            tensordict.set(name, value)
        return tensordict

    def choose(self, observation: Tensor) -> Tensor:
        """Return actions, int64 [R x k, S], for observations [R x k, S, C, X, Y]; without a state."""
        return self.choose_with(observation)[0]

    def choose_with(self, *seen: Tensor) -> list[Tensor]:
        """Return actions, int64 [R x k, S], and of recurrent networks the states afterwards.

        Args:
            seen: observations [R x k, S, C, X, Y], and, if there are any, states before this turn
                [R x k, S, H].
        """
        device = seen[0].device
        if self.values is None:
            return [self._by_replica(self._random(self._numbers(device)))]
        if exploration_type() not in (ExplorationType.RANDOM, None):
            values, *after = self._outputs(*seen)
            return [self._by_replica(values.argmax(-1)), *after]
        form = tuple((entry.shape, entry.dtype) for entry in seen)
        numbers = self._numbers(device)
        chosen: list[Tensor] = self._explore(form, self, numbers, self._epsilon.to(device), *seen)
        return chosen

    def _explored(self, numbers: Tensor, epsilon: Tensor, observation: Tensor) -> list[Tensor]:
        return self._chosen(numbers, epsilon, *self._outputs(observation))

    def _explored_with(
        self, numbers: Tensor, epsilon: Tensor, observation: Tensor, state: Tensor
    ) -> list[Tensor]:
        return self._chosen(numbers, epsilon, *self._outputs(observation, state))

    def _chosen(self, numbers: Tensor, epsilon: Tensor, values: Tensor, *after: Tensor) -> list[Tensor]:
        if self.stochastic:
            chosen = self._sampled(values, numbers)
        else:
            explores = numbers[..., 0] < epsilon
            chosen = torch.where(explores, self._random(numbers), values.argmax(-1))
        return [self._by_replica(chosen), *after]

    def action_values(self, *seen: Tensor) -> Tensor | None:
        """Return what it chooses by: the probabilities of a stochastic policy, else the action values; float
        [R x k, S, A], None for agents that act at random.

        It draws nothing, so the actions that follow stay the same. Arguments are those of `choose_with`.
        """
        if self.values is None:
            return None
        values = self._by_replica(self._outputs(*seen)[0])
        return values.softmax(-1) if self.stochastic else values

    def _outputs(self, *seen: Tensor) -> list[Tensor]:
        """The outputs of each lane's network [L, k, A], and the states afterwards [R x k, S, H]."""
        assert self.values is not None
        with torch.no_grad():
            given = self.values(*map(self._by_lane, seen))
        return [given[0], self._by_replica(given[1])] if self.state_cells else [given]

    def _sampled(self, logits: Tensor, numbers: Tensor) -> Tensor:
        """Actions sampled from each lane's policy, int64 [L, k], by inverting the cumulative distribution at
        a uniform number in 0..1."""
        shares = logits.double().softmax(-1).cumsum(-1)
        return (numbers[..., 1:] >= shares[..., :-1]).sum(-1)

    def _numbers(self, device: torch.device) -> Tensor:
        """The random numbers of a turn, float64 [L, k, 2]: whether a lane explores, and what it takes."""
        return self.rng.next().to(device).view(-1, self.worlds, 2)

    def _random(self, numbers: Tensor) -> Tensor:
        """Random actions of each lane, int64 [L, k]."""
        return (numbers[..., 1] * self.actions).long()

    def _by_replica(self, values: Tensor) -> Tensor:
        """[L, k, ...] as [R x k, S, ...]."""
        by_replica = values.view(self.replicas, self.agents, self.worlds, *values.shape[2:]).transpose(1, 2)
        return by_replica.reshape(-1, *by_replica.shape[2:])

    def _by_lane(self, seen: Tensor) -> Tensor:
        """Reshape [R x k, S, ...] to [L, k, ...]."""
        by_lane = seen.view(self.replicas, self.worlds, *seen.shape[1:]).transpose(1, 2)
        return by_lane.reshape(-1, *by_lane.shape[2:])


def random_agents(
    spaces: Spaces, agents: tuple[int, ...], *, replicas: int, seed: int, worlds: int = 1
) -> dict[int | tuple[int, ...], nn.Module]:
    """Return a uniformly random actor of some agents of every replica, by the indices of the agents."""
    seeds = lane_seeds(seed, replicas=range(replicas), agents=agents, purpose=Purpose.RANDOM_PLAY)
    return {agents: LaneActor(None, spaces.actions, seeds=seeds, agents=len(agents), worlds=worlds)}


class RandomActor(TensorDictModuleBase):
    """Chooses uniformly random actions for one agent, from "observation" [..., C, X, Y]."""

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
