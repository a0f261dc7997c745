"""Driver: runs trials of a study, beside whoever else runs it, and shows how far they are."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from cprl.arguments import refusal, switch, texts
from cprl.runs.files import remove_partial
from cprl.runs.lock import FILE_NAME as LOCK
from cprl.runs.lock import StudyLock
from cprl.studies.directory import STATUS, write_study
from cprl.studies.executors import Executor
from cprl.studies.progress import Progress
from cprl.studies.study import Study
from cprl.studies.trials import Outcome, Task, Trial, move_aside, task_of


def check_executor(on: object) -> None:
    """Raises a ValueError for what runs no trials."""
    if on is not None and (isinstance(on, type) or not isinstance(on, Executor)):
        raise refusal("on", on, "InProcess(), Processes(jobs), Ray(), another Executor, or None")


class Driver:
    """What runs trials of a study whose directory is there; made by `as_driver`."""

    def __init__(
        self,
        out: Path,
        runs: Path,
        *,
        allow: Sequence[str],
        progress: bool,
        title: str,
        keep_checkpoints: bool = False,
    ) -> None:
        self._out, self._runs = out, runs
        self._how: dict[str, Any] = {"allow": allow, "keep_checkpoint": keep_checkpoints}
        self._progress, self._title = progress, title
        self.others = ""
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
        moved = [aside for trial in trials if (aside := move_aside(self._runs / trial.name)) is not None]
        shown = Progress(
            trials,
            runs=self._runs,
            status=self._out / STATUS,
            title=title or self._title,
            is_shown=self._progress,
        )
        if self.others:
            shown.say(self.others)
        if moved:
            kept = f"{moved[0]}{f' and {len(moved) - 1} more' if moved[1:] else ''}"
            anew = f"{len(moved)} of {len(trials)} trials are run anew, as the user's own code has changed"
            shown.say(f"{anew}; what was there is kept: {kept}")
        tasks = tasks_of(trials, runs=self._runs, status=self._out / STATUS, **self._how)
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
                error.add_note(_kept(trials, self._runs))
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
        ValueError: for whatever does not fit, before anything is written; `RunLockedError` where another
            study is run there.
    """
    switch("progress", progress)
    texts("allow", allow)
    tasks_of(trials, runs=runs, status=out / STATUS, allow=allow)
    driver = Driver(
        out, runs, allow=allow, progress=progress, title=study.name, keep_checkpoints=keep_checkpoints
    )
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


def tasks_of(trials: Sequence[Trial], *, runs: Path, status: Path, **how: Any) -> list[Task]:
    """The task of each trial; for other arguments see `task_of`."""
    return [task_of(trial, runs=runs, status=status, **how) for trial in trials]


def _others(out: Path) -> str:
    """Who runs a study too."""
    holder = {}
    with suppress(OSError, ValueError):
        holder = json.loads((out / LOCK).read_bytes())
    who = f", process {holder['pid']} on {holder.get('host')}" if "pid" in holder else ""
    return (
        f"{out} is run by somebody else too{who}, or was when its host went down: each trial is run by "
        "whoever begins it first, the other goes on with the rest"
    )


def _kept(trials: Sequence[Trial], runs: Path) -> str:
    states = [trial.state(runs) for trial in trials]
    return (
        f"{states.count('finished')} of {len(trials)} trials are finished and {states.count('unfinished')} "
        f"begun; all of it is kept in {runs}, and the same study continues from there"
    )
