"""Processes: kept worker processes on this machine, each of which runs one trial after the other."""

import multiprocessing
import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from threading import Thread
from types import ModuleType
from typing import ClassVar, Final

from cprl.arguments import integer
from cprl.studies.executors.attempts import ATTEMPTS, Work, attempt, given_up
from cprl.studies.executors.stopping import Stopping
from cprl.studies.trials import Outcome, Task, run_task

MOST_JOBS: Final = 4096
_LOOK_S: Final = 0.2
"""Seconds between two looks at whether this process was asked to stop."""
_SPAWN: Final = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Processes:
    """Worker processes on this machine, each with one thread of torch, that are kept from trial to trial.

    They are spawned, never forked, and import nothing of the user's script. One that is killed is replaced,
    and its trial resumed from its checkpoint, up to `ATTEMPTS` times; the others are not disturbed. If the
    process that runs the study is killed, however, its workers end at once.

    Args:
        jobs: how many trials run at a time, 1 to 4,096; as many cores and the memory of as many runs.

    Raises:
        ValueError: for any other number.
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
