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
from cprl.system.output import RESUMES, say
from cprl.system.process import at_signals
from cprl.system.times import CLOCK

FOLDER: Final = "checkpoints"
EVERY_S: Final = 300.0
MOST_LOST_S: Final = 60.0
"""Seconds of training, compiling apart, that a stop may lose: where a step would wait for a compiler, or
between the last step of a run and its end."""
KEPT: Final = 2
"""Checkpoints that are kept: the newest, and one more in case it is unreadable."""

_NAME: Final = re.compile(r"(training|ending)-(\d{12})-[0-9a-f]{32}\.pt")


class Checkpointer:
    """Saves the state of a `Training` every `every_s` seconds, and when it is stopped; a context
    manager.

    Within its block the run is locked, see `RunLock`. On the first SIGINT or SIGTERM the checkpointer
    finishes the step, saves the state, prints the command that resumes and raises what `interruption` makes
    of the signal; the second signal ends the process at once. Once the training is over, the first raises it,
    as before the training has begun, and while code is compiled and less than a minute would be lost. The
    checkpoints stay until `done` is called, when whatever follows the training is finished too.

    Args:
        run: the run's directory, which is made if it does not exist.
        every_s: seconds between checkpoints, above 0.
        keep_ending: whether the last state before a replica may play its last episode, or that after the last
            step, is kept even after `done`: from there a longer training continues bit for bit.
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
        self.folder = run / FOLDER
        self.every_s = every_s
        self.keep_ending = keep_ending
        self.resume_command = resume_command(run)
        self.has_begun = False
        """Whether a training has begun, or was resumed."""
        self._mark_saved()
        self._is_training = True
        self._asked_to_stop: int | None = None
        """The signal."""
        self._has_ending = not keep_ending
        self._place: tuple[int, int] | None = None
        self._lock = RunLock(run, take_over=take_over)
        self._sound: Path | None = None

    def restore(self, training: Any) -> None:
        """Restore the newest readable checkpoint, if there is one."""
        reasons: list[str] = []
        cause: Exception | None = None
        for path in reversed(checkpoints_in(self.folder)):
            try:
                training.load_state_dict(read_checkpoint(path))
            except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
                other = f"{path} does not hold the state of this training: {error!r}"
                reasons.append(str(error) if isinstance(error, ValueError) else other)
                cause = error
                continue
            for reason in reasons:
                say(f"Passed over: {reason}")
            say(f"Resuming from step {training.steps:,}: {path}")
            self._mark_saved()
            self._sound = path if training.is_sound else None
            self._has_ending |= training.is_ending
            self.has_begun = True
            return
        if reasons:
            raise ValueError("no checkpoint can be read: " + "; ".join(reasons)) from cause
        self._mark_saved()
        self.has_begun = True

    def after_step(self, training: Any) -> None:
        """Saves a checkpoint if one is due, or if the process was asked to stop; then stops it."""
        ends = training.is_ending and not self._has_ending
        if self._asked_to_stop is not None:
            path = self.save(training, kind="ending" if ends else "training")
            say(f"Stopped; everything up to step {training.steps:,} is saved in {path}")
            self._stop_now(self._asked_to_stop)
        self._is_training = not training.is_over
        if ends:
            self.save(training, kind="ending")
            self._has_ending = True
        elif time.monotonic() - self._saved >= (MOST_LOST_S if training.is_over else self.every_s):
            self.save(training)

    def save(self, training: Any, *, kind: str = "training") -> Path:
        """Writes a checkpoint atomically, and deletes all of its kind but the newest two, or the newest
        "ending". Of a training that goes on with agents whose weights are not finite, the last
        checkpoint before is kept as "sound-<its name>" too.

        Raises:
            OSError: if it cannot be written, or somebody deleted the run; those before it are intact.
        """
        self._refuse_deleted()
        self.folder.mkdir(exist_ok=True)
        path = write_atomically(
            self.folder / kind,
            lambda file: torch.save(training.state_dict(), file),
            name=lambda partial: f"{kind}-{training.steps:012d}-{checksum(partial)}.pt",
        )
        if training.is_sound:
            self._sound = path
        elif self._sound is not None and self._sound.exists():
            last_sound = self._sound.with_name(f"sound-{self._sound.name}")
            try:
                os.link(self._sound, last_sound)
            except OSError:  # a file system without hard links
                self._sound.replace(last_sound)
            self._sound = None
        same = [old for old in checkpoints_in(self.folder) if is_ending(old) == (kind == "ending")]
        for old in same[: -1 if kind == "ending" else -KEPT]:
            old.unlink()
        self._mark_saved()
        return path

    def done(self) -> None:
        """Delete the checkpoints, but for that of `keep_ending`: all that follows the training is there."""
        for path in checkpoints_in(self.folder):
            if not (self.keep_ending and is_ending(path)):
                path.unlink()

    def _mark_saved(self) -> None:
        self._saved = time.monotonic()
        self._compiled_s = CLOCK.total_s

    def _refuse_deleted(self) -> None:
        """End a run whose directory was deleted, or made again by somebody else; nothing is recreated."""
        if self._place is not None and self._place != _place_of(self.run):
            what = "the directory was deleted while the run was written; the run ends"
            raise FileNotFoundError(errno.ENOENT, what, str(self.run))

    def __enter__(self) -> Self:
        self.run.mkdir(exist_ok=True)
        self._lock.__enter__()
        self._place = _place_of(self.run)
        remove_partial(self.run, self.folder, self.run / "evaluation", self.run / "figures")
        self._signals = at_signals(self._stop)
        self._signals.__enter__()
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        self._signals.__exit__(None, None, None)
        self._lock.__exit__(kind, error, traceback)

    def _stop(self, number: int) -> None:
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
            self._stop_now(number)
        if self._is_training:
            say("Stopping after this step; signal again to stop at once.")
            return
        say("Stopped after the training.")
        self._stop_now(number)

    def _stop_now(self, number: int) -> NoReturn:
        say(f"{RESUMES}{self.resume_command}")
        raise interruption(number)


def interruption(number: int) -> BaseException:
    """Return what ends a process that saved everything after a signal: `KeyboardInterrupt` for SIGINT, which
    Python turns into exit code 130, and `SystemExit` with code 143 for SIGTERM, as shells count."""
    return KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)


def _place_of(folder: Path) -> tuple[int, int] | None:
    """What tells a folder from any that is made in its place; None where there is none."""
    try:
        status = folder.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first."""
    paths = folder.iterdir() if folder.is_dir() else iter(())
    return sorted((path for path in paths if _NAME.fullmatch(path.name)), key=steps_of)


