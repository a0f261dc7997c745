"""Checkpointer: saves the full state of a training, so that a stopped training resumes bit for bit."""

import errno
import os
import re
import signal
import time
from pathlib import Path
from typing import Any, Final, NoReturn, Self

import torch

from cprl.runs.files import (
    TRAINING_STATE_FORMAT,
    RunLock,
    checksum,
    refuse_newer,
    remove_partial,
    verify,
    write_atomically,
)
from cprl.runs.recipe import resume_command
from cprl.system.output import RESUME_PREFIX, say
from cprl.system.process import on_signals
from cprl.system.times import CLOCK

CHECKPOINTS: Final = "checkpoints"
EVERY_S: Final = 300.0
MOST_LOST_S: Final = 60.0
"""Seconds of training, without compilation, that a stop may lose: while a step waits for a compiler, or
between the last step of a run and its end."""
KEPT_CHECKPOINTS: Final = 2
"""Checkpoints that are kept: the newest, and one more in case it is unreadable."""

_FILE_NAME: Final = re.compile(r"(training|ending)-(\d{12})-[0-9a-f]{32}\.pt")


class Checkpointer:
    """A context manager that saves the state of a `Training` every `every_s` seconds, and when it is stopped.

    Within its block the run is locked, see `RunLock`. On the first SIGINT or SIGTERM the checkpointer
    finishes the step, saves the state, prints the command that resumes the run, and raises the `interruption`
    of that signal; the second signal ends the process at once. The first signal raises immediately before the
    training has begun, after it is over, and while code is compiled if less than a minute would be lost.
    Checkpoints stay until `done` is called, when all that follows the training is finished.

    Args:
        run: the run's directory; created if it does not exist.
        every_s: seconds between checkpoints, above 0.
        keep_ending: whether the last state before any replica can play its last episode, or the state after
            the last step, is kept after `done`; a longer training continues from it bit for bit.
    """

    def __init__(
        self,
        run: Path,
        *,
        every_s: float = EVERY_S,
        keep_ending: bool = True,
        take_over: bool = False,
    ) -> None:
        if not every_s > 0:
            raise ValueError(f"every_s is {every_s}; allowed: a number above 0")
        self.run = run
        self.folder = run / CHECKPOINTS
        self.every_s = every_s
        self.keep_ending = keep_ending
        self.resume_command = resume_command(run)
        self.has_begun = False
        """True once a training has begun, or was resumed."""
        self._mark_saved()
        self._is_training = True
        self._asked_to_stop: int | None = None
        """The signal that asked the training to stop."""
        self._has_ending = not keep_ending
        self._folder_identity: tuple[int, int] | None = None
        self._lock = RunLock(run, take_over=take_over)
        self._last_finite: Path | None = None

    def restore(self, training: Any) -> None:
        """Restore the newest readable checkpoint, if there is one.

        Raises:
            ValueError: if there are checkpoints, and none can be read; says why not.
        """
        reasons: list[str] = []
        cause: Exception | None = None
        for path in reversed(checkpoints_in(self.folder)):
            try:
                training.load_state_dict(read_checkpoint(path))
            except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
                reason = f"{path} does not hold the state of this training: {error!r}"
                if isinstance(error, ValueError):
                    reason = str(error)
                reasons.append(reason)
                cause = error
                continue
            for reason in reasons:
                say(f"Passed over: {reason}")
            say(f"Resuming from step {training.steps:,}: {path}")
            self._mark_saved()
            self._last_finite = path if training.is_finite else None
            self._has_ending |= training.is_ending
            self.has_begun = True
            return
        if reasons:
            raise ValueError("no checkpoint can be read: " + "; ".join(reasons)) from cause
        self._mark_saved()
        self.has_begun = True

    def after_step(self, training: Any) -> None:
        """Save a checkpoint if one is due, or if the process was asked to stop; then stop it."""
        ends = training.is_ending and not self._has_ending
        kind = "ending" if ends else "training"
        if self._asked_to_stop is not None:
            path = self.save(training, kind=kind)
            say(f"Stopped; everything up to step {training.steps:,} is saved in {path}")
            self._raise_interruption(self._asked_to_stop)
        self._is_training = not training.is_over
        every_s = MOST_LOST_S if training.is_over else self.every_s
        if ends or time.monotonic() - self._saved >= every_s:
            self.save(training, kind=kind)
        self._has_ending |= ends

    def save(self, training: Any, *, kind: str = "training") -> Path:
        """Write a checkpoint atomically, and delete older ones of its kind: two stay of "training", one of
        "ending". If a training goes on with weights that are not finite, the last finite checkpoint is also
        kept as "sound-<its name>".

        Raises:
            OSError: if it cannot be written, or if the run's directory was deleted; earlier checkpoints are
                intact.
        """
        self._refuse_deleted()
        self.folder.mkdir(exist_ok=True)
        path = write_atomically(
            self.folder / kind,
            lambda file: torch.save(training.state_dict(), file),
            name=lambda partial: f"{kind}-{training.steps:012d}-{checksum(partial)}.pt",
        )
        if training.is_finite:
            self._last_finite = path
        elif self._last_finite is not None and self._last_finite.exists():
            last_finite = self._last_finite.with_name(f"sound-{self._last_finite.name}")
            try:
                os.link(self._last_finite, last_finite)
            except OSError:  # the file system has no hard links
                self._last_finite.replace(last_finite)
            self._last_finite = None
        count = 1 if kind == "ending" else KEPT_CHECKPOINTS
        same = [old for old in checkpoints_in(self.folder) if old.name.startswith(kind)]
        for old in same[:-count]:
            old.unlink()
        self._mark_saved()
        return path

    def done(self) -> None:
        """Delete the checkpoints, except the one of `keep_ending`, when all that follows the training is
        finished."""
        for path in checkpoints_in(self.folder):
            if not (self.keep_ending and is_ending(path)):
                path.unlink()

    def _mark_saved(self) -> None:
        self._saved = time.monotonic()
        self._compiled_s = CLOCK.total_s

    def _refuse_deleted(self) -> None:
        """Raise if the run's directory was deleted or replaced meanwhile; nothing is recreated."""
        if self._folder_identity is not None and self._folder_identity != _identity_of(self.run):
            what = "the directory was deleted while the run was written; the run ends"
            raise FileNotFoundError(errno.ENOENT, what, str(self.run))

    def __enter__(self) -> Self:
        self.run.mkdir(exist_ok=True)
        self._lock.__enter__()
        self._folder_identity = _identity_of(self.run)
        remove_partial(self.run, self.folder, self.run / "evaluation", self.run / "figures")
        self._signals = on_signals(self._on_signal)
        self._signals.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._signals.__exit__(None, None, None)
        self._lock.__exit__(*error)

    def _on_signal(self, number: int) -> None:
        if self._asked_to_stop is not None:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        self._asked_to_stop = number
        if not self.has_begun:
            raise interruption(number)
        lost_s = time.monotonic() - self._saved - (CLOCK.total_s - self._compiled_s)
        if CLOCK.is_running and lost_s < MOST_LOST_S:
            say("Stopped while code was compiled; what came after the newest checkpoint is played again.")
            self._raise_interruption(number)
        if self._is_training:
            say("Stopping after this step; signal again to stop at once.")
            return
        say("Stopped after the training.")
        self._raise_interruption(number)

    def _raise_interruption(self, number: int) -> NoReturn:
        say(f"{RESUME_PREFIX}{self.resume_command}")
        raise interruption(number)


