"""Where are studies, which of their trials are finished, and how do their tables name a metric?"""

import sys
from collections.abc import Collection
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType

from cprl.measuring.registry import METRICS
from cprl.runs.files import read_json
from cprl.studies import Study, read_study
from cprl.studies.study import STUDY_FILE
from cprl.studies.trials import Trial, trials_of
from cprl.values import custom_targets, trusting


def module_of(path: Path) -> ModuleType:
    """Return the module in a file, which may import those beside it."""
    if not path.is_file():
        raise ValueError(f"study is {path}; allowed: the file of a study, e.g. changes.py")
    folder = str(path.parent.resolve())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    return import_module(path.stem)


def studies_in(results: Path) -> dict[str, Study | None]:
    """Return the studies whose tables are in a directory, by their name.

    A few are there without their study.json, and are those of recipes/study; None is one of an older version
    of the library, whose game there is no longer.
    """
    studies: dict[str, Study | None] = {}
    for table in sorted(results.glob("*/table.parquet")):
        folder = table.parent
        stored = folder / STUDY_FILE
        if not stored.exists():
            (recipe,) = Path(__file__).parents[1].rglob(f"{folder.name}.py")
            studies[folder.name] = module_of(recipe).STUDY
            continue
        # What it names is code of this repository and of libraries.
        with trusting(custom_targets(read_json(stored))), suppress(ValueError):
            studies[folder.name] = read_study(folder)
        studies.setdefault(folder.name, None)
    return studies


def finished_trials(study: Path, runs: Path) -> list[Trial]:
    """Return the trials of a study whose run has ended.

    Args:
        study: the file of the study, for runs beside which no study.json says how they were made.
        runs: the directory of all runs.
    """
    is_stored = (runs.parent / STUDY_FILE).exists()
    known = read_study(runs.parent) if is_stored else module_of(study).STUDY
    return [trial for trial in trials_of(known, runs) if trial.state() == "finished"]


def name_among(names: Collection[str], metric: str) -> str:
    """Return the name of a metric, or of the one that it equals where no money moves and only that is there:
    the harvest for the income."""
    if metric in names or metric not in METRICS:
        return metric
    same_as = METRICS[metric].same_as
    return metric if same_as is None else same_as
