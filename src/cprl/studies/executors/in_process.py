"""Executor: what runs the trials of a study; and InProcess, one after the other in this process."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from cprl.studies.trials import Outcome, Task, run_task


@runtime_checkable
class Executor(Protocol):
    """Runs tasks; an outcome is yielded as soon as a task has ended, in whatever order.

    It stops what it started when its iterator is closed. At the first SIGINT or SIGTERM of the process that
    iterates, every running trial finishes its step and saves a checkpoint, and `KeyboardInterrupt` or
    `SystemExit` with code 143 is raised; the same line again continues.
    """

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Runs every task."""


@dataclass(frozen=True)
class InProcess:
    """One trial after the other, in this process."""

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Runs every task, in order."""
        for task in tasks:
            yield run_task(task)
