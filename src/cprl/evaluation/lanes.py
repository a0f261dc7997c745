"""Seating: agents of stored runs at the seats of fresh worlds, replicas side by side as lanes.

What plays is what `LoadedRun.policy` gives, but as lanes: one step of all replicas takes as long as one of
one, and chance is handed in: each lane's random numbers follow from (seed, replica, seat) alone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.learners.lanes import EVALUATION, lane_seeds
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.networks.stacked import stack_lanes
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.lanes import LaneActor, random_lanes
from cprl.policies.scripted import scripted_lanes
from cprl.stored import LoadedRun, load

Played: TypeAlias = dict[int, list[Episode]]
"""Episodes by the number of the replica."""

MakeSeats: TypeAlias = Callable[[Sequence[int]], AgentPolicies]
"""Who plays, out of the numbers of the replicas that are side by side."""


@dataclass(frozen=True)
class Sitter:
    """Who takes a seat in every replica: a run's agent for that seat.

    Args:
        run: whose.
        replicas: by the number of a replica, that of the run's replica which the agent is of, if another.
    """

    run: LoadedRun
    replicas: Mapping[int, int] | None = None

    def replica(self, number: int) -> int:
        """Of which of the run's replicas the agent in this one is."""
        return number if self.replicas is None else self.replicas[number]


def play(
    game: Game, who: MakeSeats, replicas: Sequence[int], *, episodes: int, seed: int, explore: bool
) -> Played:
    """So many fresh episodes of each replica; number r plays the worlds r x episodes and on of the seed.

    Args:
        game: what is played.
        who: see `MakeSeats`; its actors see so many worlds of each replica side by side.
        replicas: their numbers, ascending.
        episodes: of each.
        seed: of the worlds.
        explore: see `cprl.measuring.evaluate.evaluate`.
    """
    played: Played = {}
    for group, env in fresh_worlds(game, replicas, worlds=episodes, seed=seed):
        found = evaluate(env, who(group), explore=explore)
        for place, replica in enumerate(group):
            played[replica] = found[place * episodes : (place + 1) * episodes]
    return played


def fresh_worlds(
    game: Game, replicas: Sequence[int], *, worlds: int, seed: int
) -> Iterator[tuple[list[int], CommonsEnv]]:
    """So many worlds of each replica, those of as many as can be side by side in one environment.

    Yields:
        The numbers of replicas, and their worlds in the same order; see `play` for which.
    """
    for group in _consecutive(replicas):
        yield group, CommonsEnv(game, len(group) * worlds, seed=seed, first_world=group[0] * worlds)


def seated(sitters: Sequence[Sitter], replicas: Sequence[int], *, worlds: int, seed: int) -> AgentPolicies:
    """Agents of stored runs at all seats of these replicas, so many worlds of each side by side.

    Args:
        sitters: who takes seat 0, 1 and so on.
        replicas: their numbers.
        worlds: of each.
        seed: what their chance follows from, with the replica and the seat.

    Raises:
        ValueError: where a run keeps no network of an agent; says which are kept.
    """
    game = sitters[0].run.game
    alike: dict[Any, list[int]] = {}
    earlier = cache(load)  # a run whose agents are frozen in this one, once for all its seats and replicas
    found = [
        [_agent(sitter, agent, replica, earlier) for replica in replicas]
        for agent, sitter in enumerate(sitters)
    ]
    for agent, of_replicas in enumerate(found):
        alike.setdefault(of_replicas[0].kind, []).append(agent)
    actors: dict[AgentIndices, nn.Module] = {}
    for kind, agents in alike.items():
        seeds = lane_seeds(seed, replicas=replicas, agents=agents, purpose=EVALUATION)
        networks = [found[agent][place].network for place in range(len(replicas)) for agent in agents]
        actors[tuple(agents)] = _actor(kind, game, networks, seeds=seeds, agents=len(agents), worlds=worlds)
    return AgentPolicies(actors)


def random_agents(game: Game, replicas: Sequence[int], *, worlds: int, seed: int) -> AgentPolicies:
    """Agents to whom every action is equally likely at all seats of these replicas; see `seated`."""
    everyone = tuple(range(game.agents))
    seeds = lane_seeds(seed, replicas=replicas, agents=everyone, purpose=EVALUATION)
    return AgentPolicies(
        {everyone: random_lanes(len(game.actions), seeds=seeds, agents=len(everyone), worlds=worlds)}
    )


@dataclass(frozen=True, eq=False)
class _Agent:
    """An agent, and what it has in common with those that can be lanes of one actor with it."""

    kind: tuple[Any, ...]
    """("scripted", manner), or ("trained", samples, epsilon, algorithm)."""
    network: nn.Module | None = None


def _agent(sitter: Sitter, agent: int, replica: int, earlier: Callable[[str], LoadedRun]) -> _Agent:
    """The agent at a seat of a replica; of a frozen one the run is what `earlier` gives for its path."""
    run, of_replica = sitter.run, sitter.replica(replica)
    member = run.members[agent]
    if member["member"] == "Scripted":
        return _Agent(("scripted", member["manner"]))
    if member["member"] == "Frozen":
        run, agent, of_replica = earlier(member["run"]), member["agent"], member["replica"]
    network, stochastic, epsilon = run.agent(agent, replica=of_replica)
    return _Agent(("trained", stochastic, epsilon, repr(run.algorithms[agent])), network)


def _actor(kind: tuple[Any, ...], game: Game, networks: Sequence[Any], **how: Any) -> nn.Module:
    """One actor for agents of one kind."""
    if kind[0] == "scripted":
        return scripted_lanes(kind[1], game, **how)
    _, stochastic, epsilon, _ = kind
    actor = LaneActor(_side_by_side(networks), len(game.actions), stochastic=stochastic, **how)
    actor.epsilon = epsilon
    return actor


def _side_by_side(networks: Sequence[nn.Module]) -> Callable[[Tensor], Tensor]:
    """What all networks give for what their lanes see, [L, k, C, X, Y] to [L, k, A]."""
    try:
        stack = stack_lanes(networks)
    except ValueError:  # of a form that does not stack, e.g. an algorithm's of the user's own
        return lambda seen: torch.stack([network(own) for network, own in zip(networks, seen, strict=True)])
    return lambda seen: stack(seen)


def _consecutive(numbers: Sequence[int]) -> list[list[int]]:
    """Ascending numbers in groups without gaps."""
    groups: list[list[int]] = []
    for number in numbers:
        if groups and groups[-1][-1] + 1 == number:
            groups[-1].append(number)
        else:
            groups.append([number])
    return groups