def steps_of(path: Path) -> int:
    """The step of a checkpoint, by its name."""
    return int(path.name.split("-")[1])


def is_ending(path: Path) -> bool:
    """Whether a checkpoint is the one from which a longer training can go on."""
    return path.name.startswith("ending")


def endings_of(run: Path) -> list[Path]:
    """Return the checkpoints of a run from which a longer training can go on, oldest first."""
    return list(filter(is_ending, checkpoints_in(run / FOLDER)))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read the state in a checkpoint; runs no code of the file."""
    if not _NAME.fullmatch(path.name):
        raise ValueError(f"{path} is not a checkpoint; allowed: a name like training-<steps>-<checksum>.pt")
    state = read_tensors(path, "is not the state of a training")
    refuse_newer(path, state, TRAINING_STATE_FORMAT)
    return state


def read_tensors(path: Path, refusal: str) -> dict[str, Any]:
    """Read what `torch.save` wrote, tensors by name, checked for damage; runs no code of the file.

    Args:
        refusal: what a message says of a file that holds something else.
    """
    try:
        verify(path)
        content = torch.load(path, weights_only=True)
    except ValueError:
        raise
    except Exception as error:  # of whatever kind torch finds for what a file may hold
        raise ValueError(f"{path} {refusal}: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} {refusal}, but a {type(content).__name__}")
    return content
