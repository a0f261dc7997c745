"""After a rule or a board has changed, how fast do incomes reach a control's, and what is lost until then?

    python recipes/study/governs/recovery.py --study recipes/study/governs/order.py

To be run in the root of the repository: reads courses.parquet of the study in docs/results/studies, and of
those that it compares with, and writes recovery.md beside it. Each expectation of the study is a pair of
courses over the last 400,000 steps of both, as agents learn; replicas are paired by their seeds.

A replica is back when the mean difference of incomes over the next 50,000 steps is within the margin of
asking.py for the first time. The area between two courses is given as their mean difference.
"""

from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from asking import MARGIN, RESULTS, STEPS, Expectation
from courses import BLOCK_STEPS
from finished import module_of
from page import table

from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.registry import INCOME, INCOME_EQUALITY
from cprl.measuring.statistics import estimate
from cprl.measuring.table import where
from cprl.values.array_types import Float64

AVERAGED_BLOCKS: Final = 5
HEAD: Final = (
    "difference",
    "replicas back",
    "steps until back",
    "mean difference of incomes, apples",
    "mean difference of equality of incomes",
)


@cache
def courses(study: str) -> pa.Table:
    """Return the courses of a study."""
    return pq.read_table(RESULTS / study / "courses.parquet")


def course(study: str, condition: str, metric: str) -> Float64:
    """Return the last `STEPS` steps of a condition, [R, blocks]; NaN where no episode ended.

    Args:
        condition: its name, or "STUDY/CONDITION" of another study.
    """
    *other, name = condition.split("/")
    rows = where(courses(other[0] if other else study), condition=name, metric=metric)
    rows = rows.sort_by([("replica", "ascending"), ("step", "ascending")])
    values = rows["value"].to_numpy().astype(np.float64)
    replicas = len(rows["replica"].unique())
    return values.reshape(replicas, -1)[:, -STEPS // BLOCK_STEPS :]


def first_back(differences: Float64) -> float:
    """Return the steps after which a replica is back for the first time; NaN for never.

    Args:
        differences: float [blocks], of incomes.
    """
    averaged = np.lib.stride_tricks.sliding_window_view(differences, AVERAGED_BLOCKS)
    is_back = np.abs(np.nanmean(averaged, axis=-1)) <= MARGIN
    return float(is_back.argmax() * BLOCK_STEPS) if is_back.any() else np.nan


def recovery_row(study: str, expectation: Expectation) -> list[str]:
    """Return the cells of an expectation."""
    (more,), (less,) = expectation.more, expectation.less
    incomes = course(study, more, INCOME) - course(study, less, INCOME)
    equalities = course(study, more, INCOME_EQUALITY) - course(study, less, INCOME_EQUALITY)
    steps = np.array([first_back(replica) for replica in incomes])
    back = steps[~np.isnan(steps)]
    return [
        expectation.label,
        f"{len(back)} of {len(steps)}",
        f"{np.median(back):,.0f}" if len(back) else "",
        f"{estimate(np.nanmean(incomes, axis=-1)):+}",
        f"{estimate(np.nanmean(equalities, axis=-1)):+}",
    ]


def recovery_page(study: Path) -> str:
    """Return the page of all pairs of a study, in Markdown.

    Args:
        study: the file of the study.
    """
    module = module_of(study)
    name = module.STUDY.name
    rows = [recovery_row(name, expectation) for expectation in module.EXPECTATIONS]
    lines = [
        f"# {name}: how fast incomes are back",
        "",
        f"While agents learn, in the last {STEPS:,} steps; intervals are 95 % by Student's t over replicas, "
        f"steps the median of those that came within {MARGIN:g} apples. `recovery.py` says how.",
        "",
        *table(HEAD, rows, numbers=4),
    ]
    return "\n".join(lines)


def main(*, study: Path) -> None:
    """Write the recovery of all pairs.

    Args:
        study: the file of the study.
    """
    (RESULTS / study.stem / "recovery.md").write_text(recovery_page(study), encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("recovery.py"):
        tyro.cli(main)
