"""How does a training go, by steps rather than by episodes, whose lengths differ between conditions?

    python recipes/study/governs/courses.py --study recipes/study/governs/changes.py \
        --runs studies/changes/runs --out docs/results/studies/changes/courses.parquet

An episode belongs to the block of 10,000 steps of its replica in which it ends; the turn t of W worlds is
W t steps. Episodes that are cut where the game of a training changes are in no block. Columns: condition,
replica, step (the last of the block), metric, episodes (that ended in it, and in which the metric is
defined), value (their mean; null where there are none, as in a block in which all worlds are between two
ends).
"""

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import tyro
from finished import finished_trials, name_among

from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY
from cprl.measuring.table import complete, where
from cprl.runs.episodes import read_episodes, write_table
from cprl.studies.trials import Trial
from cprl.values.array_types import Int64

BLOCK_STEPS: Final = 10_000
MEASURED: Final = (INCOME, COLLECTIVE_RETURN, INCOME_EQUALITY, "survival_steps")
SCHEMA: Final = pa.schema(
    {
        "condition": pa.string(),
        "replica": pa.int32(),
        "step": pa.int32(),
        "metric": pa.string(),
        "episodes": pa.int32(),
        "value": pa.float32(),
    }
)


def end_steps(episodes: pa.Table, worlds: int, change: int | None = None) -> Int64:
    """Return the step of its replica in which each episode ends, counted from 1, [E].

    Args:
        episodes: a row for each of all replicas, in the order in which they ended.
        worlds: the worlds W of a replica, each of which plays a turn in W steps.
        change: the step after which another game begins; running episodes are cut there, and in no row.
    """
    world = episodes["world"].to_numpy()
    turns = episodes["steps"].to_numpy().astype(np.int64)
    ends = end_turns(world, turns)
    if change is not None:
        ends = _changed_ends(world, turns, ends, -(-change // worlds))
    return ends * worlds


def end_turns(world: Int64, turns: Int64) -> Int64:
    """Return the turn in which each episode ends, by the turns of all of its world up to there, [E]."""
    order = np.argsort(world, kind="stable")
    played = turns[order].cumsum()
    first = np.flatnonzero(np.diff(world[order], prepend=-1))
    before = np.concatenate([[0], played[first[1:] - 1]])
    ends = np.empty(len(world), np.int64)
    ends[order] = played - np.repeat(before, np.diff(np.append(first, len(world))))
    return ends


def _changed_ends(world: Int64, turns: Int64, ends: Int64, change: int) -> Int64:
    """Return the ends of episodes of two games, of which the second begins after a turn.

    No row says of which game it is, but rows are in the order of their ends: the first row of the second game
    is the one with which they are.

    Args:
        ends: `end_turns` of all rows, right for those of the first game.
    """
    late = np.flatnonzero(ends > change)
    for first in range(late[0] if len(late) else len(ends), -1, -1):
        both = np.concatenate([ends[:first], change + end_turns(world[first:], turns[first:])])
        if (np.diff(both) >= 0).all():
            return both
    raise ValueError(f"no row of the episodes can be the first after turn {change:,}: are they in order?")


def course(trial: Trial) -> pa.Table:
    """Return the rows of a trial, for each replica, block and metric."""
    experiment = trial.experiment
    changes = [earlier.steps for earlier in experiment.earlier]
    if len(changes) > 1:
        raise ValueError(f"{trial.label} has {len(changes)} earlier games; allowed: one")
    episodes = where(complete(read_episodes(trial.directory)), agent=0)
    blocks = -(-end_steps(episodes, experiment.worlds, *changes) // BLOCK_STEPS)
    count = -(-(experiment.steps or blocks.max() * BLOCK_STEPS) // BLOCK_STEPS)
    replica = episodes["replica"].to_numpy()
    cell = replica * count + blocks - 1
    cells = experiment.replicas * count
    parts = []
    for metric in MEASURED:
        values = episodes[name_among(episodes.column_names, metric)].to_numpy()
        defined = ~np.isnan(values)
        ended = np.bincount(cell[defined], minlength=cells)
        with np.errstate(invalid="ignore"):
            means = np.bincount(cell[defined], values[defined], minlength=cells) / ended
        columns = {
            "condition": [trial.condition.name] * cells,
            "replica": trial.block.first + np.repeat(np.arange(experiment.replicas), count),
            "step": np.tile(np.arange(1, count + 1) * BLOCK_STEPS, experiment.replicas),
            "metric": [metric] * cells,
            "episodes": ended,
            "value": pa.array(means, from_pandas=True),
        }
        parts.append(pa.table(columns).cast(SCHEMA))
    return pa.concat_tables(parts)


def main(*, study: Path, runs: Path, out: Path) -> None:
    """Write the courses of all finished trials.

    Args:
        study: the file of the study.
        runs: the directory of its runs.
        out: the file.
    """
    courses = [course(trial) for trial in finished_trials(study, runs)]
    write_table(out, pa.concat_tables([SCHEMA.empty_table(), *courses]), over=True)


if __name__ == "__main__":
    with exit_with_message("courses.py"):
        tyro.cli(main)
