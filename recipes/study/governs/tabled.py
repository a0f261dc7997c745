"""Which table of a finished study is committed? Windows of two episodes of each world, without the runs.

    python recipes/study/governs/tabled.py --study recipes/study/governs/shocks.py --every 4
    python docs/pack_results.py docs/results/studies/shocks

To be run in the root of the repository, where `studies` has the finished runs: writes table.parquet,
summary.md and study.json of the study in docs/results/studies. With `--every 4` every fourth window of a
training stays, and the last one of each replica, from which "while learning" is taken; courses.py has the
whole course.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import tyro
from asking import RESULTS
from finished import module_of
from judging import LAST

from cprl.commands.recipe_command import exit_with_message
from cprl.runs.files import write_json
from cprl.studies.results import write_summary
from cprl.studies.study import STUDY_FILE
from cprl.studies.tables.sources import study_table
from cprl.studies.tables.tidy_table import TRAINING_PART, StudyTable

ROW: Final = "row"


def thinned(table: StudyTable, every: int) -> StudyTable:
    """Return a table with each window of a training whose number is a multiple of `every`, and with the last
    one of each replica."""
    numbers = np.arange(len(table.rows))
    numbered = replace(table, rows=table.rows.append_column(ROW, pa.array(numbers)))
    is_last = np.isin(numbers, numbered.windows()[ROW].to_numpy())
    is_other_part = table.rows["part"].to_numpy(zero_copy_only=False) != TRAINING_PART
    is_every = table.rows["episode"].to_numpy() // table.window % every == 0
    return replace(table, rows=table.rows.filter(pa.array(is_last | is_other_part | is_every)))


def main(study: Path, every: int = 1) -> None:
    """Write the committed table of a finished study, with its summary.

    Args:
        study: the file of the study.
        every: of how many windows of a training one stays.
    """
    asked = module_of(study).STUDY
    out = RESULTS / asked.name
    out.mkdir(parents=True, exist_ok=True)
    whole = study_table(asked, Path("studies", asked.name, "runs"), window=LAST)
    table = thinned(replace(whole, last=LAST), every)
    table.write(out / "table.parquet")
    write_summary(table, out, again=f"python {study.as_posix()} --jobs 2")
    write_json(out / STUDY_FILE, asked.to_config(out))


if __name__ == "__main__":
    with exit_with_message("tabled.py"):
        tyro.cli(main)
