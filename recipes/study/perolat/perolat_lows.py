"""How far does the harvest fall after its peak? The lowest 30 episodes of each training, beside random play.

    python recipes/study/perolat/perolat_lows.py --out docs/results/studies/perolat_lows.md

To be run in the root of the repository: reads the committed tables of the three studies. An account of
Perolat et al. (2017), which docs/results/details.md names, says that in the tragedy agents get less than half
of what random agents do. The lowest 30 of many episodes lie below their mean, which favours that claim.
"""

from pathlib import Path
from typing import Final

import numpy as np
import perolat_open
import perolat_unequal
import perolat_walls
import pyarrow as pa
import tyro

from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.statistics import estimate
from cprl.measuring.table import where
from cprl.measuring.windows import running_mean
from cprl.studies import StudyTable
from cprl.values.array_types import Float64

STUDIES: Final = tuple(own.STUDY for own in (perolat_open, perolat_walls, perolat_unequal))
RESULTS: Final = Path("docs/results/studies")
EPISODES: Final = 30
HEAD: Final = (
    "condition",
    "peak, apples",
    "lowest after it, apples",
    "as a share of random play",
    "survival then, steps",
)


def values(rows: pa.Table, metric: str, part: str) -> Float64:
    """Return the windows of a part of a condition, [R, windows]."""
    one = where(rows, metric=metric, part=part).sort_by([("replica", "ascending"), ("episode", "ascending")])
    return one["value"].to_numpy().reshape(len(one["replica"].unique()), -1)


def row(rows: pa.Table, windows: int) -> list[str]:
    """Return the cells of a condition after its name.

    Args:
        rows: those of one condition of a study.
        windows: the windows that make `EPISODES`.
    """
    harvest = running_mean(values(rows, "collective_return", "training"), windows)
    survival = running_mean(values(rows, "survival_steps", "training"), windows)
    peak = harvest.argmax(1, keepdims=True)
    before = np.arange(harvest.shape[1]) < peak
    lowest = np.where(before, np.inf, harvest).argmin(1, keepdims=True)
    low = np.take_along_axis(harvest, lowest, 1)[:, 0]
    by_random = values(rows, "collective_return", "random")[:, 0]
    cells = (harvest.max(1), low, low / by_random, np.take_along_axis(survival, lowest, 1)[:, 0])
    return [f"{estimate(cell):.4g}" for cell in cells]


def lows() -> str:
    """Return the conditions that have run, each once, as a Markdown table."""
    lines = [f"| {' | '.join(HEAD)} |", "|---|" + "---:|" * (len(HEAD) - 1)]
    seen = set()
    for study in STUDIES:
        table = StudyTable.read(RESULTS / study.name / "table.parquet")
        for condition in table.rows["condition"].unique().to_pylist():
            rows = where(table.rows, condition=condition)
            checksum = rows["checksum"][0].as_py()
            if checksum not in seen:
                lines.append(f"| {' | '.join([condition, *row(rows, EPISODES // table.window)])} |")
            seen.add(checksum)
    return "\n".join(lines)


def main(*, out: Path | None = None) -> None:
    """Print the table, or write it.

    Args:
        out: a .md to be, which is written over.
    """
    if out is None:
        print(lows())
        return
    out.write_text(lows() + "\n", encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("perolat_lows.py"):
        tyro.cli(main)
