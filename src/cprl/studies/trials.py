"""Trials: runs of a study, one for each condition and block of replicas, each in a directory of its own.

The truth of a study lies in these directories. `run_task` makes of any of them a finished run, whatever was
there: nothing, a run that was killed at any moment, or a finished one, of which it does nothing.
"""

import json
import os
import shutil
import socket
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final, Literal, NamedTuple, Self

import psutil
from tensordict import TensorDictBase

from cprl.config import custom_targets, differences
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.population import Frozen, with_stored
from cprl.runs.checkpoints import FOLDER, REPORT, checkpoints_in, depends_on_episodes, is_ending
from cprl.runs.files import LOCK_FILE, RunLock, RunLockedError, refuse_missing, remove_partial, write_json
from cprl.runs.recipe import RECIPE_FILE, changed_code, read_recipe, recipe_config
from cprl.studies.study import Block, Condition, Study
from cprl.system.compile_clock import CLOCK
from cprl.system.process import cpu
from cprl.training import Training

State = Literal["missing", "unfinished", "finished", "refused"]
PATIENCE_S: Final = 60.0
"""Seconds without a sign of life after which a trial is taken over that another host has locked."""
_POLL_S: Final = 1.0


class Status:
    """The files in which a trial says how far it is.

    Args:
        folder: in which they are; made by whoever writes first.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.path, self.log = folder / f"{name}.json", folder / f"{name}.log"
        self.failed = folder / f"{name}.failed.txt"

    def read(self) -> dict[str, Any]:
        """What the trial said last; empty if it has said nothing."""
        try:
            found = json.loads(self.path.read_bytes())
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def fail(self, reason: str, trace: str) -> None:
        """Notes why the trial failed."""
        self.failed.write_text(f"{reason}\n\n{trace}", encoding="utf-8", errors="replace")

    def failure(self) -> str | None:
        """The error of the last attempt in a line; None if it did not fail."""
        try:
            return self.failed.read_text(encoding="utf-8").partition("\n")[0]
        except (OSError, ValueError):
            return None

    def tidy_up(self) -> None:
        """Forgets earlier failures."""
        with suppress(OSError):
            self.failed.unlink(missing_ok=True)


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of a study: a block of replicas of a condition."""

    condition: Condition
    block: Block
    experiment: Experiment
    """What is run."""

    @property
    def name(self) -> str:
        """The name of its directory: the condition's checksum, the seed and the number of replicas."""
        return f"{self.condition.checksum}-s{self.experiment.seed}-r{self.experiment.replicas}"

    def state(self, runs: Path) -> State:
        """What its directory holds; "refused" is a finished run of another trial."""
        run = runs / self.name
        state = state_of(run)
        if state == "finished":
            try:
                refuse_another(run, self.experiment.to_recipe(run))
            except ValueError:
                return "refused"
        return state


def trials_of(study: Study) -> list[Trial]:
    """Every trial of a study: the first blocks of all conditions, then their second ones, and so on."""
    return [
        Trial(
            condition,
            block,
            replace(
                condition.experiment,
                seed=block.seed,
                replicas=block.replicas,
                agents=tuple(with_stored(own, partial(_of_block, block)) for own in agents),
            ),
        )
        for block in study.blocks
        for condition in study.all_conditions
        for agents in (condition.experiment.agents,)
    ]


def _of_block(block: Block, stored: Frozen) -> Frozen:
    """A stored agent in the replicas of a block, which a run numbers from 0 again."""
    last = block.first + block.replicas
    if isinstance(stored.replica, tuple):
        return replace(stored, replica=stored.replica[block.first : last])
    if stored.replica is None and block.first:
        return replace(stored, replica=tuple(range(block.first, last)))
    return stored


