"""Processes that may die of a case: each runs the cases of one target after another, watched from outside."""

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final

import psutil
import torch

from . import register, runner, runs, things
from .runner import Finding, Outcome

SILENT_S: Final = 180.0
"""A worker of which nothing is heard for so long hangs where no signal reaches it."""
MOST_DATA: Final = 8 * 2**30
"""Bytes that a worker may allocate; what asks for more gets a MemoryError."""
MOST_RESIDENT: Final = 4 * 2**30
"""Bytes at which a worker is ended from outside."""
TARGETS_OF_ONE: Final = 40
"""Targets after which a worker is replaced, so that what one leaves behind does not add up."""


@dataclass(frozen=True)
class Task:
    """Cases of a target."""

    name: str
    cases: int
    seed: int
    first: int = 0
    """Those before are drawn and not run."""


def first_seed(task: Task) -> int:
    """The seed of the first draw: another one for each target."""
    return task.seed * 1_000_003 + sum(task.name.encode()) * 1009


@dataclass
class _Worker:
    process: Any
    connection: Connection
    task: Task | None = None
    outcome: Outcome = field(default_factory=Outcome)
    next_case: int = 0
    heard: float = field(default_factory=time.monotonic)
    begun: int = 0


def run_all(tasks: list[Task], *, jobs: int, ended: Callable[[Task, Outcome], None]) -> None:
    """Runs all tasks in so many processes; `ended` is called with the outcome of each."""
    left, workers = list(tasks), [_start() for _ in range(min(jobs, len(tasks)))]
    try:
        while left or any(own.task for own in workers):
            for place, own in enumerate(workers):
                if own.task is None and left:
                    if own.begun >= TARGETS_OF_ONE:
                        _end(own)
                        workers[place] = own = _start()
                    _give(own, left.pop(0))
            busy = {own.connection: own for own in workers if own.task}
            for connection in wait(list(busy), timeout=1.0):
                _hear(busy[connection], ended)  # type: ignore[index]
            for place, own in enumerate(workers):
                wrong = _what_is_wrong(own)
                if wrong and own.task:
                    workers[place] = _after_death(own, wrong, ended)
    finally:
        for own in workers:
            _end(own)


def _hear(own: _Worker, ended: Callable[[Task, Outcome], None]) -> None:
    try:
        said = own.connection.recv()
    except (EOFError, ConnectionError):
        return
    own.heard = time.monotonic()
    if said is None:
        assert own.task is not None
        ended(own.task, own.outcome)
        own.task = None
        return
    case, how = said
    own.outcome.add(case, how)
    own.next_case = case + 1


def _what_is_wrong(own: _Worker) -> str | None:
    if own.task is None:
        return None
    if not own.process.is_alive():
        own.process.join()
        while own.connection.poll():  # what it said before
            try:
                case, how = own.connection.recv()
            except (EOFError, ConnectionError, TypeError):
                break
            own.outcome.add(case, how)
            own.next_case = case + 1
        return f"the process died with exit code {own.process.exitcode}"
    if time.monotonic() - own.heard > SILENT_S:
        return f"nothing was heard for {SILENT_S:g} s: hangs where no signal reaches it"
    try:
        resident = psutil.Process(own.process.pid).memory_info().rss
    except psutil.Error:
        return None
    return f"took {resident / 2**30:.1f} GiB of memory" if resident > MOST_RESIDENT else None


def _after_death(own: _Worker, wrong: str, ended: Callable[[Task, Outcome], None]) -> _Worker:
    """A new worker, which goes on after the case of which the last one died."""
    task = own.task
    assert task is not None
    _end(own)
    own.outcome.add(own.next_case, Finding(own.next_case, wrong, "see --case"))
    new = _start()
    if own.next_case + 1 >= task.cases:
        ended(task, own.outcome)
        return new
    _give(new, Task(task.name, task.cases, task.seed, own.next_case + 1))
    new.outcome = own.outcome
    return new


def _start() -> _Worker:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=False)
    process.start()
    theirs.close()
    return _Worker(process, ours)


def _give(own: _Worker, task: Task) -> None:
    own.task, own.outcome, own.next_case = task, Outcome(), task.first
    own.heard, own.begun = time.monotonic(), own.begun + 1
    own.connection.send(task)


def _end(own: _Worker) -> None:
    own.connection.close()
    if own.process.is_alive():
        own.process.kill()
    own.process.join()


def _work(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare()
    for task in _tasks(connection):
        target = register.targets()[task.name]

        def each(number: int, case: Any, task: Task = task, target: Any = target) -> None:
            if number >= task.first:
                connection.send((number, runner.run_case(target, case, number)))

        runner.cases_of(target, task.cases, first_seed=first_seed(task), each=each)
        connection.send(None)


def _tasks(connection: Connection) -> Iterator[Task]:
    while True:
        try:
            yield connection.recv()
        except EOFError:
            return


def prepare() -> None:
    """Limits the memory of this process, and loads and compiles what the first case would wait for."""
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_DATA, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ.setdefault("MPLBACKEND", "agg")
    runs.root()
    things.episodes()
    Path(runs.root() / "here").mkdir(exist_ok=True)
    os.chdir(runs.root() / "here")
