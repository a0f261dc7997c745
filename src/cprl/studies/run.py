"""run_study: run all trials of a study that are not finished, and write the results."""

import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Final

from cprl.runs.checkpoints import endings_of
from cprl.runs.files import RunLock, digest_of, holder_of, remove_partial, write_json
from cprl.runs.states import state_of
from cprl.studies.executors import Executor, InProcess, Outcomes
from cprl.studies.status import PATIENCE_S, Status, is_silent
from cprl.studies.study import RUNS, STATUS, STUDY_FILE, Study, directory_of, levels_in
from cprl.studies.tables.tidy_table import StudyTable, abbreviated
from cprl.studies.trial_progress import Progress
from cprl.studies.trials import (
    FinishedRuns,
    Task,
    Trial,
    TrialOutcome,
    is_of_other_code,
    move_aside,
    trials_of,
)
from cprl.system.defaults import LAST_EPISODES, WINDOW_EPISODES
from cprl.system.output import say
from cprl.values import MOST_INT32, Range, checked, refusal

_POLL_S: Final = 1.0
"""Seconds between two looks at whether other processes have ended their trials."""


@dataclass(frozen=True, eq=False)
class StudyResult:
    """The state of a study after a call of `run_study`."""

    study: Study
    out: Path
    runs: Path
    """The directory of its runs."""
    trials: tuple[Trial, ...] = field(repr=False)
    failed: tuple[TrialOutcome, ...]
    """The trials that failed, with their reasons."""
    table: StudyTable | None = field(repr=False)
    """The table of results; None if nothing has finished, and where no results were asked for."""


def run_study(
    study: Study,
    out: Path | str | None = None,
    *,
    on: Executor | None = None,
    runs: Path | str | None = None,
    only: Sequence[str] | None = None,
    keep_checkpoints: bool = False,
    progress: bool = True,
    results: bool = True,
    last: int = LAST_EPISODES,
    again: str = "",
) -> StudyResult:
    """Run the trials of a study that are not finished yet, and write its results.

    You can stop it at any moment; the next call continues. A trial that fails does not end the study. Two
    processes that run the same study share its trials; meanwhile, another study in the same directory is
    refused.

    Args:
        out: the study's directory, new or of an earlier call; by default `studies/<name>`. A study that
            was changed keeps the runs that are there.
        on: where trials are run, see `cprl.studies.executors`; by default in this process.
        runs: the directory of the runs, which several studies may share; by default `runs` in `out`.
        only: the conditions that are run now, by their names or by some of the levels in these, such as
            "gamma=0.9" or "gamma=0.9, freeze_steps=5"; the others stay as they are. By default all are run;
            of an empty list none.
        keep_checkpoints: whether runs keep the state of their trainings, buffers included, so that the same
            study with more episodes goes on from them, bit for bit.
        progress: whether a table of all trials is shown; lines where the output is not a terminal.
        results: whether `table.parquet`, `summary.md` and `figures/` are written at the end, see
            `cprl.studies.results`.
        last: episodes at the end of the training that these compare, at least 10.
        again: the command line that runs what is lacking, for the summary.

    Raises:
        KeyboardInterrupt: after SIGINT (Ctrl-C), when every trial that runs has saved its state; a note says
            what is kept.
        SystemExit: with code 143 after SIGTERM, likewise.
    """
    out = directory_of(study, out)
    folder = out / RUNS if runs is None else Path(runs)
    trials = trials_of(study, folder)
    finished = FinishedRuns(folder)
    tasks = [
        Task(
            trial=trial,
            status=Status(out / STATUS, trial.name),
            keep_checkpoint=keep_checkpoints,
            finished=finished,
        )
        for trial in trials_with(trials, only)
    ]
    checked("last", last, Annotated[int, Range(WINDOW_EPISODES, MOST_INT32)])
    table = None
    with shared(study, out, progress=progress):
        folder.mkdir(parents=True, exist_ok=True)
        failed = _run(tasks, on or InProcess(), study.name, progress=progress) if tasks else ()
        if results and any(trial.state() == "finished" for trial in trials):
            from cprl.studies.results import write_results  # with matplotlib

            table = write_results(study, out, folder, last=last, again=again)
    return StudyResult(study, out, folder, tuple(trials), failed, table)


