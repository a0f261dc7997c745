"""evaluate_run: compares the agents of a stored run with the random policy in fresh worlds.

The module also holds the checks that several runs have the same game.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import torch

from cprl.envs.make_env import stored_game
from cprl.evaluation.pages import heading
from cprl.evaluation.populations import agents_of, fresh_for, join_tables, play_fresh, scripted_agent
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.training.stored import LoadedRun, load
from cprl.values import describe_changes, to_config

_MOST_DIFFERENCES: Final = 3
"""The largest number of differences between two games that a message lists."""


def refuse_other_games(runs: Mapping[str, LoadedRun]) -> None:
    """Raise a ValueError if a run has a different game or different transforms than the first run.

    Args:
        runs: the runs by the names that a refusal says.
    """
    first_name, *other_names = runs
    first_run = runs[first_name]
    for name in other_names:
        run = runs[name]
        both = f"{first_name} and {name}"
        refuse_unlike(both, first_run.experiment.game, run.experiment.game)
        refuse_unlike(both, first_run.experiment.transforms, run.experiment.transforms, "transforms")
        learned = differing_entries(first_run.transforms_state, run.transforms_state)
        if learned:
            raise ValueError(f"{both}: the learned state of transforms differs: {learned}")


def differing_entries(state: Mapping[str, Any], other_state: Mapping[str, Any]) -> list[str]:
    """Return the names of the entries of a transforms' state that another state lacks or has with another
    value."""
    differing = []
    for name, value in state.items():
        other = other_state.get(name)
        if other is None or not torch.equal(torch.as_tensor(value), torch.as_tensor(other)):
            differing.append(name)
    return differing


def refuse_unlike(names: str, game: Any, other_game: Any, path: str = "") -> None:
    """Raise a ValueError that says where two games, or two lists of transforms, differ.

    Args:
        names: the names of the two runs, e.g. "a and b".
        path: where the differences are; by default the game's class.
    """
    config = to_config(stored_game(game))
    other_config = to_config(stored_game(other_game))
    lines = describe_changes(config, other_config, path or type(game).__name__)
    if lines:
        raise ValueError(
            f"{names} have different games: {'; '.join(lines[:_MOST_DIFFERENCES])}; allowed: the same game"
        )


def as_loaded(run: str | Path | LoadedRun) -> LoadedRun:
    """Return a run as it is, or load it from its directory."""
    return run if isinstance(run, LoadedRun) else load(run)


@working("evaluating")
def evaluate_run(run: str | Path | LoadedRun, fresh: Fresh = Fresh()) -> pa.Table:
    """Let every replica of a stored run play fresh episodes, and the random policy in the same worlds.

    Args:
        run: the directory of the run, its exported results, or a value of `cprl.load`. If the run has not
            ended, the agents of its newest checkpoint play.
        fresh: the number of episodes, their seed, and the replicas that play.

    Returns:
        A table with a row for each policy, replica, episode and agent, see `cprl.measuring.table`. The column
        "policy" says "trained" or "random".
    """
    loaded = as_loaded(run)
    fresh = fresh_for([loaded], fresh)
    policies = {"trained": agents_of(loaded), "random": [scripted_agent("random")] * loaded.game.agents}
    return join_tables(
        (play_fresh(fresh, loaded, agents, {"policy": policy}) for policy, agents in policies.items()),
        heading=heading(loaded.path.name, fresh, [loaded]),
        weights=loaded.weights_from,
    )
