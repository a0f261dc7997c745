"""Files of a run: complete or absent, with their formats, locks and checksums.

`manifest.json` lists the checksums of final weights, tables of episodes and the state of transforms, verified
whenever one is read. `recipe.json`, which people read and copy, the recording and figures are not in it. A
checkpoint has its checksum in its name, and the journal of episodes one for each episode. A format is a
number, which grows when an older cprl could not read what a newer one writes; docs/experiments.md ("Versions
of files") says which file has which.
"""

import hashlib
import json
import os
import secrets
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

from cprl.checks import check_nesting, shown

_PARTIAL: Final = f"*.{8 * '[0-9a-f]'}.partial"
"""The names of files that are being written, or whose writing was interrupted."""


def refuse_to_write_over(path: Path) -> None:
    """Checks before hours of work that its output file does not exist.

    Raises:
        FileExistsError: if the file exists.
    """
    if os.path.lexists(path):  # a link to a file that is not there would be written through
        raise FileExistsError(f"{path} exists and is not overwritten; use another name")


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a temporary file, syncs it to disk and renames it.

    Args:
        path: the file; an existing file is replaced.
    """
    place_atomically(path, write, lambda partial: path)


def place_atomically(path: Path, write: Callable[[BinaryIO], object], name: Callable[[Path], Path]) -> Path:
    """Like `write_atomically`, for a file whose name depends on its content.

    Args:
        path: names the temporary file, to which each writer adds letters of its own.
        name: returns the final name, given the complete temporary file.

    Returns:
        The file.
    """
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with open(partial, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        path = name(partial)
        os.replace(partial, path)
        sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(partial)) from error
        raise
    return path


def remove_partial(*folders: Path) -> None:
    """Removes the temporary files that killed processes left in folders, where nobody else writes now."""
    for folder in folders:
        for path in folder.glob(_PARTIAL):
            path.unlink(missing_ok=True)


def write_json(path: Path, value: object) -> None:
    """Writes a JSON value atomically."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    refuse_special(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        check_nesting(value, "it")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} holds a {type(value).__name__}; allowed: a JSON object")
    return value


def refuse_special(path: Path) -> None:
    """Raises a ValueError for a directory, and for a pipe, which would wait for somebody to write into it."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a file")


_APART: Final = ("runs", "runs-earlier")
"""Folders of a study that may be links, as to another disk: each run in them is looked at by itself."""
_OF_OTHERS: Final = ("wandb",)
"""Folders in which a logger keeps links of its own."""


def refuse_links(folder: Path) -> None:
    """Refuses the directory of a run or study if a symbolic link leads out of it, to what would be written.

    The directory itself may be reached through a link.
    """
    place = Path(os.path.realpath(folder))
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name not in _APART]
        for path in (Path(parent, name) for name in (*folders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(place):
                raise ValueError(
                    f"{path} is a symbolic link out of {folder}, where nothing is written; replace it by a "
                    "copy, or remove it"
                )
        folders[:] = [name for name in folders if name not in _OF_OTHERS]


def checksum(path: Path) -> str:
    """BLAKE2b of a file's content, 16 bytes in hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    with open(path, "rb") as file:
        while block := file.read(1 << 24):
            digest.update(block)
    return digest.hexdigest()


def digest_of(text: str) -> str:
    """BLAKE2b of a text, 16 bytes in hexadecimal."""
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def sync_folder(folder: Path) -> None:
    """Syncs a folder, so that a new name in it survives a power failure, if the system supports it."""
    if sys.platform == "win32":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


RECIPE_FORMAT: Final = 2
"""Of `recipe.json`, and of the journal and `report.json` beside it."""
MANIFEST_FORMAT: Final = 1
"""Of `manifest.json`, and of what it lists: weights, tables, transforms, decisions."""
TRAINING_STATE_FORMAT: Final = 3
"""Of checkpoints."""
STUDY_FORMAT: Final = 1
"""Of `study.json`."""
STUDY_TABLE_FORMAT: Final = 1
"""Of the table of a study."""


def written_by_another(recipe: object) -> str:
    """The end of a message about a recipe that cannot be read: which cprl wrote it, where that was another
    than this; else nothing."""
    versions = recipe.get("versions") if isinstance(recipe, Mapping) else None
    wrote = versions.get("cprl") if isinstance(versions, Mapping) else None
    here = version("cprl")
    return f"; cprl {shown(wrote)} wrote it, and this is {here}" if wrote not in (None, here) else ""


