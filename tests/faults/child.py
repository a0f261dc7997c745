"""The process that a fault happens to: `cprl` with a command line, which reports where it is."""

import multiprocessing
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

STAGES: Final = ("start", "training", "weights", "evaluation", "figures")
"""A run's stages. "start" ends with the first checkpoint of a process, before which torch compiles."""

_FUNCTIONS: Final = {
    "start": "train",
    "weights": "save_weights",
    "evaluation": "evaluate_population",
    "figures": "training_curve",
}
"""The functions of `cprl.running` whose calls begin a stage."""

_WRITES: Final = os.O_WRONLY | os.O_RDWR
_CHANGES: Final = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")


@dataclass(frozen=True, kw_only=True)
class Life:
    """What a process does.

    A file operation is an open for writing, a rename, removal or sync below the run's directory.
    """

    argv: tuple[str, ...]
    """The command line, `cprl` first."""
    run: Path
    """The run's directory."""
    output: Path
    """The file that gets standard output; standard error gets one beside it, with the suffix .err."""
    every_s: float = 0.05
    """Seconds between checkpoints."""
    pause: tuple[str, int] | None = None
    """A stage and n: before the n-th file operation of that stage, counted from 1, the process waits."""
    user: int | None = None
    """The number of the user that it becomes."""
    cache: Path | None = None
    """A folder of that user for compiled rules."""


class Reporter:
    """Sends each stage that begins, and the number of file operations of the one before.

    Args:
        pipe: gets ("stage", name, operations before) and, when the process waits, ("pause", operation).
        life: what the process does.
    """

    def __init__(self, pipe: Connection, life: Life) -> None:
        self._pipe, self._run, self._pause = pipe, str(life.run), life.pause
        self._stage, self._operations = "", 0

    def begin(self, stage: str) -> None:
        """A stage begins."""
        self._pipe.send(("stage", stage, self._operations))
        self._stage, self._operations = stage, 0

    def before(self, operation: str, path: object) -> None:
        """A file operation is about to happen."""
        name = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        if not name.startswith(self._run):
            return
        self._operations += 1
        if self._pause == (self._stage, self._operations):
            self._pipe.send(("pause", f"{operation} {name[len(self._run) + 1 :]}"))
            self._pipe.recv()

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        """An audit hook, see `sys.addaudithook`."""
        if event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITES:
            self.before("open", arguments[0])
        elif event in _CHANGES:
            self.before(event, arguments[0])
            if event == "os.rename" and self._stage == "start" and ".partial" in str(arguments[0]):
                self.begin("training")


def live(life: Life, pipe: Connection) -> None:
    """The body of the process."""
    for number, path in ((1, life.output), (2, life.output.with_suffix(".err"))):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666), number)
    multiprocessing.set_start_method(None, force=True)  # as where nothing was forked
    from cprl import cli, running
    from cprl.runs.checkpoints import Checkpointer

    Checkpointer.__init__.__kwdefaults__["every_s"] = life.every_s
    reporter = Reporter(pipe, life)
    for stage, name in _FUNCTIONS.items():
        setattr(running, name, _reporting(getattr(running, name), reporter, stage))
    fsync = os.fsync

    def synced(number: int) -> None:
        reporter.before("fsync", os.readlink(f"/proc/self/fd/{number}"))
        fsync(number)

    os.fsync = synced
    sys.addaudithook(reporter.hook)
    if life.user is not None:
        os.setgid(life.user)
        os.setuid(life.user)
        os.environ["CPRL_CACHE"] = str(life.cache)
    sys.argv = list(life.argv)
    cli.main()
    reporter.begin("end")


def _reporting(function: Callable[..., Any], reporter: Reporter, stage: str) -> Callable[..., Any]:
    @wraps(function)
    def reported(*arguments: Any, **how: Any) -> Any:
        reporter.begin(stage)
        return function(*arguments, **how)

    return reported
