"""What a trial says of itself while it runs: how far it is, and that it lives; files that may be deleted.

Nothing here decides what a study holds. The files of a trial are `<name>.json`, written every second,
`<name>.log` with what it printed, and `<name>.failed.txt` with the error that ended it.
"""

import json
import os
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

import psutil
from tensordict import TensorDictBase

from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.runs.files import write_json
from cprl.system.compile_clock import CLOCK
from cprl.system.process import cpu
from cprl.training import Training

BEAT_S: Final = 1.0
"""Seconds between two signs of life."""


class Status:
    """The files in which a trial says how far it is.

    Args:
        folder: in which they are; made by whoever writes first.
        name: of the trial.
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


class StatusFile:
    """Writes the status of a trial every second; a context manager.

    Args:
        status: where to.
        experiment: what is run.
    """

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
