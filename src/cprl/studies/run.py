"""run_study: every trial of a study, wherever an executor runs it."""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Final

from cprl.runs.files import RunLock, holder_of, remove_partial
from cprl.studies.executors import Executor, InProcess
from cprl.studies.progress import Progress
from cprl.studies.status import PATIENCE_S, Status, is_silent
from cprl.studies.study import RUNS, STATUS, Study, directory_of, levels_in, write_study
from cprl.studies.tables.comparing import LAST
from cprl.studies.tables.table import WINDOW, StudyTable
from cprl.studies.trials import Outcome, Task, Trial, move_aside, trials_of
from cprl.system.output import say
from cprl.values import MOST_INT32, Range, checked, refusal

_POLL_S: Final = 1.0
"""Seconds between two looks at whether other processes have ended their trials."""


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
    progress: bool = True,
    results: bool = True,
    last: int = LAST,
    again: str = "",
) -> StudyResult:
    """Runs what a study lacks; may be stopped at any moment, and called again.

    A trial that fails does not end the study. Two processes that run the same study share its trials.
    Another study in the same directory is refused until they end.

    Args:
        out: the study's directory, new or that of an earlier call; by default `studies/<name>`. A study that
            was changed keeps the runs that are there.
        on: where trials are run, see `cprl.studies.executors`; by default in this process.
        runs: the directory of the runs, which several studies may share; by default `runs` in `out`.
        only: the conditions that are run now, by their names or by some of the levels in these, such as
            "gamma=0.9" or "gamma=0.9, freeze_steps=5"; the others stay as they are. By default all are run.
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
    trials = trials_of(study)
    chosen = trials_with(trials, only)
    check_comparison(last)
    driver = Driver(out, folder, on or InProcess(), keep_checkpoints, progress)
    with driver.running(study):
        failed = driver.run(chosen, study.name)
        table = results_of(study, out, folder, last=last, again=again) if results else None
    return StudyResult(study, out, folder, tuple(trials), failed, table)


def trials_with(trials: Sequence[Trial], only: Sequence[str]) -> list[Trial]:
    """The trials of conditions that have one of some names, or its levels; without any, all of them."""
    names = list(dict.fromkeys(trial.condition.name for trial in trials))
    chosen = set()
    for text in only:
        levels = set(levels_in(text))
        matching = {name for name in names if levels <= set(levels_in(name))}
        if not matching:
            raise refusal("only", text, f"a condition or levels of some: {'; '.join(names)}")
        chosen |= matching
    return [trial for trial in trials if not only or trial.condition.name in chosen]


def results_of(study: Study, out: Path, runs: Path, *, last: int, again: str) -> StudyTable | None:
    """Writes table, summary and figures of what has finished, see `write_results`; None if nothing has."""
    if all(trial.state(runs) != "finished" for trial in trials_of(study)):
        return None
    from cprl.studies.results import write_results  # with matplotlib

    return write_results(study, out, runs, last=last, again=again)


def check_comparison(last: int) -> None:
    """Raises a ValueError for episodes that the table of a study does not tell apart."""
    checked("last", last, Annotated[int, Range(WINDOW, MOST_INT32)])


@dataclass(frozen=True)
class Driver:
    """What runs trials of a study.

    Args:
        out: the study's directory.
        runs: that of its runs.
        executor: where trials are run.
        keep_checkpoints: see `run_study`, as the others.
    """

    out: Path
    runs: Path
    executor: Executor
    keep_checkpoints: bool = False
    progress: bool = True

    @contextmanager
    def running(self, study: Study) -> Iterator[None]:
        """Makes the study's directory, and locks it together with all who run the same study.

        Raises:
            RunLockedError: where another study is run there.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        content = json.dumps(study.to_config(self.out), sort_keys=True).encode()
        digest = hashlib.blake2b(content, digest_size=6).hexdigest()
        with RunLock(self.out, study=digest) as lock:
            if lock.is_alone:
                remove_partial(self.out, self.out / STATUS, self.out / "figures")
            elif self.progress:
                say(_others(self.out))
            self.runs.mkdir(parents=True, exist_ok=True)
            write_study(study, self.out)
            yield

    def run(self, trials: Sequence[Trial], title: str) -> tuple[Outcome, ...]:
        """Runs trials, shows how far they are, and returns those that failed.

        Those that another process runs come last: all others first, then it waits for these. Those that were
        made with other code of the user's own are moved aside and run anew.

        Raises:
            RunLockedError: where another process runs such a trial.
        """
        moved = [aside for trial in trials if (aside := move_aside(self.runs / trial.name)) is not None]
        if moved and self.progress:
            places = f"{moved[0]}{f' and {len(moved) - 1} more' if moved[1:] else ''}"
            anew = f"{len(moved)} of {len(trials)} trials are run anew, as the user's own code has changed"
            say(f"{anew}; what was there is kept: {places}")
        tasks = [self._task(trial) for trial in trials]
        for task in tasks:
            task.status.tidy_up()
        progress = Progress(trials, self.runs, self.out / STATUS, title=title, is_shown=self.progress)
        failed = []
        with progress, closing(_outcomes(tasks, self.executor)) as outcomes:
            try:
                for outcome in outcomes:
                    progress.ended(outcome)
                    failed += [outcome] if outcome.state == "failed" else []
            except BaseException as error:
                states = Counter(trial.state(self.runs) for trial in trials)
                error.add_note(
                    f"{states['finished']} of {len(trials)} trials are finished and {states['unfinished']} "
                    f"begun; all of it is kept in {self.runs}, and the same study continues from there"
                )
                raise
        return tuple(failed)

    def _task(self, trial: Trial) -> Task:
        return Task(
            trial=trial,
            runs=self.runs,
            status=Status(self.out / STATUS, trial.name),
            keep_checkpoint=self.keep_checkpoints,
        )


def _outcomes(tasks: Sequence[Task], executor: Executor) -> Generator[Outcome, None, None]:
    """Runs all trials, those that other processes run as soon as these have ended or are silent."""
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
            ready = [task for task in left if not task.is_elsewhere]


def _others(out: Path) -> str:
    """Who runs a study too."""
    return (
        f"{out} is run by somebody else too, {holder_of(out)}, or was when its host went down: each trial is "
        "run by whoever begins it first, the other goes on with the rest"
    )
