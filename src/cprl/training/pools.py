"""PoolActor: an agent that is played by another opponent in each episode."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.keys import recurrent_state
from cprl.policies.joint_policy import ActorAgents, JointPolicy
from cprl.policies.rng import LaneRng, lane_name
from cprl.population import OwnPast
from cprl.system.compat.tensordicts import unchecked_tensordict


class PoolActor(nn.Module):
    """Plays one agent of every replica by opponents, one of which each world draws for each episode.

    In each turn all opponents choose, by random numbers of their own, and the action of the drawn one counts.
    The agent's recurrent state is the index of the drawn one plus 1, thus 0 when an episode begins, and then
    the states of all opponents.

    Args:
        pools: the pool of each replica with its opponents, a `cprl.training.stored.StoredAgent`.
        make_actors: returns the actors of opponents, see `cprl.training.stored.stored_actors`.
        seeds: the seed of each replica, see `lane_seeds`; opponents have continuations of it.
        worlds: the worlds k of each replica.
        present: returns copies of the agent of an `OwnPast` as it is now, a `StoredAgent` of each replica;
            None for pools that get no new past selves.
    """

    def __init__(
        self,
        pools: Sequence[Any],
        make_actors: Callable[..., dict[ActorAgents, nn.Module]],
        *,
        seeds: Sequence[Sequence[int]],
        worlds: int,
        present: Callable[[OwnPast], Sequence[Any]] | None = None,
    ) -> None:
        super().__init__()
        self.rng = LaneRng(seeds, worlds)
        self._pools = pools
        self._make_actors = make_actors
        self._seeds = seeds
        self._worlds = worlds
        self._spec: Any = pools[0].spec
        self._present: Any = present
        self._all: list[Sequence[Any]] = list(zip(*[pool.pool for pool in pools], strict=True))
        """The opponents, oldest first, each as an agent of each replica."""
        self._first_past = len(self._all)
        self._held = 0
        if present is not None and self._spec.own_past is not None:
            # One more than can be drawn, so that the last one to leave ends its episodes.
            self._held = self._spec.own_past.kept + 1
            self._all += [present(self._spec.own_past) for _ in range(self._held)]
        self._copies = min(self._held, 1)
        """The past selves so far; number n has the index `_first_past` + n % `_held`."""
        self._steps = 0
        self.policy = self._make_policy()
        self.state_cells = 1 + len(self._all) * self.policy.state_cells
        actors: Any = self.policy.actors
        read = {name for actor in actors for name in actor.in_keys}
        self.in_keys = (*read - {recurrent_state.AFTER}, recurrent_state.AFTER)

    def _make_policy(self) -> JointPolicy:
        """Return the policy that plays all opponents as the agents of one game."""

        def seeds(agents: Sequence[int]) -> list[tuple[int, ...]]:
            return [(*seed, self._copies, opponent + 1) for seed in self._seeds for opponent in agents]

        return JointPolicy(self._make_actors(dict(enumerate(self._all)), seeds=seeds))

    def _newest(self, count: int) -> dict[int, int]:
        """Return the indices of the newest past selves by their numbers, oldest first."""
        numbers = range(max(0, self._copies - count), self._copies)
        return {number: self._first_past + number % self._held for number in numbers}

    @property
    def _drawable(self) -> list[int]:
        return [*range(self._first_past), *self._newest(self._held - 1).values()]

    def as_stored(self) -> list[Any]:
        """Return the pool of each replica with the opponents that it has now."""
        opponents = zip(*[self._all[index] for index in self._drawable], strict=True)
        return [replace(pool, pool=now) for pool, now in zip(self._pools, opponents, strict=True)]

    def networks(self) -> dict[str, nn.Module]:
        """Return the networks of past selves, oldest first, by "replica_0/agent_1/past_0" and so on."""
        return {
            f"{lane_name(*seed[1:3])}/past_{number}": past_self.network
            for number, index in self._newest(self._held).items()
            for seed, past_self in zip(self._seeds, self._all[index], strict=True)
        }

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        left = self._copy_if_due()
        batch_size = tensordict.batch_size
        entries = {name: tensordict.get(name) for name in self.in_keys}
        states = entries.pop(recurrent_state.AFTER)[:, 0]
        index = self._draw_if_due(states[:, 0].long() - 1, left)[:, None]
        size = *batch_size, len(self._all)
        seen = {name: entry.expand(*size, *entry.shape[2:]) for name, entry in entries.items()}
        seen[recurrent_state.AFTER] = states[:, 1:].reshape(*size, self.policy.state_cells)
        agents = unchecked_tensordict(seen, batch_size)
        self.policy(unchecked_tensordict({"agents": agents}, batch_size))
        states_after = torch.cat([index + 1.0, agents.get(recurrent_state.AFTER).flatten(1)], 1)
        tensordict.set("action", agents.get("action").gather(1, index))
        return tensordict.set(recurrent_state.AFTER, states_after[:, None])

    def _draw_if_due(self, index: Tensor, left: int) -> Tensor:
        """Return the index of each world's opponent, int64 [B], drawn anew where it is -1 or has left."""
        drawable = torch.tensor(self._drawable, device=index.device)
        position = (self.rng.next().flatten() * len(drawable)).long().to(index.device)
        drawn = drawable[position] if self._spec.draw == "uniform" else drawable[-1]
        return torch.where((index < 0) | (index == left), drawn, index)

    def _copy_if_due(self) -> int:
        """Copy the agent as it is now; return the index of what left for it, -1 for nothing."""
        left = -1
        if self._held and self._steps >= self._copies * self._spec.own_past.every_steps:
            left = self._first_past + self._copies % self._held
            self._all[left] = self._present(self._spec.own_past)
            self._copies += 1
            self.policy = self._make_policy()
        self._steps += self._worlds
        return left

    def get_extra_state(self) -> dict[str, Any]:
        networks = {name: network.state_dict() for name, network in self.networks().items()}
        counts = {"steps": self._steps, "copies": self._copies}
        return {"rng": self.rng.state_dict(), **counts, "networks": networks}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self.rng.load_state_dict(state["rng"])
        self._steps = state["steps"]
        self._copies = state["copies"]
        for name, network in self.networks().items():
            network.load_state_dict(state["networks"][name])
        self.policy = self._make_policy()
