"""Which runs, replicas, agents and seeds best responses can be measured with."""

import os
from collections.abc import Sequence
from typing import Any

from cprl import arguments
from cprl.evaluation.evaluate import check
from cprl.stored import LoadedRun


def check_population(run: LoadedRun) -> None:
    """Raises a ValueError for a run that no response can be measured against; says why."""
    if run.game.agents < 2:
        raise ValueError(
            f"the game of {run.path} has 1 agent; allowed for best responses: at least 2, since it is the "
            "others that are exploited"
        )
    if run.weights_from.name != "final.pt":
        raise ValueError(
            f"{run.path} was loaded with the weights {run.weights_from.name}; allowed: a run that has ended, "
            "with its final weights, which responses meet"
        )


def consecutive_replicas(run: LoadedRun, replicas: int | None) -> int:
    """How many replicas play: the first ones of a run, by default all.

    Raises:
        ValueError: if the run does not keep them, or the weights of one are NaN or infinite.
    """
    if replicas is None and run.replicas != list(range(len(run.replicas))):
        raise ValueError(f"{run.path} keeps the replicas {run.replicas}; allowed: 0 and those that follow it")
    most = len(run.replicas)
    found = most if replicas is None else arguments.integer("replicas", replicas, 1, most)
    for replica in range(found):
        for agent in range(run.game.agents):
            run.agent(agent, replica=replica)
    return found


def check_seeds(seed: int, episodes: int, runs: Sequence[LoadedRun]) -> int:
    """The seed of fresh worlds; raises a ValueError where it, or the next one, was trained with."""
    seed = arguments.seed(seed)
    for own in (seed, seed + 1):
        check(episodes=episodes, seed=own, greedy=False, runs=runs)
    return seed


def check_agents(agents: Sequence[Any], run: LoadedRun) -> tuple[int, ...]:
    """Indices of agents of a run's game, at least one and each once.

    Raises:
        ValueError: for anything else.
    """
    found = [arguments.integer("an agent", own, 0, run.game.agents - 1) for own in agents]
    if not found or len(set(found)) < len(found):
        raise arguments.refusal("agents", list(agents), "indices of agents, at least one and each once")
    return tuple(found)


def path_of(run: LoadedRun) -> str:
    """The directory of a run as `Frozen` names it, relative to where we stand."""
    return os.path.relpath(run.path)
