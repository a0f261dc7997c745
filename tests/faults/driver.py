"""Starts processes that run an experiment, stops them at chosen moments, and compares what they leave."""

import contextlib
import json
import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final

import psutil
import pyarrow.parquet as pq
import torch

from cprl import Experiment
from cprl.runs.episodes import read_episodes

from .child import Life, live

DEADLINE_S: Final = 180.0
"""The longest that a process may take; one that takes longer hangs."""

_PRELOADED: Final = (
    "cprl.running",
    "cprl.studies",
    "torch._inductor.compile_fx",
    "matplotlib.backends.backend_agg",
)
_QUIET: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TORCHINDUCTOR_COMPILE_THREADS": "1"}
"""No thread is running when a process is forked."""


class HungError(Exception):
    """A process neither ended nor got to where it was awaited."""


@dataclass
class Ended:
    """How a process ended."""

    code: int | None
    out: str
    err: str
    stages: dict[str, float] = field(default_factory=dict)
    """When each stage began, in seconds after the process began."""
    operations: dict[str, int] = field(default_factory=dict)
    """The number of file operations of each stage."""

    @property
    def said(self) -> str:
        """What it printed, one after the other."""
        return self.out + self.err


class Process:
    """A process that lives; killed when the block ends."""

    def __init__(self, life: Life) -> None:
        context = _context()
        self.life, (self.pipe, theirs) = life, context.Pipe()
        self._process: BaseProcess = context.Process(target=live, args=(life, theirs))
        self._began, self.stage = time.monotonic(), ""
        self.stages: dict[str, float] = {}
        self.operations: dict[str, int] = {}
        self._process.start()
        theirs.close()

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        """Its number."""
        return int(self._process.pid or 0)

    def until(self, awaited: Callable[[tuple[Any, ...]], bool], *, deadline_s: float = DEADLINE_S) -> Any:
        """The first message that is awaited, or None if the process ends before.

        Raises:
            HungError: if neither happens before the deadline.
        """
        last = time.monotonic() + deadline_s
        while time.monotonic() < last:
            try:
                if not self.pipe.poll(0.05):
                    if not self._process.is_alive() and not self.pipe.poll():
                        return None
                    continue
                message = self.pipe.recv()
            except (EOFError, OSError):
                return None
            self._note(message)
            if awaited(message):
                return message
        raise HungError(f"{' '.join(self.life.argv)} hangs in the stage {self.stage!r}: {self._said()}")

    def _note(self, message: tuple[Any, ...]) -> None:
        if message[0] == "stage":
            self.operations[self.stage] = message[2]
            self.stage = message[1]
            self.stages[self.stage] = time.monotonic() - self._began

    def at(self, stage: str) -> Any:
        """Waits for the beginning of a stage."""
        return self.until(lambda message: message[:2] == ("stage", stage))

    def paused(self) -> Any:
        """Waits until the process waits before the operation of `Life.pause`."""
        return self.until(lambda message: message[0] == "pause")

    def resume(self) -> None:
        """Lets a process go on that waits."""
        self.pipe.send("resume")

    def kill(self) -> bool:
        """SIGKILL; whether it was still there to be killed."""
        self._process.kill()
        self._process.join()
        with contextlib.suppress(EOFError, OSError):
            while self.pipe.poll():
                self._note(self.pipe.recv())
        return self._process.exitcode == -signal.SIGKILL

    def end(self, *, deadline_s: float = DEADLINE_S) -> Ended:
        """Waits until the process has ended by itself.

        Raises:
            HungError: if it has not before the deadline.
        """
        self.until(lambda _: False, deadline_s=deadline_s)
        self._process.join(deadline_s)
        if self._process.exitcode is None:
            raise HungError(f"{' '.join(self.life.argv)} does not end: {self._said()}")
        out, err = (path.read_text(errors="replace") for path in _outputs(self.life))
        return Ended(self._process.exitcode, out, err, self.stages, self.operations)

    def _said(self) -> str:
        return "".join(path.read_text(errors="replace") for path in _outputs(self.life) if path.exists())


def _outputs(life: Life) -> tuple[Path, Path]:
    return life.output, life.output.with_suffix(".err")


