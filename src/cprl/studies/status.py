"""Status files: a trial that runs writes there, every second, how far it is, and why it failed.

They lie in the directory of the study, since the processes of a study may run on several hosts that share no
more than a file system.
"""

import json
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final, Self

import psutil
from tensordict import TensorDictBase

from cprl.experiment import Experiment
from cprl.measuring.tracker import Episode
from cprl.runs.files import RunLockedError, write_json
from cprl.system.times import CLOCK, Speed
from cprl.training import Training

PATIENCE_S: Final = 60.0
"""Seconds without a sign of life after which the lock of a process on another host is taken over."""
BEAT_S: Final = 1.0
"""Seconds between two signs of life of a trial."""
LOCKED: Final = 75
"""The exit code of a process whose trial another process is running; EX_TEMPFAIL of sysexits.h."""
STOPPED: Final = (128 + signal.SIGINT, 128 + signal.SIGTERM)
"""The exit codes of a process that was asked to stop, and saved a checkpoint."""


class Status:
    """The status files of a trial.

    Args:
        folder: the folder of the files; writing creates it.
        name: the name of the trial.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.name = name
        self.path = folder / f"{name}.json"
        self.log = folder / f"{name}.log"
        self.failed = folder / f"{name}.failed.txt"

    def read(self) -> dict[str, Any]:
        """Return the last status that the trial wrote; empty if it has written none."""
        try:
            table = json.loads(self.path.read_bytes())
        except (OSError, ValueError):
            return {}
        return table if isinstance(table, dict) else {}

    def fail(self, reason: str, trace: str) -> None:
        """Write the reason of a failure, in the first line, and its trace."""
        with suppress(OSError):  # of a full disk, say; then the reason is in the outcome alone
            self.folder.mkdir(parents=True, exist_ok=True)
            self.failed.write_text(f"{reason}\n\n{trace}", encoding="utf-8", errors="replace")

    def failure(self) -> str | None:
        """Return the reason why the last attempt failed; None if it did not fail."""
        try:
            return self.failed.read_text(encoding="utf-8").partition("\n")[0]
        except (OSError, ValueError):
            return None

    def tidy_up(self) -> None:
        """Forget earlier failures."""
        with suppress(OSError):
            self.failed.unlink(missing_ok=True)


@contextmanager
def process_of_trial(path: Path, experiment: Experiment) -> Iterator["StatusFile"]:
    """Report to the study that started this process: status in a file, and exit code `LOCKED` if another
    process is running the trial."""
    with StatusFile(Status(path.parent, path.stem), experiment) as status:
        try:
            yield status
        except RunLockedError as error:
            sys.stderr.write(f"{error}\n")
            sys.exit(LOCKED)


class StatusFile:
    """Writes the status of a trial every second, and the reason if it fails.

    It is a context manager around the run, and a callback of the training.
    """

    is_extendable = True

    def __init__(self, status: Status, experiment: Experiment) -> None:
        self._status = status
        self._table: dict[str, Any] = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "episodes": 0,
            "of": experiment.length.episodes * experiment.replicas,
            "steps": 0,
            "beat": 0,
        }
        self._compiled_s = CLOCK.total_s
        self._experiment = experiment
        self._speed = Speed()
        """How fast episodes are played since this process began to train."""
        self._is_over = Event()
        self._thread = Thread(target=self._write_on, daemon=True)

    def __enter__(self) -> Self:
        self.write()
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._is_over.set()
        self._thread.join()
        self.write()
        if error is None:
            self._status.tidy_up()
        elif isinstance(error, Exception) and not isinstance(error, RunLockedError):
            lines = traceback.format_exception(error)
            self._status.fail(f"{type(error).__name__}: {error}", "".join(lines))

    def _write_on(self) -> None:
        while not self._is_over.wait(BEAT_S):
            self.write()

    def write(self) -> None:
        """Write the status now; the changed "beat" is a sign of life."""
        self._table["beat"] += 1
        compiling_s = CLOCK.total_s - self._compiled_s
        per_s = self._speed.mean(self._table["episodes"])
        times = {
            "compiling_s": round(compiling_s, 1),
            "is_compiling": CLOCK.is_running,
            "episodes_per_s": None if per_s is None else round(per_s, 4),
            "peak_bytes": peak_bytes(),
        }
        with suppress(OSError):  # of a full disk the run itself says more
            write_json(self._status.path, {**self._table, **times})

    def on_start(self, training: Training) -> None:
        """Continue counting where the training does."""
        self._count(training.steps, training.episodes_played)
        self._speed = Speed(self._table["episodes"])

    def on_step(self, batch: TensorDictBase) -> None:
        """Count the steps of a replica: a turn of each of its worlds."""
        self._count(self._table["steps"] + self._experiment.worlds, self._table["episodes"])

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self._count(self._table["steps"], self._table["episodes"] + 1)

    def _count(self, steps: int, episodes: int) -> None:
        """Store the progress of the training.

        A training whose length is in steps has no fixed number of episodes. Its "episodes" are the share of
        the steps that is done, times the number of episodes that is expected.
        """
        length = self._experiment.length
        if length.is_of_steps:
            episodes = self._table["of"] * steps // length.number
        self._table.update(steps=steps, episodes=episodes)


def is_silent(status: Status, patience_s: float) -> Iterator[bool]:
    """Yield, each time it is advanced, whether a trial has given no sign of life for some seconds.

    It watches whether the status changes, since the clocks of other hosts may differ from this one.
    """
    last = status.read()
    since = time.monotonic()
    while True:
        table = status.read()
        if table != last:
            last = table
            since = time.monotonic()
        yield time.monotonic() - since >= patience_s


def peak_bytes() -> int:
    """Return the peak memory of this process in bytes."""
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
