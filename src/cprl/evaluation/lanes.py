"""Plays labelled populations of stored agents in the same fresh worlds; `Results` has the outcome.

All replicas play at once, as lanes: a step of all takes as long as a step of one, and each lane's random
numbers depend on (seed, replica, agent) alone.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, Self, TypeAlias

import numpy as np
import pyarrow as pa
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.commons.world import Shown
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.make_env import is_playable, make_env, spaces_of
from cprl.envs.unwrap import clock_of
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import Policy, evaluate
from cprl.measuring.played import Measured, institution_measures, over_replicas, social_measures
from cprl.measuring.series import Values
from cprl.measuring.statistics import Estimate, difference
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import SCRIPTED_POLICIES, ScriptedPolicy
from cprl.population import AgentSpec, Frozen, Scripted, specs_by_agent
from cprl.runs.episodes import Label, labelled
from cprl.system.defaults import SEED
from cprl.system.process import one_thread
from cprl.system.working import say_how_far
from cprl.training.agents import LoadedRun, Population, StoredAgent, in_a_row, load, stored_policies
from cprl.values import Custom, Positive, Seed, Value, Where, made, refusal

Played: TypeAlias = dict[int, list[Episode]]
"""Episodes by the number of the replica."""

Agent: TypeAlias = Callable[[int], StoredAgent]
"""Who plays at an index, by the number of the replica."""

Who: TypeAlias = tuple[int, ...]


def agents_of(run: LoadedRun, numbers: Mapping[int, int] | None = None) -> list[Agent]:
    """The agents of a run, each at its own index.

    Args:
        numbers: the run's replica for each replica that plays, if they differ.
    """

    def agent_at(agent: int, replica: int) -> StoredAgent:
        return run.agent(agent, replica=replica if numbers is None else numbers[replica])

    return [partial(agent_at, agent) for agent in range(run.game.agents)]


def scripted(policy: ScriptedPolicy) -> Agent:
    return lambda _: StoredAgent(scripted=policy)


def frozen(run: LoadedRun, spec: Frozen) -> Agent:
    """An agent of a run, of the replica that a specification names."""
    return lambda replica: run.agent(spec.agent, replica=spec.replica_for(replica))


@dataclass(frozen=True)
class FreshGame:
    """A game of which fresh worlds are made, like those of a `LoadedRun`."""

    game: Any
    metrics: tuple[Custom, ...] = ()

    @property
    def playing(self) -> Game | Spaces:
        return self.game if isinstance(self.game, Game) else spaces_of(self.env())

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        return make_env(self.game, worlds=worlds, seed=seed, first_world=first_world)


def commons_game(run: LoadedRun) -> Game:
    """The game of a run that has a board; raises a ValueError for others."""
    if not isinstance(run.game, Game):
        raise ValueError(f"{run.path} plays a game without a board of cprl; allowed: a run of a cprl.Game")
    return run.game


Place: TypeAlias = LoadedRun | FreshGame


def place_of(where: Any) -> Place:
    """A run as it is, a game as what makes fresh worlds of it."""
    if isinstance(where, LoadedRun):
        return where
    if not is_playable(where):
        raise refusal("where", where, "a game such as cprl.Game, or a value of cprl.load")
    return FreshGame(made(where))


@dataclass(frozen=True, kw_only=True)
class Fresh(Value, stored=False):
    """Fresh episodes of some replicas; replica r plays the worlds from r x episodes on."""

    replicas: Annotated[tuple[int, ...], Where(bool, "at least one")]
    """Their numbers, ascending."""
    episodes: Positive
    """Of each replica with each choice of who plays where, each in its own world."""
    seed: Seed
    """Of the worlds and of all random numbers."""
    greedy: bool = False
    """Whether stored agents take their best action; else they explore as in evaluation."""

    def __str__(self) -> str:
        counts = {"replica": len(self.replicas), "episode": self.episodes}
        return ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items()) + " each"

    def play(self, where: Place, agents: Sequence[Agent], *, among: Collection[LoadedRun] = ()) -> Played:
        """The episodes by replica, with the metrics of the user's own that all runs among which they are
        compared have; by default those of where they play."""
        compared: Sequence[Place] = [*among] or [where]
        metrics = [metric for metric in compared[0].metrics if all(metric in run.metrics for run in compared)]
        played: Played = {}
        for group, env in self.worlds(where):
            policies = self.policies(where, agents, group)
            ended = evaluate(env, policies, explore=not self.greedy, metrics=metrics)
            for place, replica in enumerate(group):
                played[replica] = ended[place * self.episodes : (place + 1) * self.episodes]
        return played

    def worlds(self, where: Place) -> Iterator[tuple[list[int], EnvBase]]:
        """The numbers of replicas, and an environment with their worlds in the same order, with as many
        consecutive replicas as possible in one."""
        for group in in_a_row(self.replicas):
            first = group[0] * self.episodes
            yield group, where.env(len(group) * self.episodes, seed=self.seed, first_world=first)

    def policies(self, where: Place, agents: Sequence[Agent], replicas: Sequence[int]) -> AgentPolicies:
        """The policies of the agents of these replicas."""
        stored = [[agent(replica) for replica in replicas] for agent in agents]
        return stored_policies(stored, where.playing, replicas=replicas, worlds=self.episodes, seed=self.seed)


def fresh_of(
    runs: Iterable[LoadedRun],
    *,
    episodes: int,
    greedy: bool,
    seed: int,
    replicas: Sequence[int],
    among: Iterable[LoadedRun] = (),
) -> Fresh:
    """Fresh episodes of the chosen replicas, or of all that every run has.

    Args:
        among: more runs of which no agent may have been trained in the worlds.
    """
    runs, chosen = list(runs), set(replicas)
    common = set.intersection(*(set(run.replicas) for run in runs))
    for run in runs:
        missing = sorted(chosen - set(run.replicas))
        if missing:
            raise ValueError(f"{run.path} has no replicas {missing}; allowed: {run.replicas}")
    if not common:
        has = {str(run.path): run.replicas for run in runs}
        raise ValueError(f"the replicas of the runs are {has}; allowed: runs with a replica in common")
    fresh = Fresh(replicas=tuple(sorted(chosen or common)), episodes=episodes, seed=seed, greedy=greedy)
    refuse_trained_in(fresh.seed, [*runs, *among])
    return fresh


def refuse_trained_in(seed: int, runs: Iterable[LoadedRun]) -> None:
    """Raises a ValueError for the seed of worlds in which agents of a run were trained."""
    for run in runs:
        if run.experiment.seed == seed:
            raise ValueError(
                f"seed is {seed}, the training seed of {run.path}; allowed: any other seed, for fresh worlds"
            )


Whose: TypeAlias = Literal["focal", "background", "group"]

_RETURNS: Final[Mapping[Whose, Callable[[Values, list[int]], float]]] = {
    "focal": lambda returns, focal: returns[focal].mean(),
    "background": lambda returns, focal: np.delete(returns, focal).mean(),
    "group": lambda returns, _: returns.sum(),
}
"""Of the agents' returns, float64 [N], and the indices of the focal agents."""