def _context() -> Any:
    """Forks from a process that has imported everything and started no thread."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_PRELOADED))
    os.environ.update(_QUIET)
    return context


@dataclass(frozen=True)
class Workshop:
    """A folder with the recipe of an experiment, and runs of it.

    Args:
        folder: the folder.
        experiment: the experiment.
        watch: as in `cprl.run`.
    """

    folder: Path
    experiment: Experiment
    watch: str = "off"

    def started(self, name: str, *, run: Path | None = None, **how: Any) -> Life:
        """A process that begins a run."""
        recipe = self.folder / "recipe.json"
        if not recipe.exists():
            recipe.write_text(json.dumps(self.experiment.to_recipe(self.folder)))
        run = run or self.folder / name
        argv = ("cprl", "run", str(recipe), "--out", str(run), "--watch", self.watch)
        return Life(argv=argv, run=run, output=self.folder / f"{name}.out", **how)

    def resumed(self, name: str, *more: str, run: Path | None = None, **how: Any) -> Life:
        """A process that resumes a run."""
        run = run or self.folder / name
        argv = ("cprl", "run", str(run), "--resume", "--watch", self.watch, *more)
        return Life(argv=argv, run=run, output=self.folder / f"{name}.out", **how)


@contextmanager
def alive(life: Life) -> Iterator[Process]:
    """A process; whatever happens it is gone afterwards."""
    with Process(life) as process:
        yield process


def lived(life: Life, *, deadline_s: float = DEADLINE_S) -> Ended:
    """Lives until the end."""
    with Process(life) as process:
        return process.end(deadline_s=deadline_s)


def still_alive(processes: list[psutil.Process], within_s: float) -> list[psutil.Process]:
    """Those that have not ended after so many seconds; what has ended, and whose parent has not noticed it
    yet, is not alive."""
    last, left = time.monotonic() + within_s, processes
    while True:
        left = [own for own in left if _is_alive(own)]
        if not left or time.monotonic() >= last:
            return left
        time.sleep(0.01)


def _is_alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


_CHECKPOINT: Final = re.compile(r"(?:training|ending)-(\d{12})-[0-9a-f]{32}\.pt")
_LEARNED: Final = ("steps", "played", "env", "learners", "others", "tracker", "torch")
"""What two states of a training share; the rest holds times."""


def checkpoints(run: Path) -> list[tuple[int, Path]]:
    """The checkpoints of a run with their steps, oldest first."""
    found = (run / "checkpoints").glob("*.pt")
    return sorted((int(match[1]), path) for path in found if (match := _CHECKPOINT.fullmatch(path.name)))


def progress(run: Path) -> tuple[int, int]:
    """The step of the newest checkpoint, and the number of rows in the table; 0 if there is none."""
    kept = checkpoints(run)
    try:
        rows = read_episodes(run).num_rows
    except FileNotFoundError:
        rows = 0
    return (kept[-1][0] if kept else 0), rows


def differences(run: Path, twin: Path) -> list[str]:
    """What is not the same in two finished runs, bit for bit, and what is left that should not be there."""
    there, wanted = _files(run), _files(twin)
    found = [f"{name} is missing" for name in sorted(wanted.keys() - there.keys())]
    found += [f"{name} is left" for name in sorted(there.keys() - wanted.keys())]
    for name in sorted(wanted.keys() & there.keys()):
        different = _comparison(name)
        if different is not None and different(there[name], wanted[name]):
            found.append(f"{name} differs")
    return found


def _files(run: Path) -> dict[str, Path]:
    """All files but recordings, of which each process writes one; names without checksums."""
    paths = [path for path in run.rglob("*") if path.is_file() and path.suffix != ".rrd"]
    return {re.sub(r"-[0-9a-f]{32}", "", path.relative_to(run).as_posix()): path for path in paths}


def _comparison(name: str) -> Callable[[Path, Path], bool] | None:
    """How files of that name are compared; None where times are in them."""
    if name.endswith(".parquet"):
        return _tables_differ
    if name.endswith(".pt"):
        return lambda one, other: not _is_same(_loaded(one), _loaded(other))
    if name == "report.json":
        return lambda one, other: _steps(one) != _steps(other)
    if name.endswith(".png"):
        return lambda one, other: one.read_bytes() != other.read_bytes()
    return None


def _loaded(path: Path) -> Any:
    """Weights, or the part of a checkpoint that holds no times."""
    state = torch.load(path, weights_only=True)
    return {name: state[name] for name in _LEARNED} if _CHECKPOINT.fullmatch(path.name) else state


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and one.numpy().tobytes() == other.numpy().tobytes()
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_is_same(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_is_same, one, other))
    return bool(one == other) or (one != one and other != other)


def _steps(report: Path) -> int:
    return int(json.loads(report.read_text())["steps"])


def _tables_differ(one: Path, other: Path) -> bool:
    """Byte by byte, because `Table.equals` takes NaN for unequal to itself."""
    mine, theirs = (pq.read_table(path).combine_chunks() for path in (one, other))
    return mine.schema != theirs.schema or any(
        mine[name].to_numpy().tobytes() != theirs[name].to_numpy().tobytes() for name in mine.column_names
    )


def tree(run: Path) -> dict[str, bytes]:
    """The content of every file of a run but its lock, to see that nothing of it was touched."""
    paths = [path for path in sorted(run.rglob("*")) if path.is_file() and path.name != "run.lock"]
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in paths}
