"""evaluate_run: compares the agents of a stored run with the random policy in fresh worlds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pyarrow as pa

from cprl import arguments
from cprl.arguments import SEED as SEED
from cprl.envs.unwrap import agent_names
from cprl.evaluation.lanes import Played, Source, play, policies_of, random_policies
from cprl.measuring.replicas import Measured, institution_measures, over_replicas, social_measures
from cprl.measuring.series import OF_AGENTS
from cprl.runs.labelled import labelled
from cprl.stored import LoadedRun, load


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """Fresh episodes of a run's agents, and of the random policy in the same worlds."""

    run: LoadedRun
    seed: int
    greedy: bool
    trained: Played = field(repr=False)
    """The episodes by replica; replica r plays the worlds from r x episodes on."""
    random: Played = field(repr=False)
    """The episodes of uniformly random agents in the same worlds."""

    def measures(self, policy: str = "trained") -> dict[str, Measured]:
        """The social metrics over replicas by name, those of institutions as `institutions/fines` and so on,
        then the agents' returns, and what they paid, got and broke, as `agent_0/return` and so on.

        Args:
            policy: "trained" or "random".

        Raises:
            ValueError: if it is anything else.
        """
        arguments.choice("policy", policy, ("trained", "random"))
        played = {"trained": self.trained, "random": self.random}[policy]
        names = agent_names(self.run.env())
        first = next(iter(played.values()))[0]
        fields = {"return_": "return"} | {
            name: name for name in OF_AGENTS if getattr(first, name) is not None
        }
        of_agents = {
            f"{name}/{called}": over_replicas(
                {
                    replica: [float(getattr(episode, field)[agent]) for episode in own]
                    for replica, own in played.items()
                }
            )
            for field, called in fields.items()
            for agent, name in enumerate(names)
        }
        return {**social_measures(played), **institution_measures(played), **of_agents}

    def table(self) -> pa.Table:
        """The episodes with the columns of `episodes.parquet`, after "policy": "trained" or "random"."""
        return labelled(
            ({"policy": name}, replica, episodes)
            for name, played in (("trained", self.trained), ("random", self.random))
            for replica, episodes in played.items()
        )


def evaluate_run(
    run: str | Path | LoadedRun,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    allow: Sequence[str] = (),
) -> Evaluation:
    """Plays fresh episodes with every replica of a stored run, and with the random policy in the same worlds.

    Args:
        run: its directory, its exported results, or a value of `cprl.load`. For a run that has not ended, the
            newest checkpoint is used.
        episodes: episodes of each replica, each in its own world.
        greedy: whether agents take the action with the highest value or probability; else agents with values
            explore with the run's `epsilon_evaluation`, and agents with a policy sample from it. Scripted
            agents are not affected.
        seed: the seed of the worlds and of all random numbers; equal seeds give equal episodes.
        replicas: the indices of the replicas that play; by default all. A replica's episodes do not depend on
            the others.
        allow: see `cprl.load`.

    Raises:
        ValueError: if a number is out of range, a replica does not exist, the seed is that of the training,
            or the run cannot be loaded, see `cprl.load`.
    """
    loaded = opened(run, allow)
    check(episodes=episodes, seed=seed, greedy=greedy, runs=[loaded])
    numbers = chosen_replicas({str(loaded.path): loaded}, replicas)
    sources, common = [Source(loaded)] * loaded.game.agents, {"episodes": episodes, "seed": seed}
    agents = partial(policies_of, sources, worlds=episodes, seed=seed)
    by_chance = partial(random_policies, loaded, worlds=episodes, seed=seed)
    return Evaluation(
        run=loaded,
        seed=seed,
        greedy=greedy,
        trained=play(loaded, agents, numbers, explore=not greedy, **common),
        random=play(loaded, by_chance, numbers, explore=True, **common),
    )


def opened(run: str | Path | LoadedRun, allow: Sequence[str] = ()) -> LoadedRun:
    """A run, loaded if it is a directory.

    Raises:
        ValueError: if it is neither, or cannot be loaded, see `cprl.load`.
    """
    arguments.object_of("run", run, (str, Path, LoadedRun), "a directory, or a value of cprl.load")
    return run if isinstance(run, LoadedRun) else load(run, allow=allow)


def chosen_replicas(runs: Mapping[str, LoadedRun], replicas: Sequence[int]) -> list[int]:
    """The chosen replicas, or all that every run has, ascending.

    Args:
        runs: the runs by name.
        replicas: the indices of the chosen replicas; empty for all.

    Raises:
        ValueError: if a run does not have them, or the runs have none in common.
    """
    allowed = "the indices of replicas"
    chosen = {
        arguments.integer("a replica", replica, 0, allowed="an integer >= 0")
        for replica in arguments.listed("replicas", replicas, allowed)
    }
    common = sorted(set.intersection(*(set(run.replicas) for run in runs.values())))
    for name, run in runs.items():
        missing = sorted(chosen - set(run.replicas))
        if missing:
            raise ValueError(f"{name} has no replicas {missing}; allowed: {run.replicas}")
    if not common:
        has = {name: run.replicas for name, run in runs.items()}
        raise ValueError(f"the replicas of the runs are {has}; allowed: runs with a replica in common")
    return sorted(chosen) or common


def check(*, episodes: int, seed: int, greedy: bool, runs: Sequence[LoadedRun]) -> None:
    """Checks the arguments of an evaluation, and that no agent was trained in the worlds.

    Raises:
        ValueError: names the value and what is allowed.
    """
    arguments.integer("episodes", episodes, 1)
    arguments.seed(seed)
    arguments.switch("greedy", greedy)
    for run in runs:
        if run.experiment.seed == seed:
            raise ValueError(
                f"seed is {seed}, the training seed of {run.path}; allowed: any other seed, for fresh worlds"
            )
