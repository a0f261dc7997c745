"""Populations: stored and scripted agents play together in fresh worlds; their episodes become a table.

All replicas play at once, as lanes of one environment, which takes about as long as a single replica. The
random numbers of a lane depend only on (seed, replica, agent). Replica r plays the worlds with the numbers
r * episodes to (r + 1) * episodes - 1.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import pyarrow as pa
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import is_playable, make_env, spaces_of
from cprl.envs.unwrap import agent_names
from cprl.measuring.playing import evaluate
from cprl.measuring.table import BACKGROUND, FOCAL, ROLE, Label, complete, labelled, store_agent_names
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.scripted import SCRIPTED_POLICIES, ScriptedPolicy
from cprl.population import AgentSpec, Frozen, Language, Scripted, specs_by_agent
from cprl.runs.episodes import table_of
from cprl.system.defaults import Fresh
from cprl.system.output import legible
from cprl.system.working import note_progress
from cprl.training.agents import Population
from cprl.training.stored import (
    LoadedRun,
    StoredAgent,
    consecutive_groups,
    load,
    stored_agent,
    stored_policies,
)
from cprl.values import Custom, instantiate, refusal

AgentOfReplica: TypeAlias = Callable[[int], StoredAgent]
"""A function that returns the agent for one index of a population, given the number of the replica."""

SCRIPTED_REPLICAS: Final = tuple(range(8))
"""The default replicas of populations without stored agents: independent groups of episodes."""


def agents_of(run: LoadedRun, stored_replicas: Mapping[int, int] | None = None) -> list[AgentOfReplica]:
    """Return the agents of a run, each for its own index.

    Args:
        stored_replicas: the replica of the run from which the agents come, by the replica that plays; by
            default they are the same.
    """

    def agent_at(agent: int, replica: int) -> StoredAgent:
        stored_replica = replica if stored_replicas is None else stored_replicas[replica]
        return run.agent(agent, replica=stored_replica)

    return [partial(agent_at, agent) for agent in range(run.game.agents)]


def scripted_agent(policy: ScriptedPolicy) -> AgentOfReplica:
    """Return an agent that follows a scripted policy in every replica."""
    return lambda _: StoredAgent(spec=Scripted(policy))


def frozen_agent(run: LoadedRun, spec: Frozen) -> AgentOfReplica:
    """Return the agent of a run that a specification names."""
    return lambda replica: run.agent(spec.agent, replica=spec.replica_for(replica))


@dataclass(frozen=True)
class FreshGame:
    """A game without a run. It makes fresh worlds, as a `LoadedRun` does."""

    game: Any
    metrics: tuple[Custom, ...] = ()
    """The user's metrics, of which a game has none."""

    @property
    def playing(self) -> Game | Spaces:
        """Return the game or the spaces for which policies are made, as `LoadedRun.playing`."""
        return self.game if isinstance(self.game, Game) else spaces_of(self.env())

    def governor(self, replicas: Sequence[int]) -> list[list[StoredAgent]]:
        """Return no governor: the first option of one in the game stays in force."""
        return []

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        """Return an environment with fresh worlds of the game."""
        return make_env(self.game, worlds=worlds, seed=seed, first_world=first_world)


def commons_game(run: LoadedRun) -> Game:
    """Return the game of a run; raise a ValueError if it is not a `cprl.Game`, which has a board."""
    if not isinstance(run.game, Game):
        raise ValueError(f"{run.path} plays a game without a board of cprl; allowed: a run of a cprl.Game")
    return run.game


WorldSource: TypeAlias = LoadedRun | FreshGame
"""The run or game that makes the fresh worlds in which agents play."""


def world_source_of(game_or_run: Any) -> WorldSource:
    """Return a run as it is, and a game as a `FreshGame`; refuse anything else."""
    if isinstance(game_or_run, LoadedRun):
        return game_or_run
    if not is_playable(game_or_run):
        raise refusal("game_or_run", game_or_run, "a game such as cprl.Game, or a value of cprl.load")
    return FreshGame(instantiate(game_or_run))


