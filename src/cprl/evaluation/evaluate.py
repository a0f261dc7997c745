"""evaluate_run: how well the agents of a stored run play fresh worlds, beside the random policy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import pyarrow as pa

from cprl.evaluation.lanes import Played, Sitter, play, random_agents, seated
from cprl.measuring.replicas import Measured, over_replicas, social_measures
from cprl.runs.labelled import labelled
from cprl.stored import LoadedRun, load

SEED: Final = 30_011
"""Of the fresh worlds; no training of ours uses it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """Fresh episodes of a run's agents, and of the random policy in the same worlds."""

    run: LoadedRun
    seed: int
    greedy: bool
    trained: Played
    """By replica; those of number r in the worlds r x episodes and on."""
    random: Played
    """The same worlds, every action equally likely at every seat."""

    def measures(self, policy: str = "trained") -> dict[str, Measured]:
        """The social metrics over replicas by name, then the agents' returns as `agent_0/return` and so on.

        Args:
            policy: "trained" or "random".
        """
        played = {"trained": self.trained, "random": self.random}[policy]
        returns = {
            f"{name}/return": over_replicas(
                {
                    replica: [float(episode.return_[agent]) for episode in own]
                    for replica, own in played.items()
                }
            )
            for agent, name in enumerate(self.run.game.agent_names)
        }
        return {**social_measures(played), **returns}

    def table(self) -> pa.Table:
        """The episodes as `episodes.parquet` has them, behind a column "policy": "trained" or "random"."""
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
) -> Evaluation:
    """Lets every replica of a stored run play fresh episodes, and the random policy in the same worlds.

    Args:
        run: its directory, its results, or what `cprl.load` gave. Of a run that has not ended the newest
            checkpoint plays.
        episodes: of each replica, each in a world of its own.
        greedy: whether agents take the action that they hold best or likeliest; else those that learned
            values explore with the run's `epsilon_evaluation` and those that learned a policy draw from it.
            Scripted agents do what they do.
        seed: of the worlds and of all chance; the same worlds and the same episodes every time.
        replicas: the numbers of those that play; by default all. One plays the same alone as among others.

    Raises:
        ValueError: for numbers out of range, replicas that were not kept, the seed of the training, or a run
            that cannot be loaded, see `cprl.load`.
    """
    loaded = opened(run)
    check(episodes=episodes, seed=seed, runs=[loaded])
    numbers = chosen_replicas({str(loaded.path): loaded}, replicas)
    game, sitters = loaded.game, [Sitter(loaded)] * loaded.game.agents
    common = {"episodes": episodes, "seed": seed}
    agents = partial(seated, sitters, worlds=episodes, seed=seed)
    by_chance = partial(random_agents, game, worlds=episodes, seed=seed)
    return Evaluation(
        run=loaded,
        seed=seed,
        greedy=greedy,
        trained=play(game, agents, numbers, explore=not greedy, **common),
        random=play(game, by_chance, numbers, explore=True, **common),
    )


def opened(run: str | Path | LoadedRun) -> LoadedRun:
    """A run, loaded if it is not."""
    return run if isinstance(run, LoadedRun) else load(run)


def kept_replicas(run: LoadedRun) -> list[int]:
    """The numbers of a run's replicas, also where no agent of it learned."""
    return run.replicas or list(range(int(run.recipe["arguments"].get("replicas", 1))))


def chosen_replicas(runs: Mapping[str, LoadedRun], wanted: Sequence[int]) -> list[int]:
    """The replicas wanted, or all that every run has, ascending.

    Args:
        runs: by name.
        wanted: numbers; none for all.

    Raises:
        ValueError: where a run does not have them, or the runs have none in common.
    """
    common = sorted(set.intersection(*(set(kept_replicas(run)) for run in runs.values())))
    for name, run in runs.items():
        missing = sorted(set(wanted) - set(kept_replicas(run)))
        if missing:
            raise ValueError(f"{name} has no replicas {missing}; it has {kept_replicas(run)}")
    if not common:
        has = {name: kept_replicas(run) for name, run in runs.items()}
        raise ValueError(f"the runs have no replica in common: {has}")
    return sorted(set(wanted)) or common


def check(*, episodes: int, seed: int, runs: Sequence[LoadedRun]) -> None:
    """That there are episodes, and that the worlds are fresh to all agents.

    Raises:
        ValueError: says what is wanted.
    """
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}; at least 1 is wanted")
    for run in runs:
        if run.recipe["arguments"].get("seed") == seed:
            raise ValueError(
                f"seed is {seed}, by which {run.path} was trained; with another its worlds are fresh"
            )