class Part(NamedTuple):
    """The episodes of a population."""

    labels: Label
    played: Played
    focal: tuple[Who, ...] = ()
    """The indices of the agents that are judged; several choices where the same episodes stand for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The episodes of labelled populations in the same fresh worlds."""

    parts: Sequence[Part] = field(repr=False)
    fresh: Fresh

    def where(self, **labels: str | int) -> Self:
        """The populations with these labels."""
        return replace(self, parts=[part for part in self.parts if labels.items() <= part.labels.items()])

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet` after the labels: a row for each population,
        replica, episode and agent."""
        return labelled(
            (labels, replica, episodes)
            for labels, played, _ in self.parts
            for replica, episodes in played.items()
        )

    @property
    def played(self) -> Played:
        """The episodes of all populations together."""
        together: Played = {}
        for part in self.parts:
            for replica, episodes in part.played.items():
                together.setdefault(replica, []).extend(episodes)
        return together

    def returns(self, whose: Whose) -> dict[int, list[float]]:
        """A return by replica, of each episode with each choice of focal agents: the mean of the focal
        agents, that of the others, or the sum of all."""
        values: dict[int, list[float]] = {}
        for part in self.parts:
            for focal in part.focal:
                for replica, episodes in part.played.items():
                    of_episodes = (float(_RETURNS[whose](one.return_, list(focal))) for one in episodes)
                    values.setdefault(replica, []).extend(of_episodes)
        return values

    def mean_returns(self, whose: Whose) -> Values:
        """The means of `returns`, [R]."""
        returns = self.returns(whose)
        return np.array([np.mean(returns[replica]) for replica in self.fresh.replicas])

    def estimates(self, *whose: Whose) -> dict[str, Measured]:
        """Over replicas by name: these returns as `focal/return` and so on, the social metrics, and those of
        institutions as `institutions/fines` and so on."""
        returns = {f"{name}/return": over_replicas(self.returns(name)) for name in whose}
        return {**returns, **social_measures(self.played), **institution_measures(self.played)}


def more(reached: Results, usual: Results, whose: Whose) -> Estimate:
    """How much higher a return is in the first results, paired by replica, which played the same worlds."""
    return difference(reached.mean_returns(whose), usual.mean_returns(whose), paired=True)


def shifted(counts: Sequence[int]) -> list[Who]:
    """Which kind plays at each index, where so many agents are of the first kind, of the second and so on:
    shifted by an index at a time, so that all kinds have each index equally often; one way for one kind."""
    first = tuple(np.repeat(np.arange(len(counts)), counts).tolist())
    shifts = range(len(first) if len(set(first)) > 1 else 1)
    return [first[len(first) - shift :] + first[: len(first) - shift] for shift in shifts]


def play_population(
    where: Any,
    agents: Sequence[AgentSpec],
    *,
    episodes: int = 20,
    replicas: int = 8,
    greedy: bool = False,
    seed: int = SEED,
) -> Played:
    """Plays fresh episodes of a population that does not learn.

    Args:
        where: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        agents: the specification of each agent, `Scripted` or `Frozen`. `Frozen(run, agent, replica=None)`
            plays in replica r what the run's replica r learned.
        episodes: episodes of each replica, each in its own world.
        replicas: the number R of replicas; where all agents are scripted, of independent groups of episodes.
        greedy: whether stored agents take their best action; else they explore as in evaluation.
        seed: the seed of the worlds and of all random numbers; with one seed all populations play in the
            same worlds.

    Returns:
        Episodes by the index of the replica, 0 to R - 1.
    """
    place = place_of(where)
    fresh = Fresh(replicas=tuple(range(replicas)), episodes=episodes, seed=seed, greedy=greedy)
    return fresh.play(place, agents_specified(place, agents, fresh))


def agents_specified(place: Place, specs: Sequence[AgentSpec], fresh: Fresh) -> list[Agent]:
    """The agents of specifications, `Scripted` or `Frozen`, none of which was trained in the worlds."""
    by_agent = specs_by_agent(specs, place.game.agents)
    for agent, spec in enumerate(by_agent):
        if not isinstance(spec, Scripted | Frozen):
            allowed = "Scripted(policy) or Frozen(run, agent, replica)"
            raise ValueError(f"agents[{agent}] is a {type(spec).__name__}; allowed: {allowed}")
    refuse_trained_in(fresh.seed, map(load, {spec.run for spec in by_agent if isinstance(spec, Frozen)}))
    population = Population(place.env(len(fresh.replicas)), specs)
    return [of_replicas.__getitem__ for of_replicas in population.as_stored(fresh.replicas)]


def agent_named(who: str, agent: int, *, replica: int | None = None, name: str) -> AgentSpec:
    """Who plays at an index: a scripted policy, or the agent of a run with that index."""
    if who in SCRIPTED_POLICIES:
        return Scripted(who)
    if not Path(who).is_dir():
        raise refusal(name, who, f"{', '.join(SCRIPTED_POLICIES)}, or a run's directory")
    return Frozen(who, agent, replica)


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
        self._turns = 0
        self._clock = clock_of(env)
        self.has_ended = False

    def play(self) -> TensorDictBase:
        """Plays the next turn; returns its entries, batch size [1], see `cprl.keys`."""
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        with torch.no_grad(), one_thread(), set_exploration_type(ExplorationType.RANDOM):
            batch: TensorDictBase = self.env.step(self.policy(self._moment))
        self._moment = self.env.step_mdp(batch)
        self._turns += 1
        say_how_far(self._turns, self._clock, "turns")
        self.has_ended = bool(batch["next", "done"].any())
        return batch


def board_now(env: CommonsEnv) -> Shown:
    """The board of one world without what agents observe."""
    board = env.worlds.show(env.output)
    return board._replace(observation=board.observation[:0])
