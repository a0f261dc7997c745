"""Ray: trials as tasks of Ray, on this machine or on the nodes of a cluster."""

import logging
import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Final

from cprl.arguments import integer, refusal
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import make_env, spaces_of
from cprl.experiment import Experiment
from cprl.learners.ring import storage_bytes, torch_dtype
from cprl.population import Learning, Team
from cprl.studies.executors.processes import ATTEMPTS, MOST_JOBS, Stopping, Work, attempt, failed, given_up
from cprl.studies.trials import Outcome, Status, Task, run_task, state_of

_STORE_BYTES: Final = 80 * 2**20
"""Of Ray's store of objects, which holds nothing of ours; Ray wants at least 75 MiB."""
_AHEAD: Final = 2
"""Tasks that wait in Ray for a free core, so that a cluster that can grow knows that it should."""
_LOOK_AT_RAY_S: Final = 0.5
"""Seconds between two looks at whether this process was asked to stop."""


@dataclass(frozen=True)
class Ray:
    """Tasks of Ray, each of which asks for one core and the memory that a trial takes.

    A trial whose worker or node dies is tried again, up to `ATTEMPTS` times, and resumed from its checkpoint.
    What is done and what is not is read from the study's directory, never from Ray, so a study that is
    killed with all of Ray continues when it is started again.

    On a cluster every node has the same Python, Ray, cprl and dependencies, and the study's directory is on
    a file system that all nodes share, under the same path. What a dead node has locked is taken over after
    `cprl.studies.trials.PATIENCE_S` seconds without a sign of life.

    Args:
        address: of a cluster: "auto" for the one that this machine belongs to, or "host:port". None for a
            Ray of this machine, which is started for the study and ends with it. Where this process has
            called `ray.init` already, that Ray is used, and left as it is.
        jobs: how many trials run at a time, at most; None for one per core.
        memory_bytes: what each trial asks for; None for what finished trials of the study have taken, and
            before there are any for an estimate.
    """

    address: str | None = None
    jobs: int | None = field(default=None, kw_only=True)
    memory_bytes: int | None = field(default=None, kw_only=True)
    work: ClassVar[Work] = staticmethod(run_task)
    """What a worker does; tests replace it."""

    def __post_init__(self) -> None:
        if self.address is not None and (not isinstance(self.address, str) or not self.address.strip()):
            raise refusal("Ray.address", self.address, '"auto", "host:port", or None')
        if self.jobs is not None:
            integer("Ray.jobs", self.jobs, 1, MOST_JOBS)
        if self.memory_bytes is not None:
            integer("Ray.memory_bytes", self.memory_bytes, 1)
        if find_spec("ray") is None:
            raise ModuleNotFoundError('Ray is not installed; run pip install "cprl[ray]"', name="ray")

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Runs every task; they begin in order.

        Raises:
            ConnectionError: where there is no cluster at the address.
            KeyboardInterrupt: after SIGINT, when every worker has saved a checkpoint.
            SystemExit: with code 143 after SIGTERM, likewise.
        """
        if not tasks:
            return
        with self._connected() as ray, Stopping() as stopping:  # Ray sets handlers of its own
            waiting = deque(map(_absolute, tasks))
            needs = MemoryNeeds(waiting)
            running: dict[Any, Task] = {}
            obeyed = 0
            try:
                while (waiting and not stopping.asked) or running:
                    most = self.jobs or _cores(ray) + _AHEAD
                    while waiting and len(running) < most and not stopping.asked:
                        task = waiting.popleft()
                        running[self._start(ray, task, needs.of(task))] = task
                    if stopping.asked > obeyed:
                        obeyed += 1
                        _cancel(ray, running, force=obeyed > 1)
                    for done in ray.wait(list(running), timeout=_LOOK_AT_RAY_S)[0]:
                        task = running.pop(done)
                        outcome = _outcome(ray, done, task)
                        if outcome is None:  # it was asked to stop, here or by somebody else
                            waiting.appendleft(task)
                            continue
                        needs.learn(task)
                        yield outcome
                if waiting:
                    stopping.end(len(waiting))
            finally:
                _cancel(ray, running, force=False)
                while running:
                    for done in ray.wait(list(running), timeout=_LOOK_AT_RAY_S)[0]:
                        del running[done]
                    if stopping.asked > 1:
                        break

    def _start(self, ray: Any, task: Task, needed: int) -> Any:
        largest = max((_memory(node) for node in ray.nodes() if node["Alive"]), default=0)
        needed = self.memory_bytes or needed
        options = {
            "name": task.name,
            "num_cpus": 1,
            "memory": min(needed, largest)
            if largest
            else needed,  # more than any node has would wait forever
            "max_retries": ATTEMPTS - 1,
            "retry_exceptions": False,
        }
        if "PYTHONPATH" in os.environ:
            options["runtime_env"] = {"env_vars": {"PYTHONPATH": os.environ["PYTHONPATH"]}}
        return ray.remote(attempt).options(**options).remote(type(self).work, task)

    @contextmanager
    def _connected(self) -> Iterator[Any]:
        """Ray, connected to; afterwards as it was before."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's own is 15: a tenth of a busy machine
        ray: Any = import_module("ray")
        if ray.is_initialized():
            yield ray
            return
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        if self.address is None:
            cores = min(self.jobs or MOST_JOBS, os.cpu_count() or 1)
            local = {"num_cpus": cores, "include_dashboard": False, "object_store_memory": _STORE_BYTES}
            ray.init("local", **local, **quiet)
        else:
            ray.init(self.address, **quiet)
        try:
            yield ray
        finally:
            ray.shutdown()


