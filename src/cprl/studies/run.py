"""run_study: every trial of a study, wherever an executor runs it."""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cprl.arguments import integer, refusal
from cprl.runs.files import LOCK_FILE, StudyLock, remove_partial
from cprl.studies.executors import Executor, InProcess
from cprl.studies.progress import Progress
from cprl.studies.study import RUNS, STATUS, Study, directory_of, levels_in, write_study
from cprl.studies.tables.comparing import LAST
from cprl.studies.tables.table import WINDOW, StudyTable
from cprl.studies.trials import Outcome, Task, Trial, move_aside, task_of, trials_of


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
        KeyboardInterrupt: after SIGINT (Ctrl-C), when every trial that runs has saved its state; a note says
            what is kept.
        SystemExit: with code 143 after SIGTERM, likewise.
    """
    out = directory_of(study, out)
    folder = out / RUNS if runs is None else Path(runs)
    trials = trials_of(study)
    chosen = trials_with(trials, only)
    check_executor(on)
    check_comparison(last)
    with as_driver(
        study, trials, out, folder, allow=allow, keep_checkpoints=keep_checkpoints, progress=progress
    ) as driver:
        failed = driver.run(chosen, on or InProcess())
        how: Any = {"last": last, "again": again}
        table = results_of(study, trials, out, folder, **how) if results else None
    return StudyResult(study, out, folder, tuple(trials), failed, table)


def trials_with(trials: Sequence[Trial], only: Sequence[str]) -> list[Trial]:
    """The trials of conditions that have one of some names, or its levels; without any, all of them."""
    wanted = [set(levels_in(levels)) for levels in only]
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


def check_executor(on: object) -> None:
    """Raises a ValueError for what runs no trials."""
    if on is not None and (isinstance(on, type) or not isinstance(on, Executor)):
        raise refusal("on", on, "InProcess(), Processes(jobs), Ray(), another Executor, or None")


@dataclass(kw_only=True)
class Driver:
    """What runs trials of a study whose directory is there; made by `as_driver`."""

    status: Path
    runs: Path
    title: str
    progress: bool
    how: Mapping[str, Any]
    """Of the tasks, see `task_of`."""
    others: str = ""
    """Who runs the study too, in a sentence."""

    def run(
        self, trials: Sequence[Trial], executor: Executor, *, title: str | None = None
    ) -> tuple[Outcome, ...]:
        """Runs trials, shows how far they are, and returns those that failed.

        Those that another process runs come last: all others first, then it waits for these. Those that were
        made with other code of the user's own are moved aside and run anew.

        Raises:
            RunLockedError: where another process runs such a trial.
        """
        failed: list[Outcome] = []
        moved = [aside for trial in trials if (aside := move_aside(self.runs / trial.name)) is not None]
        shown = Progress(
            trials, runs=self.runs, status=self.status, title=title or self.title, is_shown=self.progress
        )
        if self.others:
            shown.say(self.others)
        if moved:
            kept = f"{moved[0]}{f' and {len(moved) - 1} more' if moved[1:] else ''}"
            anew = f"{len(moved)} of {len(trials)} trials are run anew, as the user's own code has changed"
            shown.say(f"{anew}; what was there is kept: {kept}")
        tasks = [task_of(trial, runs=self.runs, status=self.status, **self.how) for trial in trials]
        with shown:
            try:
                for waits in (False, True):
                    ended = _round(executor, [replace(task, waits=waits) for task in tasks], shown)
                    failed += [outcome for outcome in ended if outcome.state == "failed"]
                    elsewhere = {outcome.name for outcome in ended if outcome.state == "elsewhere"}
                    if not elsewhere:
                        break
                    tasks = [task for task in tasks if task.name in elsewhere]
            except BaseException as error:
                states = Counter(trial.state(self.runs) for trial in trials)
                error.add_note(
                    f"{states['finished']} of {len(trials)} trials are finished and {states['unfinished']} "
                    f"begun; all of it is kept in {self.runs}, and the same study continues from there"
                )
                raise
        return tuple(failed)


def _round(executor: Executor, tasks: Sequence[Task], shown: Progress) -> list[Outcome]:
    """Runs tasks once, and shows how those ended that are not run elsewhere."""
    ended = []
    outcomes = executor.run(tasks)
    with ExitStack() as stack:
        stack.callback(getattr(outcomes, "close", lambda: None))  # stops what it started
        for outcome in outcomes:
            if outcome.state != "elsewhere":
                shown.ended(outcome)
            ended.append(outcome)
    return ended


@contextmanager
def as_driver(
    study: Study,
    trials: Sequence[Trial],
    out: Path,
    runs: Path,
    *,
    allow: Sequence[str],
    progress: bool,
    keep_checkpoints: bool = False,
) -> Iterator[Driver]:
    """Checks all that is asked for, then makes a study's directory, and locks it with all who run the same
    study.

    Raises:
        RunLockedError: where another study is run there.
    """
    how = {"allow": allow, "keep_checkpoint": keep_checkpoints}
    driver = Driver(status=out / STATUS, runs=runs, title=study.name, progress=progress, how=how)
    for trial in trials:
        task_of(trial, runs=runs, status=driver.status, allow=allow)
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        content = json.dumps(study.to_config(out), sort_keys=True).encode()
        lock = stack.enter_context(StudyLock(out, hashlib.blake2b(content, digest_size=6).hexdigest()))
        if lock.is_alone:
            remove_partial(out, out / STATUS, out / "figures")
        else:
            driver.others = _others(out)
        runs.mkdir(parents=True, exist_ok=True)
        write_study(study, out)
        yield driver


def _others(out: Path) -> str:
    """Who runs a study too."""
    holder = {}
    with suppress(OSError, ValueError):
        holder = json.loads((out / LOCK_FILE).read_bytes())
    who = f", process {holder['pid']} on {holder.get('host')}" if "pid" in holder else ""
    return (
        f"{out} is run by somebody else too{who}, or was when its host went down: each trial is run by "
        "whoever begins it first, the other goes on with the rest"
    )