def refuse_newer(what: object, table: Mapping[str, Any], newest: int) -> None:
    """Refuses what a newer cprl wrote; any other format is left to the reader.

    Args:
        newest: the highest format that this version reads.
    """
    found = table.get("format")
    if isinstance(found, int) and not isinstance(found, bool) and found > newest:
        raise ValueError(
            f"{what} has the format {shown(found)}, and cprl {version('cprl')} reads up to {newest}: a newer "
            "cprl wrote it; upgrade cprl"
        )


try:
    import fcntl
except ImportError:  # Windows has no flock; runs are not locked there
    fcntl = None  # type: ignore[assignment]

LOCK_FILE: Final = "run.lock"


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
    """

    def __init__(self, run: Path, *, take_over: bool = False) -> None:
        self.path, self._take_over = run / LOCK_FILE, take_over
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
            _write_holder(file, {**_this_process(), **more})
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

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
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


def _write_holder(file: int, holder: dict[str, Any]) -> None:
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


MANIFEST_FILE: Final = "manifest.json"


def write_listed(run: Path, name: str, write: Callable[[BinaryIO], object]) -> Path:
    """Writes a file of a run atomically, and its checksum into the manifest.

    Args:
        run: the run's directory, which exists.
        name: the file's path in it, e.g. "checkpoints/final.pt"; its folder is made.

    Returns:
        The file.
    """
    path = run / name
    unlist(run, name)
    if path.parent != run:  # a run that was deleted is not made again
        path.parent.mkdir(exist_ok=True)
    write_atomically(path, write)
    enlist(run, name)
    return path


def enlist(run: Path, *names: str) -> None:
    """Writes the checksums of files into the manifest; a file that was listed is listed anew."""
    files = _files(run)
    files.update({name: checksum(run / name) for name in names})
    _write_manifest(run, files)


def unlist(run: Path, *names: str) -> None:
    """Removes files from the manifest, which is to be done before they are replaced: a kill in between must
    not leave the checksum of another content."""
    files = _files(run)
    left = {name: own for name, own in files.items() if name not in names}
    if left != files:
        _write_manifest(run, left)


def rename_listed(run: Path, name: str, new: str) -> None:
    """Renames a file or folder of a run; checksums stay with their files. What has the new name is replaced,
    but for a folder, whose files are."""
    source, target = run / name, run / new
    if source.is_dir():
        target.mkdir(exist_ok=True)
        for path in sorted(source.iterdir()):
            rename_listed(run, f"{name}/{path.name}", f"{new}/{path.name}")
        source.rmdir()
        return
    listed = _files(run).get(name)
    unlist(run, name, new)
    source.replace(target)
    if listed is not None:
        _write_manifest(run, {**_files(run), new: listed})


def verify(path: Path) -> None:
    """Checks a file against the manifest of its run; files that no manifest lists are not checked.

    Args:
        path: a file in a run's directory, or in a folder of it.
    """
    for run in (path.parent, path.parent.parent):
        if (run / MANIFEST_FILE).exists():
            listed = _files(run).get(path.relative_to(run).as_posix())
            if listed is not None and (found := checksum(path)) != listed:
                raise ValueError(
                    f"{path} is damaged or was changed: its checksum is {found}; {run / MANIFEST_FILE} has "
                    f"{listed}"
                )
            return


def refuse_missing(run: Path) -> None:
    """Raises a ValueError where a file that the manifest lists is not there; names each."""
    missing = [name for name in _files(run) if not (run / name).exists()]
    if missing:
        raise ValueError(
            f"{run} lacks {', '.join(missing)}, which its {MANIFEST_FILE} lists; restore it, or take "
            "another run"
        )


def _files(run: Path) -> dict[str, str]:
    """The checksum of each listed file, by its path in the run."""
    path = run / MANIFEST_FILE
    try:
        table = read_json(path)
    except FileNotFoundError:
        return {}
    refuse_newer(path, table, MANIFEST_FORMAT)
    files = table.get("files") if table.get("format") == MANIFEST_FORMAT else None
    if not isinstance(files, dict) or not all(isinstance(own, str) for own in files.values()):
        raise ValueError(f"{path} is not the manifest of a run, of the format {MANIFEST_FORMAT}")
    return files


def _write_manifest(run: Path, files: dict[str, str]) -> None:
    listed = dict(sorted(files.items()))
    write_json(
        run / MANIFEST_FILE, {"format": MANIFEST_FORMAT, "checksum": "blake2b, 16 bytes", "files": listed}
    )
