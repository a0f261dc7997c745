"""Attempts: a trial in a worker that may die, and what is said of one whose workers always die."""

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Final

from cprl.studies.status import Status
from cprl.studies.trials import Outcome, Task

ATTEMPTS: Final = 5
"""How often a trial is tried whose worker dies."""

Work = Callable[[Task], Outcome]
"""`cprl.studies.trials.run_task`, or a function of tests that calls it; importable by name."""


def attempt(work: Work, task: Task) -> Outcome | None:
    """Runs a task in a worker; None if the worker was asked to stop, and has saved a checkpoint.

    What `run_task` does not catch, e.g. that its log cannot be written, is a failure of this trial, not of
    the study.
    """
    try:
        return work(task)
    except (SystemExit, KeyboardInterrupt):
        return None
    except Exception as error:
        return failed(task, f"{type(error).__name__}: {error}", traceback.format_exc())


def given_up(task: Task, why: str) -> Outcome:
    """The outcome of a task whose workers died at every attempt."""
    reason = f"{why}, {ATTEMPTS} times; a process that is killed is often one for which memory was short"
    return failed(task, reason, f"What it printed is in {task.name}.log.")


def failed(task: Task, reason: str, trace: str) -> Outcome:
    """The outcome of a task that could not say itself why it failed; noted beside its status."""
    status = Status(Path(task.status), task.name)
    try:
        status.folder.mkdir(parents=True, exist_ok=True)
        status.fail(reason, trace)
    except OSError as error:  # then the reason is in the outcome alone
        reason += f" ({error})"
    return Outcome(task.name, "failed", reason, True)
