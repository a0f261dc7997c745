"""evaluate_run: the agents of a stored run beside the random policy in fresh worlds; and whether runs have
the same game."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import torch

from cprl.envs.make_env import stored_game
from cprl.evaluation.lanes import agents_of, fresh_for, play, scripted, together
from cprl.evaluation.pages import heading
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.training.stored import LoadedRun, load
from cprl.values import differences, to_config

MOST_DIFFERENCES: Final = 3
"""Of those in which games differ, in a message."""


def refuse_other_games(runs: Mapping[str, LoadedRun]) -> None:
    """Raise a ValueError where a run, by its name, has another game than the first, or other transforms."""
    first, *others = runs
    for name in others:
        run = runs[first].experiment
        other = runs[name].experiment
        refuse_unlike(f"{first} and {name}", run.game, other.game)
        refuse_unlike(f"{first} and {name}", run.transforms, other.transforms, "transforms")
        learned = differing(runs[first].transforms_state, runs[name].transforms_state)
        if learned:
            raise ValueError(f"{first} and {name}: the learned state of transforms differs: {learned}")


def differing(state: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the entries of what transforms have learned that another has not, or otherwise."""
    return [
        name
        for name, value in state.items()
        if name not in other or not torch.equal(torch.as_tensor(value), torch.as_tensor(other[name]))
    ]


def refuse_unlike(names: str, game: Any, other: Any, what: str = "") -> None:
    """Raise a ValueError that says where two games differ."""
    before, now = (to_config(stored_game(value)) for value in (game, other))
    lines = differences(before, now, what or type(game).__name__)
    if lines:
        raise ValueError(
            f"{names} have different games: {'; '.join(lines[:MOST_DIFFERENCES])}; allowed: the same game"
        )


def opened(run: str | Path | LoadedRun) -> LoadedRun:
    return run if isinstance(run, LoadedRun) else load(run)


@working("evaluating")
def evaluate_run(run: str | Path | LoadedRun, fresh: Fresh = Fresh()) -> pa.Table:
    """Let every replica of a stored run play fresh episodes, and the random policy in the same worlds.

    Args:
        run: its directory, its exported results, or a value of `cprl.load`. For a run that has not ended, the
            newest checkpoint is used.
        fresh: which episodes.

    Returns:
        A row for each policy, replica, episode and agent, see `cprl.measuring.table`, by "policy": "trained"
        or "random".
    """
    loaded = opened(run)
    fresh = fresh_for([loaded], fresh)
    policies = {"trained": agents_of(loaded), "random": [scripted("random")] * loaded.game.agents}
    return together(
        (play(fresh, loaded, agents, {"policy": policy}) for policy, agents in policies.items()),
        heading=heading(loaded.path.name, fresh, [loaded]),
        weights=loaded.weights_from,
    )
