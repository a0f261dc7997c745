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
    """The episodes of several plays together, by replica."""
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
    def game(self) -> Any:
        """What is played."""
        ...

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        """So many fresh worlds."""
        ...


@dataclass(frozen=True)
class Source:
    """The run from which an agent is taken in every replica: the run's agent with the same index.

    Args:
        replicas: the run's replica for each index of a replica, if they differ.
    """

    run: LoadedRun
    replicas: Mapping[int, int] | None = None

    def replica(self, number: int) -> int:
        """The run's replica whose agent plays in this replica."""
        return number if self.replicas is None else self.replicas[number]


def play(
    where: Place, policies: MakePolicies, replicas: Sequence[int], *, episodes: int, seed: int, explore: bool
) -> Played:
    """Plays `episodes` fresh episodes of each replica; replica r plays the worlds from r x episodes on."""
    played: Played = {}
    for group, env in fresh_worlds(where, replicas, worlds=episodes, seed=seed):
        found = evaluate(env, policies(group), explore=explore)
        for place, replica in enumerate(group):
            played[replica] = found[place * episodes : (place + 1) * episodes]
    return played


def play_sources(
    where: Place,
    sources: Sequence[Source],
    replicas: Sequence[int],
    *,
    episodes: int,
    seed: int,
    explore: bool,
) -> Played:
    """`play` by agents of stored runs: the sources of agent 0, 1 and so on."""
    policies = partial(policies_of, sources, worlds=episodes, seed=seed)
    return play(where, policies, replicas, episodes=episodes, seed=seed, explore=explore)


def fresh_worlds(
    where: Place, replicas: Sequence[int], *, worlds: int, seed: int
) -> Iterator[tuple[list[int], EnvBase]]:
    """The worlds of each replica, with as many replicas as possible in one environment.

    Yields:
        The indices of replicas, and an environment with their worlds in the same order, see `play`.
    """
    for group in _consecutive(replicas):
        yield group, where.env(len(group) * worlds, seed=seed, first_world=group[0] * worlds)


def policies_of(
    sources: Sequence[Source], replicas: Sequence[int], *, worlds: int, seed: int
) -> AgentPolicies:
    """The policies of all agents of these replicas, from stored runs.

    Args:
        seed: the seed of random numbers, together with the replica and the agent.
    """
    found = [
        [source.run.agent(agent, replica=source.replica(replica)) for replica in replicas]
        for agent, source in enumerate(sources)
    ]
    run = sources[0].run
    playing = run.game if isinstance(run.game, Game) else run.spaces
    return stored_policies(found, playing, replicas=replicas, worlds=worlds, seed=seed)


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
