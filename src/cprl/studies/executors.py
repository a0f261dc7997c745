"""Executors: where the trials of a study are run. Each calls `cprl.studies.trials.run_task`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from cprl.studies.trials import Outcome, Task, run_task


class Executor(Protocol):
    """Runs tasks; an outcome is yielded as soon as a task has ended, in whatever order.

    It stops what it started when its iterator is closed.
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