def trials_with(trials: Sequence[Trial], only: Sequence[str] | None) -> list[Trial]:
    """Return the trials of the chosen conditions; with None, all trials.

    Args:
        only: names of conditions, or levels that their names contain, e.g. "gamma=0.9".

    Raises:
        ValueError: if no condition has such a name or levels.
    """
    if only is None:
        return list(trials)
    names = list(dict.fromkeys(trial.condition.name for trial in trials))
    chosen = set()
    for text in only:
        levels = set(levels_in(text))
        matching = {text} if text in names else {name for name in names if levels <= set(levels_in(name))}
        if not matching:
            raise refusal("only", text, f"a condition or levels of some: {'; '.join(names)}")
        chosen |= matching
    return [trial for trial in trials if trial.condition.name in chosen]


@contextmanager
def shared(study: Study, out: Path, *, progress: bool) -> Iterator[None]:
    """Create the directory of a study and lock it while the study runs.

    All processes that run the same study hold the lock together; another study is refused.
    """
    out.mkdir(parents=True, exist_ok=True)
    table = study.to_config(out)
    with RunLock(out, study=digest_of(json.dumps(table, sort_keys=True), size=6)) as lock:
        if lock.is_alone:
            remove_partial(out, out / STATUS, out / "figures")
        elif progress:
            say(
                f"{out} is run by somebody else too, {holder_of(out)}, or was when its host went down: each "
                "trial is run by the one that begins it first; the other continues with the rest"
            )
        write_json(out / STUDY_FILE, table)
        yield


def _run(
    tasks: Sequence[Task], executor: Executor, title: str, *, progress: bool
) -> tuple[TrialOutcome, ...]:
    """Run the trials, show their progress, and return those that failed.

    Trials that another process is running come last. Runs that were made with another version of the user's
    own code are moved aside and run anew.
    """
    moved = move_aside([task.directory for task in tasks if is_of_other_code(task.directory)])
    if moved and progress:
        places = abbreviated(list(map(str, moved)), 1)
        anew = f"{len(moved)} of {len(tasks)} trials are run anew, as the user's own code has changed"
        say(f"{anew}; what was there is kept: {places}")
    passed_over = _runs_of_another_engine(tasks)
    if passed_over and progress:
        anew = f"{len(passed_over)} of {len(tasks)} trials begin with their first episode"
        say(
            f'{anew}: engine="auto" stands for another engine now that they are longer than the runs that '
            f"are kept, such as {passed_over[0]}; with the engine of these in the experiment they go on"
        )
    for task in tasks:
        task.status.tidy_up()
    trials = [task.trial for task in tasks]
    failed = []
    with (
        Progress(trials, tasks[0].status.folder, title=title, is_shown=progress) as table,
        closing(_outcomes(tasks, executor)) as outcomes,
    ):
        try:
            for outcome in outcomes:
                table.ended(outcome)
                failed += [outcome] if outcome.state == "failed" else []
        except BaseException as error:
            states = Counter(trial.state() for trial in trials)
            begun = states["begun"] + states["stopped"]
            error.add_note(
                f"{states['finished']} of {len(trials)} trials are finished and {begun} begun; all of it is "
                f"kept in {trials[0].runs}, and the same study continues from there"
            )
            raise
    return tuple(failed)


def _runs_of_another_engine(tasks: Sequence[Task]) -> list[Path]:
    """Return the shorter runs that trials could continue if they had been trained by the same engine."""
    finished = (run for run in tasks[0].trial.runs.glob("*") if state_of(run) == "finished")
    if not any(map(endings_of, finished)):
        return []
    return [run for task in tasks if (run := task.run_of_another_engine()) is not None]


def _outcomes(tasks: Sequence[Task], executor: Executor) -> Outcomes:
    """Run all trials, and yield their outcomes.

    A trial that another process is running is tried again until that process has finished it, or has given no
    sign of life for `PATIENCE_S`; then its lock is taken over.
    """
    silences = {task.name: is_silent(task.status, PATIENCE_S) for task in tasks}
    left = ready = list(tasks)
    while left:
        ended = set()
        with closing(executor.run(ready)) as outcomes:  # which stops what it started
            for outcome in outcomes:
                if outcome.state != "elsewhere":
                    ended.add(outcome.name)
                    yield outcome
        left = [task for task in left if task.name not in ended]
        ready = []
        while left and not ready:
            time.sleep(_POLL_S)
            left = [replace(task, take_over=next(silences[task.name])) for task in left]
            ready = [task for task in left if task.settled() != TrialOutcome(task.name, "elsewhere")]
