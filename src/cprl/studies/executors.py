"""Executors: where the trials of a study are run: in this process, in processes of this machine, or by Ray.

Each makes finished runs of the same directories by the same `cprl run`, so a study may go on elsewhere than
where it began. What is done and what is not is read from the directories, never from an executor.
"""

import logging
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
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated, Any, Final, Protocol

from cprl.runs.checkpoints import interruption
from cprl.studies.status import STOPPED, Status
from cprl.studies.trials import ATTEMPTS, Outcome, Task
from cprl.system.output import console
from cprl.system.process import at_signals
from cprl.values import Range, Value, Where

Jobs = Annotated[int, Range(1, 4096)]
"""Trials that run at a time."""
_LOOK_S: Final = 0.1
"""Seconds between two looks at which processes have ended, and at whether this one was asked to stop."""


class Executor(Protocol):
    """Runs trials; an outcome is yielded as soon as one has ended, in whatever order.

    It stops what it started when its generator is closed. At the first SIGINT or SIGTERM of the process that
    iterates, every running trial finishes its step and saves a checkpoint, and `KeyboardInterrupt` or
    `SystemExit` with code 143 is raised; the same line again continues.
    """

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        """Run every trial; they begin in order."""


@dataclass(frozen=True)
class InProcess:
    """One trial after the other, in this process, which imports and compiles once: for tiny trainings."""

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        for task in tasks:
            yield task.run_here()


@contextmanager
def signals() -> Iterator[list[int]]:
    """Return the signals by which this process is asked to stop in the block, as they come; what is done
    about them is up to the block."""
    numbers: list[int] = []

    def note(number: int) -> None:
        numbers.append(number)
        if len(numbers) == 1:
            console().print(
                "Stopping: each trial finishes its step and saves a checkpoint; signal again to kill them.",
                soft_wrap=True,
            )

    with at_signals(note):
        yield numbers


class _SideBySide(ABC):
    """Runs trials in processes of their own, some at a time.

    One whose process dies is tried again, up to `ATTEMPTS` times, and resumed from its checkpoint; the others
    are not disturbed.
    """

    @abstractmethod
    def places(self) -> int:
        """Return how many trials may run at a time."""

    @abstractmethod
    def exit_code(self, task: Task, stops: Sequence[int]) -> int:
        """Run the process of a trial; ask it to stop when this one is asked, kill it the second time."""

    def ready(self) -> AbstractContextManager[object]:
        """In which processes are started."""
        return nullcontext()

    def run(self, tasks: Sequence[Task]) -> Generator[Outcome, None, None]:
        waiting: list[Task] = []
        for task in tasks:
            outcome = task.settled()
            if outcome is None:
                waiting.append(task)
            else:
                yield outcome
        if not waiting:
            return
        with self.ready(), signals() as stops, ThreadPoolExecutor(self.places()) as pool:
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

    def _carry_out(self, task: Task, stops: Sequence[int]) -> Outcome | None:
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
class Processes(Value, _SideBySide, stored=False):
    """Processes on this machine, one for each trial, each with one thread of torch.

    Each has the trial's log as its output, and ends at once if the process that runs the study dies.

    Args:
        jobs: how many trials run at a time; as many cores and the memory of as many runs.
    """

    jobs: Jobs

    def places(self) -> int:
        return self.jobs

    def exit_code(self, task: Task, stops: Sequence[int]) -> int:
        def is_over() -> bool:
            is_running = process.poll() is None
            time.sleep(_LOOK_S * is_running)
            return not is_running

        with _started(task.arguments, str(task.status.log), task.variables) as process:
            _attend(is_over, stops, lambda kill: process.kill() if kill else _ask_to_stop(process))
            return process.wait()


def _attend(is_over: Callable[[], object], stops: Sequence[int], stop: Callable[[bool], object]) -> None:
    """Wait until a process is over, and stop it when this one is asked to, the second time by force."""
    heard = 0
    while not is_over():
        if heard < len(stops):
            heard = len(stops)
            stop(heard > 1)


def _started(arguments: Sequence[str], log: str, variables: Mapping[str, str]) -> "subprocess.Popen[bytes]":
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=file,
            env={**os.environ, **variables},
            start_new_session=True,  # Ctrl-C is the business of the process that runs the study
        )