def _absolute(task: Task) -> Task:
    """A task for workers in whatever directory."""
    return replace(task, runs=os.path.abspath(task.runs), status=os.path.abspath(task.status))


def _cores(ray: Any) -> int:
    """Of the whole cluster, as it is now."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def _memory(node: dict[str, Any]) -> int:
    return int(node["Resources"].get("memory", 0))


def _cancel(ray: Any, running: dict[Any, Task], *, force: bool) -> None:
    """Asks tasks to stop, as Ctrl-C does; or kills their workers."""
    for own in running:
        ray.cancel(own, force=force)


def _outcome(ray: Any, done: Any, task: Task) -> Outcome | None:
    """Of a task that has ended; None if it is to be tried again."""
    errors = ray.exceptions
    try:
        outcome: Outcome | None = ray.get(done)
        return outcome
    except errors.TaskCancelledError:
        return None
    except (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError) as error:
        return given_up(task, f"its worker or node died ({type(error).__name__})")
    except (errors.RayTaskError, errors.RuntimeEnvSetupError) as error:  # e.g. the node has no cprl
        lines = str(error).strip().splitlines() or [""]
        return failed(task, f"{type(error).__name__}: {lines[-1].strip()}", "\n".join(lines))


BASE_BYTES: Final = 850_000_000
"""What a run takes without its buffers, compilation included: torch, Numba, the game, the networks."""
_COPIES: Final = 2
"""A checkpoint is made of a copy of the buffers."""
_MARGIN: Final = 1.1


class MemoryNeeds:
    """The bytes to ask for before a trial is started.

    They are estimated from its replay buffers. Once a trial of the study has finished, estimates are
    multiplied by the largest ratio of what one of them took to what had been estimated for it.

    Args:
        tasks: those of the study; what its finished ones took is in their status files.
    """

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._ratio = 0.0
        for task in tasks:
            if state_of(task.directory) == "finished":
                self.learn(task)

    def learn(self, task: Task) -> None:
        """Notes what a finished trial took."""
        taken = Status(Path(task.status), task.name).read().get("peak_bytes", 0)
        if isinstance(taken, int) and taken > 0:
            self._ratio = max(self._ratio, taken / estimated_bytes(task))

    def of(self, task: Task) -> int:
        """What to ask for, a tenth more than is expected."""
        return round(_MARGIN * estimated_bytes(task) * (self._ratio or 1.0))


def estimated_bytes(task: Task) -> int:
    """The largest memory that a trial takes, as far as its recipe says; for algorithms and games of the
    user's own, whose buffers nobody knows, `BASE_BYTES`."""
    buffers = 0
    with suppress(Exception):  # what is wrong with the recipe, or the user's code, the trial says itself
        experiment = Experiment.from_recipe(task.recipe, allow=task.allow, directory=task.directory)
        spaces = _spaces(experiment)
        for own in experiment.agents:
            settings = getattr(getattr(own, "algorithm", None), "settings", None)
            size = getattr(settings, "buffer_size", 0)
            if isinstance(own, Learning | Team) and size:
                members = own.agents if isinstance(own, Team) else (0,)
                buffers += experiment.replicas * len(members) * _buffer_bytes(size, spaces)
    return BASE_BYTES + _COPIES * buffers


def _buffer_bytes(transitions: int, spaces: Spaces) -> int:
    item = torch_dtype(spaces.observation_dtype).itemsize
    return storage_bytes(1, transitions, spaces.observation_shape, item_bytes=item)


def _spaces(experiment: Experiment) -> Spaces:
    if isinstance(experiment.game, Game) and not experiment.transforms:
        return experiment.game.spaces
    return spaces_of(make_env(experiment.game, seed=experiment.seed, transforms=experiment.transforms))
