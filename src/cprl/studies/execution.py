"""run_study: every trial of a study, wherever an executor runs it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cprl.arguments import object_of, path, texts
from cprl.runs.files import read_json, write_json
from cprl.studies.executors import Executor, InProcess
from cprl.studies.study import Study
from cprl.studies.trials import Outcome, Trial, task_of, trials_of

FILE_NAME: Final = "study.json"
RUNS, STATUS = "runs", "status"
"""Folders of a study's directory."""


@dataclass(frozen=True, eq=False)
class StudyResult:
    """What a study has produced so far."""

    study: Study
    out: Path
    runs: Path
    """The directory of its runs."""
    trials: tuple[Trial, ...]
    failed: tuple[Outcome, ...]
    """The trials that failed, with their reasons."""


def run_study(
    study: Study,
    out: Path | str | None = None,
    *,
    on: Executor | None = None,
    runs: Path | str | None = None,
    allow: Sequence[str] = (),
) -> StudyResult:
    """Runs what a study lacks; may be stopped at any moment, and called again.

    Args:
        study: what is run.
        out: the study's directory, new or that of an earlier call; by default `studies/<name>`. A study that
            was changed keeps the runs that are there.
        on: where trials are run, see `cprl.studies.executors`; by default in this process.
        runs: the directory of the runs, which several studies may share; by default `runs` in `out`.
        allow: the user's own code, "module:Class", that stored runs of `Frozen` agents may import.

    Raises:
        ValueError: for whatever does not fit, before anything is written.
    """
    object_of("study", study, Study, "a Study")
    out = Path("studies") / study.name if out is None else path("out", out)
    folder = out / RUNS if runs is None else path("runs", runs)
    texts("allow", allow)
    trials = trials_of(study)
    tasks = [task_of(trial, runs=folder, status=out / STATUS, allow=allow) for trial in trials]
    folder.mkdir(parents=True, exist_ok=True)
    out.mkdir(parents=True, exist_ok=True)
    write_study(study, out)
    outcomes = list((on or InProcess()).run(tasks))
    failed = tuple(own for own in outcomes if own.state == "failed")
    return StudyResult(study, out, folder, tuple(trials), failed)


def write_study(study: Study, out: Path) -> None:
    """Writes what a study is into its directory."""
    write_json(out / FILE_NAME, study.to_config(out))


def read_study(out: Path, *, allow: Sequence[str] = ()) -> Study:
    """The study of a directory; raises a ValueError where there is none."""
    try:
        table = read_json(out / FILE_NAME)
    except (OSError, ValueError) as error:
        raise ValueError(f"{out / FILE_NAME} is not the file of a study: {error!r}") from error
    return Study.from_config(table, allow=allow, directory=out)