def refuse_another(run: Path, recipe: Mapping[str, Any]) -> None:
    """Refuses a finished run that is not the trial whose name its directory has, e.g. since it was renamed.

    Args:
        recipe: what `Experiment.to_recipe` gives for the trial and this directory.
    """
    stored, trial = recipe_config(read_recipe(run)), recipe["experiment"]
    differ = differences({**stored, **_FREE}, {**trial, **_FREE}, "experiment", Experiment)
    if differ:
        raise ValueError(
            f"{run} was started as another trial than its name says: {differ[0]}; give it back its name, or "
            "move it away"
        )


_FREE: Final = {"name": "", "on_nan": ""}
"""Fields that may differ between runs of the same trial."""


def move_aside(run: Path) -> Path | None:
    """Moves a run out of the way that was made with other code of the user's own; nothing of it is lost.

    Returns:
        Where it is now: in a folder beside that of the runs, `runs-earlier`; None for any other run.

    Raises:
        RunLockedError: if another process runs it.
    """
    try:
        if state_of(run) == "missing" or not changed_code(read_recipe(run)):
            return None
    except ValueError:  # its recipe cannot be read, which is a failure of the trial
        return None
    earlier = Path(os.path.abspath(run.parent))
    earlier = earlier.with_name(f"{earlier.name}-earlier")
    with RunLock(run):
        earlier.mkdir(exist_ok=True)
        taken = {path.name for path in earlier.iterdir()}
        aside = earlier / next(name for n in count(1) if (name := f"{run.name}-{n}") not in taken)
        shutil.move(run, aside)
    (aside / LOCK_FILE).unlink(missing_ok=True)
    return aside


def state_of(run: Path) -> State:
    """What the directory of a run holds; a finished run has a report."""
    if (run / REPORT).exists():
        return "finished"
    return "unfinished" if (run / RECIPE_FILE).exists() else "missing"


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a process has to know to run a trial: plain values, which any executor can send."""

    name: str
    """Of the trial, and of its directory."""
    runs: str
    """The directory in which the trial's is."""
    status: str
    """The directory in which it says how far it is."""
    recipe: Mapping[str, Any]
    """What `Experiment.to_recipe` gave for the trial's directory."""
    allow: tuple[str, ...] = ()
    """Targets of `Custom` that may be imported."""
    paths: tuple[str, ...] = ()
    """Directories from which they are imported."""
    keep_checkpoint: bool = False
    """Whether the finished run keeps the state of its training, so that a longer trial can go on from it."""
    command: tuple[str, ...] = ("cprl", "sweep")
    """The command line of the study, which the recipe keeps."""
    waits: bool = True
    """Whether it waits while another process runs the trial, and takes it over where that one has died."""

    @property
    def directory(self) -> Path:
        """Of the trial."""
        return Path(self.runs) / self.name


class Outcome(NamedTuple):
    """How a trial ended."""

    name: str
    state: Literal["finished", "failed", "elsewhere"]
    """"elsewhere" if another process runs it, and the task does not wait."""
    reason: str = ""
    """Of a failure: the error in a line."""
    worked: bool = False
    """Whether anything had to be done."""


def task_of(
    trial: Trial, *, runs: Path, status: Path, allow: Sequence[str] = (), keep_checkpoint: bool = False
) -> Task:
    """The task of a trial.

    Classes of the user's own that the experiment itself has are allowed: it was made with them.

    Args:
        runs: the directory in which its own is.
        allow: further targets of `Custom`, those of stored runs that agents come from.
        keep_checkpoint: whether its run keeps the state of its training.
    """
    recipe = trial.experiment.to_recipe(runs / trial.name)
    targets = tuple(dict.fromkeys([*custom_targets(recipe["experiment"]), *allow]))
    return Task(
        name=trial.name,
        runs=str(runs),
        status=str(status),
        recipe=recipe,
        allow=targets,
        paths=tuple(map(os.path.abspath, sys.path)) if targets else (),
        keep_checkpoint=keep_checkpoint,
        command=tuple(sys.argv),
    )