def interruption(number: int) -> BaseException:
    """Return the exception that ends a process after a signal: `KeyboardInterrupt` for SIGINT, which Python
    turns into exit code 130, and `SystemExit` with code 143 for SIGTERM, like shells."""
    return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)


def _identity_of(folder: Path) -> tuple[int, int] | None:
    """Return the identity of a folder, which differs from that of any later folder of its name; None without
    one."""
    try:
        status = folder.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    paths = folder.iterdir() if folder.is_dir() else iter(())
    return sorted((path for path in paths if _FILE_NAME.fullmatch(path.name)), key=steps_of)


def steps_of(path: Path) -> int:
    """Return the step of a checkpoint, by its name."""
    return int(path.name.split("-")[1])


def is_ending(path: Path) -> bool:
    """Return whether a longer training can continue from a checkpoint."""
    return path.name.startswith("ending")


def endings_of(run: Path) -> list[Path]:
    """Return the checkpoints of a run from which a longer training can continue, oldest first."""
    return list(filter(is_ending, checkpoints_in(run / CHECKPOINTS)))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read the state in a checkpoint, without running code of the file.

    Raises:
        ValueError: for any other file, a damaged one, and one that a newer cprl wrote.
    """
    if not _FILE_NAME.fullmatch(path.name):
        raise ValueError(f"{path} is not a checkpoint; allowed: a name like training-<steps>-<checksum>.pt")
    state = read_tensors(path, "is not the state of a training")
    refuse_newer(path, state, TRAINING_STATE_FORMAT)
    return state


def read_tensors(path: Path, refusal: str) -> dict[str, Any]:
    """Read tensors by name that `torch.save` wrote, check them for damage, and run no code of the file.

    Args:
        refusal: the message about a file with other content.

    Raises:
        ValueError: for a damaged file, and for one with other content.
    """
    try:
        verify(path)
        content = torch.load(path, weights_only=True)
    except ValueError:
        raise
    except Exception as error:  # torch raises errors of many kinds for damaged files
        raise ValueError(f"{path} {refusal}: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} {refusal}, but a {type(content).__name__}")
    return content
