"""Processes: kept worker processes on this machine, each of which runs one trial after the other."""

import multiprocessing
import os
import signal
import sys
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType, ModuleType
from typing import Any, ClassVar, Final, NoReturn, Protocol, Self, runtime_checkable

from cprl.arguments import integer
from cprl.runs.checkpoints import interruption
from cprl.studies.trials import Outcome, Status, Task, run_task
from cprl.system.output import console

MOST_JOBS: Final = 4096
_LOOK_S: Final = 0.2
"""Seconds between two looks at whether this process was asked to stop."""
_SPAWN: Final = multiprocessing.get_context("spawn")


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


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class Stopping:
    """Counts how often this process was asked to stop; a context manager.

    The handlers only count: what is done about it is up to the loop that looks at `asked`. Python handles
    signals in the main thread only; in other threads handlers stay as they are.
    """

    def __init__(self) -> None:
        self.asked = 0
        self._number: int = signal.SIGINT
        self._usual: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in _SIGNALS if current_thread() is main_thread() else ():
            self._usual[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        for number, usual in self._usual.items() if current_thread() is main_thread() else ():
            signal.signal(number, usual)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked += 1
        self._number = number
        if self.asked == 1:
            console().print(
                "Stopping: each trial finishes its step and saves a checkpoint; signal again to kill them.",
                soft_wrap=True,
            )

    def end(self, left: int) -> NoReturn:
        """Say how many trials are left, and raise what `interruption` makes of the signal."""
        trials = "1 trial is" if left == 1 else f"{left} trials are"
        console().print(f"Stopped; {trials} left. The same line again continues the study.", soft_wrap=True)
        raise interruption(self._number)


@dataclass(frozen=True)
class Processes:
    """Worker processes on this machine, each with one thread of torch, that are kept from trial to trial.

    They are spawned, never forked, and import nothing of the user's script. One that is killed is replaced,
    and its trial resumed from its checkpoint, up to `ATTEMPTS` times; the others are not disturbed. If the
    process that runs the study is killed, however, its workers end at once.

    Args:
        jobs: how many trials run at a time, 1 to 4,096; as many cores and the memory of as many runs.
    """

    jobs: int
    work: ClassVar[Work] = staticmethod(run_task)
    """What a worker does; tests replace it."""

    def __post_init__(self) -> None:
        integer("Processes.jobs", self.jobs, 1, MOST_JOBS)

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Runs every task; they begin in order.

        Raises:
            KeyboardInterrupt: after SIGINT, when every worker has saved a checkpoint.
            SystemExit: with code 143 after SIGTERM, likewise.
        """
        waiting, tried = deque(tasks), Counter[str]()
        workers = [_Worker() for _ in range(min(self.jobs, len(tasks)))]
        running: dict[Future[Outcome | None], tuple[_Worker, Task]] = {}
        with Stopping() as stopping:
            try:
                while (waiting and not stopping.asked) or running:
                    for worker in workers:
                        worker.obey(stopping.asked)
                        if waiting and worker.is_idle and not stopping.asked:
                            task = waiting.popleft()
                            tried[task.name] += 1
                            running[worker.start(type(self).work, task)] = worker, task
                    for future in wait(running, _LOOK_S, FIRST_COMPLETED).done:
                        worker, task = running.pop(future)
                        outcome = worker.outcome(future)
                        if outcome is None and tried[task.name] >= ATTEMPTS and not stopping.asked:
                            outcome = given_up(task, "the process that ran it died")
                        if outcome is None:
                            waiting.appendleft(task)
                        else:
                            yield outcome
                if waiting:
                    stopping.end(len(waiting))
            finally:
                for worker in workers:
                    worker.obey(1)
                for worker in workers:
                    worker.end(stopping)


class _Worker:
    """A worker process, replaced when it has died.

    It is the only one of its pool, so that its death is nobody else's. A pipe leads to it: what is sent asks
    it to stop, and that the pipe closes says that this process is dead.
    """

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._pipe: Connection | None = None
        self._future: Future[Outcome | None] | None = None
        self._obeyed = 0

    @property
    def is_idle(self) -> bool:
        """Whether it has nothing to do."""
        return self._future is None

    def start(self, work: Work, task: Task) -> "Future[Outcome | None]":
        """Starts a task in a living process, a new one if there is none."""
        if self._pool is not None:
            try:
                self._future = self._pool.submit(attempt, work, task)
                return self._future
            except BrokenProcessPool:  # it died between two tasks
                self._forget()
        theirs, self._pipe = _SPAWN.Pipe(duplex=False)
        self._pool = ProcessPoolExecutor(1, mp_context=_SPAWN, initializer=_begin, initargs=(theirs,))
        with _as_workers_begin():
            self._future = self._pool.submit(attempt, work, task)
        theirs.close()
        return self._future

    def outcome(self, future: "Future[Outcome | None]") -> Outcome | None:
        """Of a future that is done; None if the task is to be tried again."""
        self._future = None
        try:
            return future.result()
        except BrokenProcessPool:
            self._forget()
            return None

    def obey(self, asked: int) -> None:
        """Asks a process that is at work to stop, each time that this one was asked to."""
        while self._obeyed < asked:
            self._obeyed += 1
            if self._future is not None and self._pipe is not None:
                with suppress(OSError):  # it is dead
                    self._pipe.send("stop")

    def end(self, stopping: Stopping) -> None:
        """Waits until the process has done what it was asked to, and ends it."""
        while self._future is not None and not wait([self._future], _LOOK_S).done:
            self.obey(stopping.asked)
        self._forget()

    def _forget(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        if self._pipe is not None:
            self._pipe.close()
        self._pool = self._pipe = None


@contextmanager
def _as_workers_begin() -> Iterator[None]:
    """A process that is spawned in the block does not import the user's script, which might run the study
    again, and does not notice Ctrl-C before it is ready."""
    main = sys.modules["__main__"]
    if hasattr(signal, "pthread_sigmask"):  # Windows has none
        resource_tracker.ensure_running()  # which would unblock the signal
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _begin(pipe: Connection) -> None:
    """The beginning of a worker: Ctrl-C in the terminal is the business of the process that runs the study,
    which asks its workers to stop."""
    import torch

    if hasattr(os, "setpgrp"):
        os.setpgrp()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    Thread(target=_obey, args=(pipe,), daemon=True).start()


def _obey(pipe: Connection) -> None:
    """Gives this process SIGTERM when it is asked to stop; ends it when there is nobody left to ask."""
    while True:
        try:
            pipe.recv()
        except (EOFError, OSError):
            os._exit(1)
        if sys.platform == "win32":  # where os.kill ends the process at once, without its handler
            signal.raise_signal(signal.SIGTERM)
        else:
            os.kill(os.getpid(), signal.SIGTERM)