def run_task(task: Task) -> Outcome:
    """Makes a trial a finished one; may be called any number of times, anywhere.

    What is there is kept: a finished trial is left as it is, an unfinished one is resumed, and one that is
    not there goes on from a shorter one if that can be, see `cprl.studies.trials`; a run of another
    experiment, or one that lost results, is a failure. For what happens while another process runs it see
    `Task.waits`.

    What it prints is in `log.txt` beside its status, and why it failed in `failed.txt`.
    """
    run, status = task.directory, Status(Path(task.status), task.name)
    was_finished = state_of(run) == "finished"
    sys.path += [path for path in task.paths if path not in sys.path]
    sys.argv = list(task.command)  # that of a worker process would name its machine's directories
    status.folder.mkdir(parents=True, exist_ok=True)
    try:
        if was_finished:
            refuse_another(run, task.recipe)
            refuse_missing(run)
            ended = True
        else:
            with _printing_into(status.log):
                ended = _run(task, run, status)
    except Exception as error:
        status.fail(f"{type(error).__name__}: {error}", traceback.format_exc())
        return Outcome(task.name, "failed", f"{type(error).__name__}: {error}", True)
    if not ended:
        return Outcome(task.name, "elsewhere")
    status.tidy_up()
    return Outcome(task.name, "finished", worked=not was_finished)


def _run(task: Task, run: Path, status: Status) -> bool:
    """Runs or resumes a trial as soon as nobody else does; False if it does not wait for that."""
    from cprl.training.running import run as run_experiment

    silent = is_silent(status, PATIENCE_S)
    while state_of(run) != "finished":
        experiment = Experiment.from_recipe(task.recipe, allow=task.allow, directory=run)
        if not run.exists():
            begin_from_shorter(run, experiment, task.recipe)
        is_begun, take_over = state_of(run) == "unfinished", next(silent)
        try:
            if is_begun:
                with RunLock(run, take_over=take_over):
                    pass  # refused while another process runs it, whose status stays as it is
                # Another study may have begun it, under another name.
                experiment = replace(experiment, name=str(read_recipe(run)["experiment"]["name"]))
            else:
                _clear(run, take_over=take_over)
            with StatusFile(status, experiment) as shown:
                run_experiment(
                    experiment,
                    run,
                    resume=is_begun,
                    take_over=take_over,
                    keep_checkpoint=task.keep_checkpoint,
                    watch="off",
                    figures=False,
                    allow=task.allow,
                    callbacks=(StatusCallback(shown),),
                )
        except (RunLockedError, FileExistsError):  # somebody else began it
            if state_of(run) == "missing" and not (run / LOCK_FILE).exists():
                raise
            if not task.waits:
                return False
            time.sleep(_POLL_S)
    return True


def _clear(run: Path, *, take_over: bool) -> None:
    """Removes what a process left that was killed before it had written a recipe."""
    if not run.exists():
        return
    with RunLock(run, take_over=take_over):
        remove_partial(run)


@contextmanager
def _printing_into(log: Path) -> Iterator[None]:
    """Appends what the block prints to a file."""
    with (
        open(log, "a", encoding="utf-8", errors="replace") as file,
        redirect_stdout(file),
        redirect_stderr(file),
    ):
        yield


BEAT_S: Final = 1.0
"""Seconds between two signs of life."""


class StatusFile:
    """Writes the status of a trial every second; a context manager."""

    def __init__(self, status: Status, experiment: Experiment) -> None:
        self._status = status
        self.said: dict[str, Any] = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "cpu": cpu(),
            "episodes": 0,
            "of": experiment.episodes * experiment.replicas,
            "steps": 0,
        }
        self._began, self._compiled_s = time.monotonic(), CLOCK.total_s
        self._beat, self._is_over = 0, Event()
        self._thread = Thread(target=self._write_on, daemon=True)

    def _write_on(self) -> None:
        while not self._is_over.wait(BEAT_S):
            self._write()

    def _write(self) -> None:
        self._beat += 1
        now = {
            "beat": self._beat,
            "running_s": round(time.monotonic() - self._began, 1),
            "compiling_s": round(CLOCK.total_s - self._compiled_s, 1),
            "is_compiling": CLOCK.is_running,
            "peak_bytes": peak_bytes(),
        }
        with suppress(OSError):  # of a full disk the run itself says more
            write_json(self._status.path, {**self.said, **now})

    def __enter__(self) -> Self:
        self._write()
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        self._is_over.set()
        self._thread.join()
        self._write()


