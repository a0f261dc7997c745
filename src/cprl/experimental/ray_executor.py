"""Ray: runs the trials of a study as tasks of Ray, on this machine or on a cluster."""

import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated, Any, Final

from cprl.studies import executors
from cprl.studies.executors import LOOK_S, Jobs, SideBySide, ask_to_stop, start_process, wait_or_stop
from cprl.studies.status import STOPPED, Status
from cprl.studies.trials import Task
from cprl.values import Range, Value, Where

_STORE_BYTES: Final = 80 * 2**20
"""The size of Ray's object store, which stays empty. Ray needs at least 75 MiB."""
_BYTES: Final = 1_000_000_000
"""The memory that a trial asks for until more is known. Libraries, game and networks alone take 850 MB."""


@dataclass(frozen=True)
class Ray(Value, SideBySide, stored=False):
    """Runs each trial as a task of Ray, in a process of its own, on one core.

    On a cluster, all nodes need the same versions of Python, Ray, cprl and dependencies, and the directory of
    the study must be on a shared file system, under the same path. If a node dies, its locks are taken over
    after `cprl.studies.status.PATIENCE_S` seconds. If all of Ray dies, start the study again: it continues.

    Args:
        address: the address of a cluster: "auto" for the cluster of this machine, or "host:port". With None,
            a local Ray is started for the study and stopped after it. If this process has already called
            `ray.init`, that Ray is used and left running.
        jobs: the largest number of trials that run at the same time; None for one per core of the cluster.
            If there are fewer cores, tasks wait in Ray, so that a cluster can grow.
        memory_bytes: the memory that each trial asks for. None means a tenth more than the largest trial of
            the study so far, and at least 1 GB.
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
        """Connect to Ray, or start it, and undo that after the block."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's own is 15: a tenth of a busy machine
        ray: Any = import_module("ray")
        for module in (__name__, executors.__name__):
            ray.cloudpickle.register_pickle_by_value(sys.modules[module])
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
        wait_or_stop(
            lambda: ray.wait([reference], timeout=LOOK_S)[0],
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
    """Run the process of a trial; the body of a task of Ray."""
    with start_process(arguments, log, variables) as process:
        while True:
            try:
                return process.wait(0.1)
            except subprocess.TimeoutExpired:
                pass
            except KeyboardInterrupt:  # Ray's way of asking
                ask_to_stop(process)


def bytes_of(task: Task) -> int:
    """Return the memory that a trial asks for: a tenth more than the largest trial of the study so far."""
    folder = task.status.folder
    peaks = [Status(folder, path.stem).read().get("peak_bytes", 0) for path in folder.glob("*.json")]
    return max(_BYTES, round(1.1 * max(peaks, default=0)))