def _ask_to_stop(process: "subprocess.Popen[bytes]") -> None:
    assert process.stdin is not None
    with suppress(OSError):  # it has ended
        os.write(process.stdin.fileno(), b"!")


_STORE_BYTES: Final = 80 * 2**20
"""Of Ray's store of objects, which holds nothing of ours; Ray wants at least 75 MiB."""
_BYTES: Final = 1_000_000_000
"""What a trial asks for while nobody knows more: torch, Numba, the game and the networks take 850 MB."""


@dataclass(frozen=True)
class Ray(Value, _SideBySide, stored=False):
    """Tasks of Ray, each of which runs a trial in a process of its own, on one core.

    A study that is killed with all of Ray continues when it is started again. On a cluster every node has the
    same Python, Ray, cprl and dependencies, and the study's directory is on a file system that all nodes
    share, under the same path. What a dead node has locked is taken over after
    `cprl.studies.trials.PATIENCE_S` seconds without a sign of life.

    Args:
        address: of a cluster: "auto" for the one that this machine belongs to, or "host:port". None for a
            Ray of this machine, which is started for the study and ends with it. Where this process has
            called `ray.init` already, that Ray is used, and left as it is.
        jobs: how many trials run at a time, at most; None for one per core that there is now. Where there are
            fewer cores, tasks wait in Ray, so that a cluster that can grow knows that it should.
        memory_bytes: what each trial asks for; None for a tenth more than any trial of the study has taken
            so far, and 1 GB while that is less.
    """

    address: Annotated[str, Where(lambda text: bool(text.strip()), '"auto", "host:port"')] | None = None
    jobs: Jobs | None = field(default=None, kw_only=True)
    memory_bytes: Annotated[int, Range(1, 2**63 - 1)] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if find_spec("ray") is None:
            raise ModuleNotFoundError('Ray is not installed; run pip install "cprl[ray]"', name="ray")

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Connected to Ray; afterwards as it was before."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's own is 15: a tenth of a busy machine
        ray: Any = import_module("ray")
        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
        if ray.is_initialized():
            yield
            return
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        if self.address is None:
            cores = min(self.jobs or sys.maxsize, os.cpu_count() or 1)
            options |= {"num_cpus": cores, "include_dashboard": False, "object_store_memory": _STORE_BYTES}
        ray.init(self.address or "local", **options)
        try:
            yield
        finally:
            ray.shutdown()

    def places(self) -> int:
        ray: Any = import_module("ray")
        return self.jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))

    def exit_code(self, task: Task, stops: Sequence[int]) -> int:
        ray: Any = import_module("ray")
        nodes = [int(node["Resources"].get("memory", 0)) for node in ray.nodes() if node["Alive"]]
        memory = self.memory_bytes or bytes_of(task)
        if any(nodes):
            memory = min(memory, max(nodes))  # more than any node has would wait forever
        work = ray.remote(num_cpus=1, memory=memory, max_retries=0)(_wait)
        reference = work.remote(task.arguments, os.path.abspath(task.status.log), task.variables)
        errors = ray.exceptions
        _attend(
            lambda: ray.wait([reference], timeout=_LOOK_S)[0],
            stops,
            lambda kill: ray.cancel(reference, force=kill),
        )
        try:
            return int(ray.get(reference))
        except errors.TaskCancelledError:
            return STOPPED[-1]
        except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError):
            return -9  # as after SIGKILL
        except errors.RayError as error:  # e.g. the node does not have the study's directory
            lines = str(error).strip().splitlines() or [""]
            task.status.fail(f"{type(error).__name__}: {lines[-1].strip()}", "\n".join(lines))
            return 1


def _wait(arguments: Sequence[str], log: str, variables: Mapping[str, str]) -> int:
    with _started(arguments, log, variables) as process:
        while True:
            try:
                return process.wait(0.1)
            except subprocess.TimeoutExpired:
                pass
            except KeyboardInterrupt:  # Ray's way of asking
                _ask_to_stop(process)


def bytes_of(task: Task) -> int:
    """Return what a trial is expected to take, a tenth more than any of its study has taken so far."""
    folder = task.status.folder
    peaks = [Status(folder, path.stem).read().get("peak_bytes", 0) for path in folder.glob("*.json")]
    return max(_BYTES, round(1.1 * max(peaks, default=0)))