def fresh_for(runs: Iterable[LoadedRun], fresh: Fresh, *, other_runs: Iterable[LoadedRun] = ()) -> Fresh:
    """Return `fresh` with the replicas that play, after checking that the worlds are fresh for all agents.

    The replicas are those that `fresh` names, or by default all that every run has.

    Args:
        runs: the runs whose replicas play; none if all agents are scripted.
        other_runs: further runs with agents that play; their training seed must differ too.

    Raises:
        ValueError: if a run lacks one of the replicas, or was trained with the seed of `fresh`.
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
        replicas_by_run = {str(run.path): run.replicas for run in runs}
        raise ValueError(
            f"the replicas of the runs are {replicas_by_run}; allowed: runs with a replica in common"
        )
    refuse_trained_in(fresh.seed, [*runs, *other_runs])
    return replace(fresh, replicas=tuple(sorted(set(fresh.replicas) or common)))


def refuse_trained_in(seed: int, runs: Iterable[LoadedRun]) -> None:
    """Raise a ValueError if a run was trained with this seed, whose worlds its agents know."""
    for run in runs:
        if run.experiment.seed == seed:
            raise ValueError(
                f"seed is {seed}, the training seed of {run.path}; allowed: any other seed, for fresh worlds"
            )


def fresh_worlds(fresh: Fresh, world_source: WorldSource) -> Iterator[tuple[list[int], EnvBase]]:
    """Yield groups of replicas with consecutive numbers, each with an environment that holds their worlds.

    The worlds of an environment have consecutive numbers, and are in the order of the replicas.
    """
    for group in consecutive_groups(fresh.replicas):
        first = group[0] * fresh.episodes
        yield group, world_source.env(len(group) * fresh.episodes, seed=fresh.seed, first_world=first)


def policies_of(
    fresh: Fresh, world_source: WorldSource, agents: Sequence[AgentOfReplica], replicas: Sequence[int]
) -> JointPolicy:
    """Return the joint policy of all agents in the lanes of these replicas."""
    stored = [list(map(agent, replicas)) for agent in agents] + world_source.governor(replicas)
    return stored_policies(
        stored, world_source.playing, replicas=replicas, worlds=fresh.episodes, seed=fresh.seed
    )


def play_fresh(
    fresh: Fresh,
    world_source: WorldSource,
    agents: Sequence[AgentOfReplica],
    labels: Label | None = None,
    *,
    roles: Sequence[str] = (),
    compared_runs: Collection[LoadedRun] = (),
) -> pa.Table:
    """Let a population play fresh episodes; return their table.

    Args:
        fresh: the episodes and the replicas, see `fresh_for`.
        world_source: the run or the game that makes the worlds.
        agents: the agent at each index.
        labels: the values of the first columns, by the columns' names.
        roles: the role of each agent, see `cprl.measuring.table.ROLE` and `roles_of`.
        compared_runs: all runs that are compared; the user's metrics that all of them have are measured. By
            default those of `world_source`.
    """
    compared: Sequence[WorldSource] = [*compared_runs] or [world_source]
    metrics = list(compared[0].metrics)
    for another in compared[1:]:
        metrics = [metric for metric in metrics if metric in another.metrics]
    parts = []
    for group, env in fresh_worlds(fresh, world_source):
        policies = policies_of(fresh, world_source, agents, group)
        ended = evaluate(env, policies, explore=not fresh.greedy, metrics=metrics)
        parts.append(table_of(ended, group))
    table = labelled(pa.concat_tables(parts), **(labels or {}))
    world_column = table.column_names.index("replica") + 1
    world = table["replica"].to_numpy() * fresh.episodes + table["episode"].to_numpy()
    table = table.add_column(world_column, "world", pa.array(world, pa.int32()))
    if roles:
        table = table.add_column(world_column + 3, ROLE, pa.array(roles).take(table["agent"]))
    return store_agent_names(table, agent_names(env))


def roles_of(agents: int, focal: Collection[int]) -> list[str]:
    """Return the role of each agent: focal for these indices, background for all others."""
    return [FOCAL if agent in focal else BACKGROUND for agent in range(agents)]


def join_tables(parts: Iterable[pa.Table], **notes: object) -> pa.Table:
    """Join the tables of several populations into one table with all metrics.

    Args:
        parts: yields the tables; the episodes of a table are played when it is taken.
        notes: texts about the evaluation, which the table's metadata hold, see `table_note`.
    """
    tables = []
    for part in parts:
        tables.append(part)
        note_progress(len(tables), None, "populations")
    table = complete(pa.concat_tables(tables))
    texts = {name: legible(str(value)) for name, value in notes.items()}
    return table.replace_schema_metadata({**(table.schema.metadata or {}), **texts})


def table_note(table: pa.Table, name: str) -> str:
    """Return a note from the metadata of a table, e.g. its "heading"; "" if it has no such note."""
    metadata = table.schema.metadata or {}
    return str(metadata.get(name.encode(), b"").decode())


def rotations(counts: Sequence[int]) -> list[tuple[int, ...]]:
    """Return all rotations of a population, so that each kind of agent has each index equally often.

    Two agents of kind 0 and one of kind 1, `[2, 1]`, give `(0, 0, 1)`, `(1, 0, 0)` and `(0, 1, 0)`. A
    population of a single kind has one rotation.

    Args:
        counts: the number of agents of each kind.

    Returns:
        The kind of the agent at each index, in each rotation.
    """
    kinds = tuple(np.repeat(np.arange(len(counts)), counts).tolist())
    if len(set(kinds)) == 1:
        return [kinds]
    agents = len(kinds)
    return [kinds[agents - shift :] + kinds[: agents - shift] for shift in range(agents)]


def play_population(game_or_run: Any, agents: Sequence[AgentSpec], fresh: Fresh = Fresh()) -> pa.Table:
    """Let scripted and stored agents play fresh episodes, in which nobody learns; return their table.

    Args:
        game_or_run: a game; or a run, a value of `cprl.load`, whose game and transforms are used.
        agents: the specification of each agent, `Scripted`, `Language` or `Frozen`. In replica r,
            `Frozen(run, agent, replica=None)` is the agent of the run's replica r.
        fresh: the number of episodes, their seed, and the replicas that play. With the same seed all
            populations play in the same worlds.

    Raises:
        ValueError: for agents that learn, people, another number of agents than the game's, no replica in
            common, or a seed with which a run was trained.
    """
    world_source = world_source_of(game_or_run)
    fresh = fresh_of_specs(agents, fresh)
    return join_tables([play_fresh(fresh, world_source, agents_specified(world_source, agents, fresh))])


def fresh_of_specs(specs: Sequence[AgentSpec], fresh: Fresh) -> Fresh:
    """Return `fresh` with the replicas that all stored agents among these have, see `fresh_for`."""
    frozen = [spec for spec in specs if isinstance(spec, Frozen)]
    runs = {spec.run: load(spec.run) for spec in frozen}
    runs_with_all_replicas = {spec.run: runs[spec.run] for spec in frozen if spec.replica is None}
    return fresh_for(runs_with_all_replicas.values(), fresh, other_runs=runs.values())


def agents_specified(
    world_source: WorldSource, specs: Sequence[AgentSpec], fresh: Fresh
) -> list[AgentOfReplica]:
    """Return the agents that specifications describe; refuse those that learn, and people."""
    by_agent = specs_by_agent(specs, world_source.game.agents)
    for agent, spec in enumerate(by_agent):
        if not isinstance(spec, Scripted | Language | Frozen):
            allowed = "Scripted(policy), Language(model) or Frozen(run, agent, replica)"
            raise ValueError(f"agents[{agent}] is a {type(spec).__name__}; allowed: {allowed}")
    # It refuses agents that cannot play in these worlds.
    population = Population(world_source.env(), specs, first_replica=fresh.replicas[0])
    load_once = cache(load)
    return [partial(stored_agent, spec, calls=population.calls, load=load_once) for spec in by_agent]


def agent_named(source: str, agent: int, *, replica: int | None = None, name: str) -> AgentSpec:
    """Return the specification of the agent at an index.

    Args:
        source: the name of a scripted policy; or the directory of a run, whose agent with this index plays.
        replica: the replica of the run; None for the same as the one that plays.
        name: the name of the argument, for a refusal.

    Raises:
        ValueError: for a word that is neither.
    """
    if source in SCRIPTED_POLICIES:
        return Scripted(source)
    if not Path(source).is_dir():
        raise refusal(name, source, f"{', '.join(SCRIPTED_POLICIES)}, or a run's directory")
    return Frozen(source, agent, replica)
