"""Plays populations of stored and scripted agents in fresh worlds; what they did is a tidy table.

All replicas play at once, as lanes: a step of all takes as long as a step of one, and each lane's random
numbers depend on (seed, replica, agent) alone. Replica r plays the worlds from r x episodes on.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import pyarrow as pa
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import is_playable, make_env, spaces_of
from cprl.envs.unwrap import agent_names
from cprl.measuring.evaluate import evaluate
from cprl.measuring.table import BACKGROUND, FOCAL, ROLE, Label, complete, labelled, naming
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import SCRIPTED_POLICIES, ScriptedPolicy
from cprl.population import AgentSpec, Frozen, Scripted, specs_by_agent
from cprl.runs.episodes import table_of
from cprl.system.defaults import Fresh
from cprl.system.output import legible
from cprl.system.working import say_how_far
from cprl.training.agents import Population
from cprl.training.stored import LoadedRun, StoredAgent, in_a_row, load, stored_policies
from cprl.values import Custom, made, refusal

Agent: TypeAlias = Callable[[int], StoredAgent]
"""Who plays at an index, by the number of the replica."""

Who: TypeAlias = tuple[int, ...]

SCRIPTED_REPLICAS: Final = tuple(range(8))
"""The replicas of scripted agents, of independent groups of episodes, unless somebody says."""


def agents_of(run: LoadedRun, numbers: Mapping[int, int] | None = None) -> list[Agent]:
    """Return the agents of a run, each at its own index.

    Args:
        numbers: the run's replica for each replica that plays, if they differ.
    """

    def agent_at(agent: int, replica: int) -> StoredAgent:
        return run.agent(agent, replica=replica if numbers is None else numbers[replica])

    return [partial(agent_at, agent) for agent in range(run.game.agents)]


def scripted(policy: ScriptedPolicy) -> Agent:
    return lambda _: StoredAgent(scripted=policy)


def frozen(run: LoadedRun, spec: Frozen) -> Agent:
    """Return an agent of a run, of the replica that a specification names."""
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
    """Return the game of a run that has a board; raise a ValueError for others."""
    if not isinstance(run.game, Game):
        raise ValueError(f"{run.path} plays a game without a board of cprl; allowed: a run of a cprl.Game")
    return run.game


Place: TypeAlias = LoadedRun | FreshGame


def place_of(where: Any) -> Place:
    """Return a run as it is, a game as what makes fresh worlds of it."""
    if isinstance(where, LoadedRun):
        return where
    if not is_playable(where):
        raise refusal("where", where, "a game such as cprl.Game, or a value of cprl.load")
    return FreshGame(made(where))


def fresh_for(runs: Iterable[LoadedRun], fresh: Fresh, *, among: Iterable[LoadedRun] = ()) -> Fresh:
    """Return fresh episodes with the numbers of the replicas that play: those that are asked for, else all
    that every run has.

    Args:
        runs: those whose replicas play; without any, agents are scripted.
        among: more runs of which no agent may have been trained in the worlds.
    """
    runs = list(runs)
    for run in runs:
        missing = sorted(set(fresh.replicas) - set(run.replicas))
        if missing:
            raise ValueError(f"{run.path} has no replicas {missing}; allowed: {run.replicas}")
    common = set(SCRIPTED_REPLICAS)
    if runs:
        common = set.intersection(*(set(run.replicas) for run in runs))
    if not common:
        has = {str(run.path): run.replicas for run in runs}
        raise ValueError(f"the replicas of the runs are {has}; allowed: runs with a replica in common")
    refuse_trained_in(fresh.seed, [*runs, *among])
    return replace(fresh, replicas=tuple(sorted(set(fresh.replicas) or common)))


def refuse_trained_in(seed: int, runs: Iterable[LoadedRun]) -> None:
    """Raise a ValueError for the seed of worlds in which agents of a run were trained."""
    for run in runs:
        if run.experiment.seed == seed:
            raise ValueError(
                f"seed is {seed}, the training seed of {run.path}; allowed: any other seed, for fresh worlds"
            )


def worlds_of(fresh: Fresh, place: Place) -> Iterator[tuple[list[int], EnvBase]]:
    """Yield the numbers of replicas, and an environment with their worlds in the same order, with as many
    consecutive replicas as possible in one."""
    for group in in_a_row(fresh.replicas):
        first = group[0] * fresh.episodes
        yield group, place.env(len(group) * fresh.episodes, seed=fresh.seed, first_world=first)


def policies_of(
    fresh: Fresh, place: Place, agents: Sequence[Agent], replicas: Sequence[int]
) -> AgentPolicies:
    """Return the policies of the agents of these replicas."""
    stored = [[agent(replica) for replica in replicas] for agent in agents]
    return stored_policies(stored, place.playing, replicas=replicas, worlds=fresh.episodes, seed=fresh.seed)


def play(
    fresh: Fresh,
    place: Place,
    agents: Sequence[Agent],
    labels: Label | None = None,
    *,
    roles: Sequence[str] = (),
    among: Collection[LoadedRun] = (),
) -> pa.Table:
    """Let a population play fresh episodes; return their table.

    Args:
        fresh: with the numbers of its replicas, see `fresh_for`.
        labels: what is played, the first columns by name.
        roles: what each agent is among the others, see `cprl.measuring.table.ROLE`, and `roles_of`.
        among: all runs with which this is compared: metrics of the user's own are measured that all have; by
            default those of where they play.
    """
    compared: Sequence[Place] = [*among] or [place]
    metrics = [metric for metric in compared[0].metrics if all(metric in run.metrics for run in compared)]
    parts = []
    for group, env in worlds_of(fresh, place):
        policies = policies_of(fresh, place, agents, group)
        ended = evaluate(env, policies, explore=not fresh.greedy, metrics=metrics)
        parts.append(table_of(ended, group))
    table = labelled(pa.concat_tables(parts), **(labels or {}))
    place_of_world = table.column_names.index("replica") + 1
    world = table["replica"].to_numpy() * fresh.episodes + table["episode"].to_numpy()
    table = table.add_column(place_of_world, "world", pa.array(world, pa.int32()))
    if roles:
        table = table.add_column(place_of_world + 3, ROLE, pa.array(roles).take(table["agent"]))
    return naming(table, agent_names(env))


def roles_of(agents: int, focal: Collection[int]) -> list[str]:
    """Return the role of each agent where some are focal."""
    return [FOCAL if agent in focal else BACKGROUND for agent in range(agents)]


def together(parts: Iterable[pa.Table], **said: object) -> pa.Table:
    """Return the tables of populations as one, with all metrics.

    Args:
        parts: each played as it is asked for.
        said: how they were played: texts that its schema's metadata keep, see `said`.
    """
    tables = []
    for part in parts:
        tables.append(part)
        say_how_far(len(tables), None, "populations")
    table = complete(pa.concat_tables(tables))
    texts = {name: legible(str(value)) for name, value in said.items()}
    return table.replace_schema_metadata({**(table.schema.metadata or {}), **texts})


def said(table: pa.Table, name: str) -> str:
    """Return what the metadata of a table say of how it was played, e.g. its "heading"; "" if nothing."""
    metadata = table.schema.metadata or {}
    return str(metadata.get(name.encode(), b"").decode())


def shifted(counts: Sequence[int]) -> list[Who]:
    """Return which kind plays at each index, where so many agents are of the first kind, of the second and
    so on: shifted by an index at a time, so that all kinds have each index equally often; one way for one
    kind."""
    first = tuple(np.repeat(np.arange(len(counts)), counts).tolist())
    shifts = range(len(first) if len(set(first)) > 1 else 1)
    return [first[len(first) - shift :] + first[: len(first) - shift] for shift in shifts]


def play_population(where: Any, agents: Sequence[AgentSpec], fresh: Fresh = Fresh()) -> pa.Table:
    """Let a population that does not learn play fresh episodes; return their table.

    Args:
        where: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        agents: the specification of each agent, `Scripted` or `Frozen`. `Frozen(run, agent, replica=None)`
            plays in replica r what the run's replica r learned.
        fresh: which episodes; with one seed all populations play in the same worlds.
    """
    place = place_of(where)
    fresh = fresh_of_specs(agents, fresh)
    return together([play(fresh, place, agents_specified(place, agents, fresh))])


def fresh_of_specs(specs: Sequence[AgentSpec], fresh: Fresh) -> Fresh:
    """Return fresh episodes with the replicas that stored agents among these have, see `fresh_for`."""
    frozen = [spec for spec in specs if isinstance(spec, Frozen)]
    runs = {spec.run: load(spec.run) for spec in frozen}
    of_each_replica = {spec.run: runs[spec.run] for spec in frozen if spec.replica is None}
    return fresh_for(of_each_replica.values(), fresh, among=runs.values())


def agents_specified(place: Place, specs: Sequence[AgentSpec], fresh: Fresh) -> list[Agent]:
    """Return the agents of specifications, `Scripted` or `Frozen`."""
    for agent, spec in enumerate(specs_by_agent(specs, place.game.agents)):
        if not isinstance(spec, Scripted | Frozen):
            allowed = "Scripted(policy) or Frozen(run, agent, replica)"
            raise ValueError(f"agents[{agent}] is a {type(spec).__name__}; allowed: {allowed}")
    stored: list[dict[int, StoredAgent]] = [{} for _ in range(place.game.agents)]
    for group in in_a_row(fresh.replicas):
        population = Population(place.env(len(group)), specs, first_replica=group[0])
        for by_replica, agents in zip(stored, population.as_stored(group), strict=True):
            by_replica |= zip(group, agents, strict=True)
    return [by_replica.__getitem__ for by_replica in stored]


def agent_named(who: str, agent: int, *, replica: int | None = None, name: str) -> AgentSpec:
    """Return who plays at an index: a scripted policy, or the agent of a run with that index."""
    if who in SCRIPTED_POLICIES:
        return Scripted(who)
    if not Path(who).is_dir():
        raise refusal(name, who, f"{', '.join(SCRIPTED_POLICIES)}, or a run's directory")
    return Frozen(who, agent, replica)
