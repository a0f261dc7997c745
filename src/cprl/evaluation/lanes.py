"""Plays stored agents in fresh worlds, with all replicas at once as lanes.

A step of all replicas takes as long as a step of one, and each lane's random numbers depend on (seed,
replica, agent) alone.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeAlias

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cprl.commons.game import Game
from cprl.learners.lanes import EVALUATION, lane_seeds
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.policies.assignment import AgentPolicies
from cprl.policies.decisions import decider_by_chance
from cprl.policies.lanes import random_lanes
from cprl.system.process import one_thread
from cprl.training.agents import LoadedRun, stored_policies

Played: TypeAlias = dict[int, list[Episode]]
"""Episodes by the index of the replica."""


def pooled(parts: Iterable[Played]) -> Played:
    together: Played = {}
    for played in parts:
        for replica, episodes in played.items():
            together.setdefault(replica, []).extend(episodes)
    return together


MakePolicies: TypeAlias = Callable[[Sequence[int]], AgentPolicies]
"""Makes the policies of all agents, given the indices of the replicas that play at once."""


class Place(Protocol):
    """A game whose fresh worlds can be played, e.g. a `LoadedRun`."""

    @property
    def game(self) -> Any: ...

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase: ...


@dataclass(frozen=True)
class Source:
    """The run from which an agent is taken in every replica: the run's agent with the same index.

    Args:
        replicas: the run's replica for each index of a replica, if they differ.
    """

    run: LoadedRun
    replicas: Mapping[int, int] | None = None

    def replica(self, number: int) -> int:
        return number if self.replicas is None else self.replicas[number]


@dataclass(frozen=True, kw_only=True)
class Fresh:
    """Fresh episodes of some replicas; replica r plays the worlds from r x episodes on."""

    replicas: tuple[int, ...]
    """Their indices, ascending."""
    episodes: int
    """Of each replica with each choice of who plays where, each in its own world."""
    seed: int
    """Of the worlds and of all random numbers."""
    greedy: bool = False
    """Whether stored agents take their best action; else they explore as in evaluation."""

    def __str__(self) -> str:
        counts = {"replica": len(self.replicas), "episode": self.episodes}
        return ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items()) + " each"

    def agents(self, sources: Sequence[Source]) -> MakePolicies:
        """Agents of stored runs: the sources of agent 0, 1 and so on."""
        return partial(policies_of, sources, worlds=self.episodes, seed=self.seed)

    def random_agents(self, run: LoadedRun) -> MakePolicies:
        return partial(random_policies, run, worlds=self.episodes, seed=self.seed)

    def play(self, where: Place, policies: MakePolicies, *, explore: bool | None = None) -> Played:
        """The episodes by replica; agents explore unless they are greedy, or as is said."""
        explore = not self.greedy if explore is None else explore
        played: Played = {}
        for group, env in self.worlds(where):
            ended = evaluate(env, policies(group), explore=explore)
            for place, replica in enumerate(group):
                played[replica] = ended[place * self.episodes : (place + 1) * self.episodes]
        return played

    def worlds(self, where: Place) -> Iterator[tuple[list[int], EnvBase]]:
        """The indices of replicas, and an environment with their worlds in the same order, with as many
        replicas as possible in one."""
        for group in _consecutive(self.replicas):
            first = group[0] * self.episodes
            yield group, where.env(len(group) * self.episodes, seed=self.seed, first_world=first)


def policies_of(
    sources: Sequence[Source], replicas: Sequence[int], *, worlds: int, seed: int
) -> AgentPolicies:
    """The policies of all agents of these replicas, from stored runs."""
    agents = [
        [source.run.agent(agent, replica=source.replica(replica)) for replica in replicas]
        for agent, source in enumerate(sources)
    ]
    run = sources[0].run
    playing = run.game if isinstance(run.game, Game) else run.spaces
    return stored_policies(agents, playing, replicas=replicas, worlds=worlds, seed=seed)


def random_policies(run: LoadedRun, replicas: Sequence[int], *, worlds: int, seed: int) -> AgentPolicies:
    """Uniformly random policies of all agents of these replicas; see `policies_of`."""
    everyone = tuple(range(run.spaces.agents))
    seeds = lane_seeds(seed, replicas=replicas, agents=everyone, purpose=EVALUATION)
    return AgentPolicies(
        {everyone: random_lanes(run.spaces, seeds=seeds, agents=len(everyone), worlds=worlds)},
        decisions=decider_by_chance(run.game, seeds, worlds=worlds) if isinstance(run.game, Game) else None,
    )


def _consecutive(numbers: Sequence[int]) -> list[list[int]]:
    """Ascending numbers in groups without gaps."""
    groups: list[list[int]] = []
    for number in numbers:
        if groups and groups[-1][-1] + 1 == number:
            groups[-1].append(number)
        else:
            groups.append([number])
    return groups


Policy = Callable[[TensorDictBase], TensorDictBase]


class Turns:
    """An episode that is played turn by turn, with the exploration of training and evaluation.

    Unlike a collector it does not reset an environment that has ended, so that the last board can be seen.

    Args:
        env: one world, batch size [1], with its transforms; it is reset.
        policy: writes the actions of all agents, e.g. `cprl.policies.assignment.AgentPolicies`.
    """

    def __init__(self, env: EnvBase, policy: Policy) -> None:
        self.env, self.policy = env, policy
        self._moment: TensorDictBase = env.reset()
        self.has_ended = False

    def play(self) -> TensorDictBase:
        """Plays the next turn; returns its entries, batch size [1], see `cprl.keys`."""
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        env = self.env
        with torch.no_grad(), one_thread(), set_exploration_type(ExplorationType.RANDOM):
            batch: TensorDictBase = env.step(self.policy(self._moment))
        self._moment = step_mdp(
            batch, reward_keys=env.reward_keys, action_keys=env.action_keys, done_keys=env.done_keys
        )
        self.has_ended = bool(batch["next", "done"].any())
        return batch
