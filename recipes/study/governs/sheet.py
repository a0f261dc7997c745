"""What was trained in all studies, how long, how, and what could their boards have given? One sheet.

    python recipes/study/governs/bounds.py
    python recipes/study/governs/sheet.py

To be run in the root of the repository: reads the studies in docs/results/studies and bounds.csv, and writes
docs/results/governs/sheet.md, a row for each condition. Numbers are of each replica, from the smallest to the
largest where they differ. "At most" and "best known" are apples of all agents together in an episode, see
bounds.py.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import tyro
from asking import RESULTS
from bounds import BOUNDS, Bound, bound_of, read_bounds
from finished import studies_in
from page import table
from schedules import Range, exploration_at_end, range_text, target_period, updates

from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.table import WINDOWS, where
from cprl.studies.study import Condition
from cprl.studies.tables.tidy_table import TRAINING_PART, StudyTable

SHEET: Final = BOUNDS.with_name("sheet.md")
COLUMNS: Final = (
    *("study", "condition", "steps", "exploration at the end", "updates of each agent"),
    *("target period, updates", "worlds", "replicas", "at most, apples", "best known, apples"),
)
NOT_RUN: Final = "not run"
GONE: Final = "of a version that is gone"


def lengths(studied: StudyTable, condition: str) -> tuple[Range, Range]:
    """Return the smallest and the largest number of steps and of episodes of the replicas of a condition;
    where the runs did not report their steps, those of the episodes in the table."""
    rows = where(studied.rows, condition=condition, part=TRAINING_PART, metric="survival_steps")
    replica = rows["replica"].to_numpy()
    counts = rows[WINDOWS].to_numpy()
    turns = counts * rows["value"].to_numpy()
    episodes = np.bincount(replica, counts)
    ended = np.rint(np.bincount(replica, turns)).astype(int)
    played = np.flatnonzero(episodes)
    least, most = int(ended[played].min()), int(ended[played].max())
    if condition in studied.lengths:
        least, most = studied.lengths[condition]["steps"]
    return (least, most), (int(episodes[played].min()), int(episodes[played].max()))


def cells(study: str, condition: Condition, studied: StudyTable, bounds: Mapping[str, Bound]) -> list[str]:
    """Return the row of a condition."""
    experiment = condition.experiment
    replicas = studied.replicas[condition.name]
    bound = bound_of(experiment.game, bounds)
    schedule = [NOT_RUN] * 4
    if replicas:
        steps, episodes = lengths(studied, condition.name)
        schedule = [
            range_text(steps),
            exploration_at_end(experiment, steps),
            updates(experiment, steps),
            target_period(experiment, steps, episodes),
        ]
    boards = ["not computed"] * 2
    if bound is not None:
        boards = [f"{bound.at_most:,.0f} ({bound.limit})", f"{bound.best_known:,.0f} ({bound.best})"]
    return [study, condition.name, *schedule, str(experiment.worlds), str(replicas), *boards]


def sheet(results: Path, bounds: Mapping[str, Bound]) -> list[list[str]]:
    """Return the rows of all conditions of the studies in a directory."""
    rows = []
    for name, study in studies_in(results).items():
        studied = StudyTable.read(results / name / "table.parquet")
        if study is None:
            rows += [_cells_of_table(name, condition, studied) for condition in studied.design.conditions]
        else:
            rows += [cells(name, condition, studied, bounds) for condition in study.all_conditions]
    return rows


def _cells_of_table(study: str, condition: str, studied: StudyTable) -> list[str]:
    """Return the row of a condition of which there is the table alone."""
    replicas = studied.replicas[condition]
    steps = range_text(lengths(studied, condition)[0]) if replicas else NOT_RUN
    return [study, condition, steps, *[GONE] * 4, str(replicas), *[GONE] * 2]


def main(*, results: Path = RESULTS, out: Path = SHEET) -> None:
    """Write the sheet.

    Args:
        results: the directory of the results of all studies.
        out: the file.
    """
    lines = [
        "By `python recipes/study/governs/sheet.py`, which says what the columns mean.",
        "",
        *table(COLUMNS, sheet(results, read_bounds())),
    ]
    out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("sheet.py"):
        tyro.cli(main)
