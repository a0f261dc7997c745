"""Checkpointer: saves the full state of a training, so that a stopped training resumes bit for bit."""

import hashlib
import os
import re
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import current_thread, main_thread
from types import FrameType, TracebackType
from typing import Any, Final, Protocol, Self

import torch
from rich.console import Console

from cprl.runs.directory import resume_command as command_to_resume
from cprl.runs.files import place_atomically

FOLDER: Final = "checkpoints"
EVERY_S: Final = 300.0
KEPT: Final = 2
"""Checkpoints that are kept: the newest, and one more in case it is unreadable."""

PARTIAL: Final = "training.partial"
"""The suffix of a checkpoint that is being written, or whose writing was interrupted."""

_NAME: Final = re.compile(r"training-(\d{12})-([0-9a-f]{32})\.pt")
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class HasState(Protocol):
    """What a checkpoint saves: `cprl.training.Training`."""

    steps: int

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


class Checkpointer:
    """Saves the state of a training every `every_s` seconds, and when it is stopped; a context manager.

    A checkpoint is written to a temporary file, synced to disk and then renamed; its name includes the
    checksum of its content. On the first SIGINT or SIGTERM the checkpointer finishes the current step, saves
    the state, prints the command that resumes and exits with code 0; the second signal ends the process at
    once. When the block ends without an error the checkpoints are deleted, so save results within the block.

    Args:
        run: the run's directory.
        every_s: seconds between checkpoints, above 0.
        resume_command: the command line that resumes, printed when the run is stopped; by default that of
            this process.
        log_event: called with a text at each checkpoint, e.g. `ViewerCallback.log_event`.
        console: the console for messages; by default standard output.
    """

    def __init__(
        self,
        run: Path,
        *,
        every_s: float = EVERY_S,
        resume_command: str | None = None,
        log_event: Callable[[str], object] | None = None,
        console: Console | None = None,
    ) -> None:
        if not every_s > 0:
            raise ValueError(f"every_s is {every_s}; allowed: a number above 0")
        self.folder, self.every_s = run / FOLDER, every_s
        self.resume_command = command_to_resume(run) if resume_command is None else resume_command
        self.log_event = log_event
        self.console = console or Console()
        self._saved = time.monotonic()
        self._asked_to_stop = False
        self._usual: dict[int, Any] = {}

    def restore(self, training: HasState) -> None:
        """Restores the newest readable checkpoint, if there is one.

        Raises:
            ValueError: if there are checkpoints but none can be read; names each with its reason.
        """
        reasons = []
        for path in reversed(checkpoints_in(self.folder)):
            try:
                state = read_checkpoint(path)
            except ValueError as error:
                reasons.append(str(error))
                continue
            training.load_state_dict(state)
            self.console.print(f"Resuming from step {training.steps:,}: {path}", soft_wrap=True)
            self._saved = time.monotonic()
            return
        if reasons:
            raise ValueError("no checkpoint can be read: " + "; ".join(reasons))

    def after_step(self, training: HasState) -> None:
        """Saves a checkpoint if one is due, or if the process was asked to stop; then stops it."""
        if self._asked_to_stop:
            path = self.save(training)
            self.console.print(
                f"Stopped; everything up to step {training.steps:,} is saved in {path}", soft_wrap=True
            )
            self.console.print(f"To resume: {self.resume_command}", soft_wrap=True, highlight=False)
            raise SystemExit(0)
        if time.monotonic() - self._saved >= self.every_s:
            self.save(training)

    def save(self, training: HasState) -> Path:
        """Writes a checkpoint atomically, and deletes all but the newest two."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = place_atomically(
            self.folder / PARTIAL,
            lambda file: torch.save(training.state_dict(), file),
            lambda partial: self.folder / f"training-{training.steps:012d}-{_checksum(partial)}.pt",
        )
        for old in checkpoints_in(self.folder)[:-KEPT]:
            old.unlink()
        self._saved = time.monotonic()
        if self.log_event:
            self.log_event(f"checkpoint at step {training.steps:,}")
        return path

    def done(self) -> None:
        """Deletes the checkpoints: the run has ended, and its weights and episodes are saved separately."""
        for path in checkpoints_in(self.folder):
            path.unlink()
        (self.folder / PARTIAL).unlink(missing_ok=True)

    def __enter__(self) -> Self:
        # Python handles signals in the main thread only; in other threads handlers stay as they are.
        for number in _SIGNALS if current_thread() is main_thread() else ():
            self._usual[number] = signal.signal(number, self._stop)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for number, usual in self._usual.items():
            signal.signal(number, usual)
        if error is None:
            self.done()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._asked_to_stop:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        self._asked_to_stop = True
        self.console.print("Stopping after this step; signal again to stop at once.")


def checkpoints_in(folder: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    found = folder.iterdir() if folder.is_dir() else iter(())
    return sorted(path for path in found if _NAME.fullmatch(path.name))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint; runs no code of the file.

    Raises:
        ValueError: if the file is not a checkpoint, is truncated or was changed; names file and reason.
    """
    name = _NAME.fullmatch(path.name)
    if name is None:
        raise ValueError(f"{path} is not a checkpoint; allowed: a name like training-<steps>-<checksum>.pt")
    try:
        checksum = _checksum(path)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if checksum != name[2]:
        raise ValueError(f"{path} is truncated or was changed: its checksum is {checksum}, not {name[2]}")
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as error:
        raise ValueError(f"{path} is not the state of a training: {error}") from error
    return state


def _checksum(path: Path) -> str:
    """BLAKE2b of a file's content, 16 bytes in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(1 << 24):
            digest.update(block)
    return digest.hexdigest()