class StatusCallback:
    """Counts the steps and episodes of a training for its `StatusFile`; a callback of `cprl.training`."""

    is_extendable = True

    def __init__(self, file: StatusFile) -> None:
        self._said = file.said

    def on_start(self, training: Training) -> None:
        """Continues counting where the training does."""
        self._said.update(steps=training.steps, episodes=training.episodes_played)

    def on_step(self, batch: TensorDictBase) -> None:
        """Counts a step of every world."""
        self._said["steps"] += 1

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Counts an episode."""
        self._said["episodes"] += 1


def is_silent(status: Status, patience_s: float) -> Iterator[bool]:
    """Whether a trial has given no sign of life for so many seconds, each time it is asked.

    Other hosts' clocks may differ from this one's, so what counts is whether the status changes.
    """
    last, since = status.read(), time.monotonic()
    while True:
        now = status.read()
        if now != last:
            last, since = now, time.monotonic()
        yield time.monotonic() - since >= patience_s


def peak_bytes() -> int:
    """The largest memory that this process has had, in bytes."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


_FREE_TO_EXTEND: Final = {"episodes": 0, "name": "", "on_nan": ""}
"""What may differ: how long it is, and what changes no number."""


def begin_from_shorter(run: Path, experiment: Experiment, recipe: Mapping[str, Any]) -> Path | None:
    """Makes a run that is not there of the longest finished one beside it that has fewer episodes, keeps the
    state of its training and is the same otherwise; it is then to be resumed with its own episodes.

    The other run stays as it is. A copy that was interrupted is made anew.

    Args:
        run: the directory that is not there.
        experiment: what is to be run; one with callbacks that may depend on the number of episodes goes on
            from nothing.
        recipe: what `Experiment.to_recipe` gave for it.

    Returns:
        The run that was copied; None if there is none such.
    """
    callbacks = [own.resolve() for own in experiment.callbacks]
    if any(not isinstance(own, type) or depends_on_episodes(own) for own in callbacks):
        return None
    wanted = recipe["experiment"]
    found: list[tuple[int, Path]] = []
    for other in sorted(run.parent.glob(f"*/{RECIPE_FILE}")):
        own = _experiment_of(other.parent)
        if (
            own is not None
            and own["episodes"] < wanted["episodes"]
            and not differences(
                {**own, **_FREE_TO_EXTEND}, {**wanted, **_FREE_TO_EXTEND}, "experiment", Experiment
            )
            and any(map(is_ending, checkpoints_in(other.parent / FOLDER)))
        ):
            found.append((own["episodes"], other.parent))
    if not found:
        return None
    _, shorter = max(found)
    copying = run.with_name(f".{run.name}.copying-{os.getpid()}")
    shutil.rmtree(copying, ignore_errors=True)
    try:
        shutil.copytree(shorter, copying, ignore=shutil.ignore_patterns(REPORT, LOCK_FILE))
        copying.rename(run)
    except OSError:
        if not run.exists():  # else somebody else has begun it meanwhile
            raise
        return None
    finally:
        shutil.rmtree(copying, ignore_errors=True)
    return shorter


def _experiment_of(run: Path) -> dict[str, Any] | None:
    """The experiment of a finished run; None for any other directory, and one made with other code."""
    if not (run / REPORT).exists():
        return None
    try:
        recipe = read_recipe(run)
        found: dict[str, Any] = recipe["experiment"]
        return found if isinstance(found["episodes"], int) and not changed_code(recipe) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
