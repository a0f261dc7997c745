"""run_study: every trial of a study, wherever an executor runs it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cprl.arguments import integer, object_of, path, refusal, switch, texts
from cprl.studies.directory import RUNS, directory_of
from cprl.studies.driver import as_driver, check_executor
from cprl.studies.executors import Executor, InProcess
from cprl.studies.naming import levels_in
from cprl.studies.study import Study
from cprl.studies.tables.comparing import LAST
from cprl.studies.tables.table import WINDOW, StudyTable
from cprl.studies.trials import Outcome, Trial, trials_of


@dataclass(frozen=True, eq=False)
class StudyResult:
    """What a study has produced so far."""

    study: Study
    out: Path
    runs: Path
    """The directory of its runs."""
    trials: tuple[Trial, ...] = field(repr=False)
    failed: tuple[Outcome, ...]
    """The trials that failed, with their reasons."""
    table: StudyTable | None = field(repr=False)
    """What came out; None if nothing has finished, and where no results were asked for."""


def run_study(
    study: Study,
    out: Path | str | None = None,
    *,
    on: Executor | None = None,
    runs: Path | str | None = None,
    only: Sequence[str] = (),
    keep_checkpoints: bool = False,
    allow: Sequence[str] = (),
    progress: bool = True,
    results: bool = True,
    last: int = LAST,
    again: str = "",
) -> StudyResult:
    """Runs what a study lacks; may be stopped at any moment, and called again.

    A trial that fails does not end the study. Two processes that run the same study share its trials.
    Another study in the same directory is refused until they end.

    Args:
        study: what is run.
        out: the study's directory, new or that of an earlier call; by default `studies/<name>`. A study that
            was changed keeps the runs that are there.
        on: where trials are run, see `cprl.studies.executors`; by default in this process.
        runs: the directory of the runs, which several studies may share; by default `runs` in `out`.
        only: the conditions that are run now, by their names or by some of the levels in these, such as
            "gamma=0.9" or "gamma=0.9, freeze_steps=5"; the others stay as they are. By default all are run.
        keep_checkpoints: whether runs keep the state of their trainings, buffers included, so that the same
            study with more episodes goes on from them, bit for bit.
        allow: the user's own code, "module:Class", that stored runs of `Frozen` agents may import.
        progress: whether a table of all trials is shown; lines where the output is not a terminal.
        results: whether `table.parquet`, `summary.md` and `figures/` are written at the end, see
            `cprl.studies.results`.
        last: episodes at the end of the training that these compare, at least 10.
        again: the command line that runs what is lacking, for the summary.

    Raises:
        ValueError: for whatever does not fit, before anything is written.
        KeyboardInterrupt: after SIGINT (Ctrl-C), when every trial that runs has saved its state; a note says
            what is kept.
        SystemExit: with code 143 after SIGTERM, likewise.
    """
    object_of("study", study, Study, "a Study")
    out = directory_of(study, out)
    folder = out / RUNS if runs is None else path("runs", runs)
    trials = trials_of(study)
    chosen = trials_with(trials, only)
    check_executor(on)
    switch("results", results)
    switch("keep_checkpoints", keep_checkpoints)
    check_comparison(last)
    with as_driver(
        study,
        trials,
        out,
        folder,
        allow=allow,
        keep_checkpoints=keep_checkpoints,
        progress=progress,
    ) as driver:
        failed = driver.run(chosen, on or InProcess())
        how: Any = {"last": last, "again": again}
        table = results_of(study, trials, out, folder, **how) if results else None
    return StudyResult(study, out, folder, tuple(trials), failed, table)


def trials_with(trials: Sequence[Trial], only: Sequence[str]) -> list[Trial]:
    """The trials of conditions that have one of some names, or its levels; without any, all of them.

    Raises:
        ValueError: for what is in no name; says which names there are.
    """
    wanted = [set(levels_in(levels)) for levels in texts("only", only)]
    names = list(dict.fromkeys(trial.condition.name for trial in trials))
    for levels, text in zip(wanted, only, strict=True):
        if not any(levels <= set(levels_in(name)) for name in names):
            raise refusal("only", text, f"a condition or levels of some: {'; '.join(names)}")
    if not wanted:
        return [*trials]
    return [
        trial for trial in trials if any(levels <= set(levels_in(trial.condition.name)) for levels in wanted)
    ]


def results_of(study: Study, trials: Sequence[Trial], out: Path, runs: Path, **how: Any) -> StudyTable | None:
    """Writes table, summary and figures of what has finished, see `write_results`; None if nothing has."""
    if all(trial.state(runs) != "finished" for trial in trials):
        return None
    from cprl.studies.results import write_results  # with matplotlib

    return write_results(study, out, runs, **how)


def check_comparison(last: int) -> None:
    """Raises a ValueError for episodes that the table of a study does not tell apart."""
    integer("last", last, WINDOW, allowed=f"an integer >= {WINDOW}, the episodes of a window of the table")
