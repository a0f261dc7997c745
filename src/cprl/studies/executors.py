"""Executors: they run the trials of a study, in this process or in processes of this machine.

All executors produce the same finished runs in the same directories. So a study may be stopped and continued
with another executor, and what is finished is read from the directories alone. `cprl.experimental` has an
executor for Ray.
"""

import os
import signal
import subprocess
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from typing import Annotated, Final, Protocol

from cprl.runs.checkpoints import interruption
from cprl.studies.trials import ATTEMPTS, Task, TrialOutcome
from cprl.system.output import console
from cprl.system.process import on_signals
from cprl.values import Range, Value

Outcomes = Generator[TrialOutcome, None, None]
"""The outcome of each trial, as soon as it has ended."""
Jobs = Annotated[int, Range(1, 4096)]
"""The number of trials that run at the same time."""
LOOK_S: Final = 0.1
"""Seconds between two checks of a process, and of whether this process was asked to stop."""


class Executor(Protocol):
    """An object that runs trials and yields the outcome of each as soon as it has ended.

    Closing the generator stops the trials that run. At the first SIGINT or SIGTERM, every running trial
    finishes its step and saves a checkpoint; then `KeyboardInterrupt`, or `SystemExit` with code 143, is
    raised.
    """

    def run(self, tasks: Sequence[Task]) -> Outcomes:
        """Run every trial; they begin in order."""


@dataclass(frozen=True)
class InProcess:
    """Runs one trial after the other in this process. It imports and compiles only once, which suits tiny
    trainings."""

    def run(self, tasks: Sequence[Task]) -> Outcomes:
        for task in tasks:
            yield task.run_here()


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Collect the signals that ask this process to stop, and yield the growing list of their numbers.

    The block decides what to do about them.
    """
    numbers: list[int] = []

    def note(number: int) -> None:
        numbers.append(number)
        if len(numbers) == 1:
            console().print(
                "Stopping: each trial finishes its step and saves a checkpoint; signal again to kill them.",
                soft_wrap=True,
            )

    with on_signals(note):
        yield numbers


class SideBySide(ABC):
    """Base of executors that run several trials at the same time, each in a process of its own.

    A trial whose process dies is resumed from its checkpoint, up to `ATTEMPTS` times; other trials go on.
    """

    @abstractmethod
    def places(self) -> int:
        """Return how many trials may run at a time."""

    @abstractmethod
    def exit_code(self, task: Task, stops: Sequence[int]) -> int:
        """Run the process of a trial; ask it to stop when this one is asked, kill it the second time."""

    def ready(self) -> AbstractContextManager[object]:
        """Return the context in which processes are started."""
        return nullcontext()

    def run(self, tasks: Sequence[Task]) -> Outcomes:
        """Run trials side by side; yield each outcome as soon as it is known."""
        waiting: list[Task] = []
        for task in tasks:
            outcome = task.settled()
            if outcome is None:
                waiting.append(task)
            else:
                yield outcome
        if not waiting:
            return
        with self.ready(), stop_signals() as stops, ThreadPoolExecutor(self.places()) as pool:
            try:
                left = 0
                for future in as_completed([pool.submit(self._carry_out, task, stops) for task in waiting]):
                    outcome = future.result()
                    if outcome is None:
                        left += 1
                    else:
                        yield outcome
                if left:
                    trials = "1 trial is" if left == 1 else f"{left} trials are"
                    again = "The same line again continues the study."
                    console().print(f"Stopped; {trials} left. {again}", soft_wrap=True)
                    raise interruption(stops[-1])
            finally:
                if not stops:  # but this generator is closed, or nothing runs
                    stops.append(signal.SIGTERM)

    def _carry_out(self, task: Task, stops: Sequence[int]) -> TrialOutcome | None:
        """Run a trial, in a thread; None if this process was asked to stop."""
        for _ in range(ATTEMPTS):
            outcome = None if stops else task.begin()
            if stops or outcome is not None:
                return outcome
            try:
                code = self.exit_code(task, stops)
            except OSError as error:
                return task.failed(f"{type(error).__name__}: {error}", traceback.format_exc())
            outcome = task.ended(code)
            if outcome is not None:
                return outcome
        return None if stops else task.given_up()


@dataclass(frozen=True)
class Processes(Value, SideBySide, stored=False):
    """Runs each trial in a process of this machine, with one thread of torch.

    The output of a process is added to the trial's log. A process ends if the process of the study dies.

    Args:
        jobs: how many trials run at a time; as many cores and the memory of as many runs.
    """

    jobs: Jobs

    def places(self) -> int:
        return self.jobs

    def exit_code(self, task: Task, stops: Sequence[int]) -> int:
        def is_over() -> bool:
            is_running = process.poll() is None
            time.sleep(LOOK_S * is_running)
            return not is_running

        with start_process(task.arguments, str(task.status.log), task.variables) as process:
            wait_or_stop(is_over, stops, lambda kill: process.kill() if kill else ask_to_stop(process))
            return process.wait()


def wait_or_stop(is_over: Callable[[], object], stops: Sequence[int], stop: Callable[[bool], object]) -> None:
    """Wait until a process is over. When this process is asked to stop, stop it; the second time, kill it."""
    heard = 0
    while not is_over():
        if heard < len(stops):
            heard = len(stops)
            stop(heard > 1)


def start_process(
    arguments: Sequence[str], log: str, variables: Mapping[str, str]
) -> "subprocess.Popen[bytes]":
    """Start the process of a trial, whose output is added to its log."""
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=file,
            env={**os.environ, **variables},
            start_new_session=True,  # Ctrl-C is the business of the process that runs the study
        )


def ask_to_stop(process: "subprocess.Popen[bytes]") -> None:
    """Ask a process that a study started to save a checkpoint and end."""
    assert process.stdin is not None
    with suppress(OSError):  # it has ended
        os.write(process.stdin.fileno(), b"!")
