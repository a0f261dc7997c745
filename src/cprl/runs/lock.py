"""RunLock: at most one process writes a run's directory."""

import json
import os
import socket
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from cprl.runs.files import refuse_links

try:
    import fcntl
except ImportError:  # Windows has no flock; runs are not locked there
    fcntl = None  # type: ignore[assignment]

FILE_NAME: Final = "run.lock"


class RunLockedError(ValueError):
    """Another process writes the run, or may do so; the message names it."""


class RunLock:
    """Holds the lock of a run's directory; a context manager.

    The lock is a `flock` on `run.lock`, which the system releases when the process dies, however it dies. The
    file names host, process and start time. Where a file system is shared by several hosts a `flock` may not
    reach the others, so a lock file that names another host is refused too, unless it is taken over. A clean
    end removes the file. On Windows, which has no `flock`, nothing is locked.

    Args:
        run: the run's directory, which exists.
        take_over: whether to take the lock that a process on another host left behind. A lock that a living
            process on this host holds is never taken.

    Raises:
        RunLockedError: names the process that holds the lock.
        ValueError: if a symbolic link leads out of the directory, see `cprl.runs.files.refuse_links`.
    """

    def __init__(self, run: Path, *, take_over: bool = False) -> None:
        self.path, self._take_over = run / FILE_NAME, take_over
        self._file: int | None = None

    def __enter__(self) -> Self:
        refuse_links(self.path.parent)
        if fcntl is None:
            return self
        while not self._is_taken():
            pass
        return self

    def _is_taken(self) -> bool:
        """Locks the file and writes who holds it; False if it was removed in the meantime."""
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise RunLockedError(
                    f"{self.path.parent} is being written by {_named(_holder(file))}; wait until it ends, or "
                    "stop it"
                ) from None
            if not self._is_still_there(file):
                os.close(file)
                return False
            self._refuse_another_host(_holder(file))
            self._sign(file)
        except BaseException:
            with suppress(OSError):
                os.close(file)
            raise
        self._file = file
        return True

    def _sign(self, file: int, **more: str) -> None:
        """Writes who holds the lock; where the disk is full the file is removed."""
        try:
            _write(file, {**_this_process(), **more})
        except OSError as error:
            self.path.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def _is_still_there(self, file: int) -> bool:
        """Whether the locked file is the one in the directory: its holder removes it at the end."""
        try:
            return os.path.samestat(os.fstat(file), os.stat(self.path))
        except FileNotFoundError:
            return False

    def _refuse_another_host(self, holder: dict[str, Any]) -> None:
        host = holder.get("host")
        if host in (None, socket.gethostname()) or self._take_over:
            return
        raise RunLockedError(
            f"{self.path.parent} is locked by {_named(holder)}, on another host than this, "
            f"{socket.gethostname()}; if that process has ended: --take-over (in Python take_over=True)"
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._file is None:
            return
        if self._is_still_there(self._file):  # nobody else's, where the directory was deleted and made again
            with suppress(OSError):
                self.path.unlink()
        os.close(self._file)
        self._file = None


class StudyLock(RunLock):
    """Holds the lock of a study's directory together with all who run the same study; a context manager.

    Args:
        out: the study's directory, which exists.
        study: what tells the study from others, written into the lock file.

    Raises:
        RunLockedError: names the process that runs another study there.
    """

    def __init__(self, out: Path, study: str) -> None:
        super().__init__(out)
        self._study = study
        self.is_alone = True
        """Whether nobody else is known to have run the study when it was locked."""

    def _is_taken(self) -> bool:
        self.is_alone = False
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            with suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _holder(file).get("host") in (None, socket.gethostname()):
                    self._sign(file, study=self._study)
                    self.is_alone = True
            fcntl.flock(file, fcntl.LOCK_SH)  # whoever else had it exclusively had it for this moment
            if not self._is_still_there(file):
                os.close(file)
                return False
            holder = _holder(file)
            if holder.get("study") != self._study:
                raise RunLockedError(
                    f"{self.path.parent} is run as another study by {_named(holder)}; wait until it ends, or "
                    f"take another directory; if it ended with its machine, delete {self.path}"
                )
        except BaseException:
            with suppress(OSError):
                os.close(file)
            raise
        self._file = file
        return True

    def __exit__(self, *error: Any) -> None:
        """Leaves the lock to those who still run the study, if there are any."""
        if self._file is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            others = _holder(self._file).get("host") != socket.gethostname()
        except BlockingIOError:
            others = True
        if not others:
            super().__exit__(*error)
            return
        os.close(self._file)
        self._file = None


def _this_process() -> dict[str, Any]:
    started = datetime.now().astimezone().isoformat(timespec="seconds")
    return {"host": socket.gethostname(), "pid": os.getpid(), "started": started}


def _write(file: int, holder: dict[str, Any]) -> None:
    os.ftruncate(file, 0)
    os.pwrite(file, (json.dumps(holder) + "\n").encode(), 0)


def _holder(file: int) -> dict[str, Any]:
    """Who wrote the lock file; empty if it cannot be read, e.g. because its process is just starting."""
    try:
        holder = json.loads(os.pread(file, 4096, 0))
    except (ValueError, RecursionError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _named(holder: dict[str, Any]) -> str:
    if not holder:
        return "another process"
    return f"process {holder.get('pid')} on {holder.get('host')} since {holder.get('started')}"
