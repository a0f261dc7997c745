"""Files of a run: complete or absent, checked for damage, in a directory that one process writes.

A file is written under another name, synced and renamed. Weights, tables and checkpoints have a checksum,
which `verify` compares whenever one is read: a checkpoint in its name, all others in `manifest.json`.
`recipe.json`, which people read and copy, the recording and figures have none. A format is a number, which
grows when an older cprl could not read what a newer one writes; docs/experiments.md ("Versions of files")
says which file has which.
"""

import hashlib
import json
import os
import re
import secrets
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from shutil import copyfileobj
from typing import Any, BinaryIO, Final, Self

from cprl.runs.length import without_length
from cprl.system.output import legible
from cprl.values import refuse_other_keys, shown

try:
    import fcntl
except ImportError:  # Windows has no flock; runs are not locked there
    fcntl = None  # type: ignore[assignment]

RECIPE_FILE: Final = "recipe.json"
REPORT: Final = "report.json"
"""Written when everything of a run is finished."""
RECIPE_FORMAT: Final = 2
"""Of `recipe.json`, and of the journal and `report.json` beside it."""
MANIFEST_FORMAT: Final = 1
"""Of `manifest.json`, and of what it lists: weights, tables, transforms, decisions."""
TRAINING_STATE_FORMAT: Final = 8
"""Of checkpoints."""
STUDY_FORMAT: Final = 1
"""Of `study.json`."""
STUDY_TABLE_FORMAT: Final = 2
"""Of the table of a study."""

_MOST_NESTED: Final = 128
"""How deep a JSON file may be nested: what a `Custom` may be, and as much around it."""
_PARTIAL: Final = f"*.{8 * '[0-9a-f]'}.partial"
"""The names of files that are being written, or whose writing was interrupted."""


def refuse_to_write_over(path: Path) -> None:
    """Refuse a file that exists by a FileExistsError, before hours of work."""
    if os.path.lexists(path):  # a link to a file that is not there would be written through
        raise FileExistsError(f"{path} exists and is not overwritten; use another name")


def write_atomically(
    path: Path, write: Callable[[BinaryIO], object], *, name: Callable[[Path], str] | None = None
) -> Path:
    """Write a temporary file, whose name has letters of its own, sync it to disk and rename it; a file that
    is there is replaced.

    Args:
        name: returns the final name, given the complete temporary file, where it depends on the content.
    """
    partial = path.with_name(f"{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with open(partial, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        path = path if name is None else path.with_name(name(partial))
        os.replace(partial, path)
        sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(partial)) from error
        raise
    return path


def take_apart(path: Path) -> None:
    """Replace a file that has another name too, a hard link as some backups make, by a copy: what is written
    into it in place would else be written there."""
    if path.is_file() and path.stat().st_nlink > 1:
        with open(path, "rb") as source:
            write_atomically(path, lambda file: copyfileobj(source, file))


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that a new name in it survives a power failure, if the system supports it."""
    if sys.platform == "win32":
        return
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def remove_partial(*folders: Path) -> None:
    """Remove the temporary files that killed processes left in folders, where nobody else writes now."""
    for folder in folders:
        for path in folder.glob(_PARTIAL):
            path.unlink(missing_ok=True)


def write_json(path: Path, value: object) -> None:
    """Write a JSON value atomically."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; a file that is missing is a FileNotFoundError, all else a ValueError."""
    refuse_special(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path} holds a {type(value).__name__}; allowed: a JSON object")
    try:
        refuse_other_keys(value, most=_MOST_NESTED)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return value


def refuse_special(path: Path) -> None:
    """Refuse a directory, and a pipe, which would wait for somebody to write into it."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a file")


_APART: Final = ("runs", "runs-earlier")
"""Folders of a study that may be links, as to another disk: each run in them is looked at by itself."""
_OF_OTHERS: Final = ("wandb",)
"""Folders in which a logger keeps links of its own."""


def refuse_links(folder: Path) -> None:
    """Refuse the directory of a run or study if a symbolic link leads out of it, to what would be written.

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


def written_by_another(recipe: object) -> str:
    """Return the end of a message about a recipe that cannot be read: which cprl wrote it, where that was
    another than this; else nothing."""
    versions = recipe.get("versions") if isinstance(recipe, Mapping) else None
    wrote = versions.get("cprl") if isinstance(versions, Mapping) else None
    here = version("cprl")
    return f"; cprl {shown(wrote)} wrote it, and this is {here}" if wrote not in (None, here) else ""


def refuse_newer(what: object, table: Mapping[str, Any], newest: int) -> None:
    """Refuse what a newer cprl wrote than one that reads formats up to `newest`; any other format is left to
    the reader."""
    number = table.get("format")
    if isinstance(number, int) and number > newest:
        raise ValueError(
            f"{what} has the format {shown(number)}, and cprl {version('cprl')} reads up to {newest}: a "
            "newer cprl wrote it; upgrade cprl"
        )


FREE: Final = {"name": "", "on_nan": ""}
"""In place of what may differ in the experiments of one and the same run, beside their length."""

MANIFEST_FILE: Final = "manifest.json"
_NAMED_CHECKSUM: Final = re.compile(r"-([0-9a-f]{32})\.pt")


def checksum(path: Path) -> str:
    """Return BLAKE2b of a file's content, 16 bytes in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def digest_of(text: str, *, size: int = 16) -> str:
    """Return BLAKE2b of a text, so many bytes in hexadecimal."""
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()


def verify(path: Path) -> None:
    """Refuse a file that is not the one that was written, by the checksum in its name or in the manifest of
    its run; a file without a checksum is not checked."""
    refuse_special(path)
    named = _NAMED_CHECKSUM.search(path.name)
    runs = [run for run in (path.parent, path.parent.parent) if (run / MANIFEST_FILE).exists()]
    listed = _sound(runs[0]).get(path.relative_to(runs[0]).as_posix()) if runs and not named else None
    expected = named[1] if named else listed
    if expected is not None and (actual := checksum(path)) != expected:
        raise ValueError(f"{path} is damaged or was changed: its checksum is {actual}, not {expected}")


def refuse_missing(run: Path) -> None:
    """Refuse a run that lacks a file that its manifest lists; each is named."""
    missing = [legible(name) for name in _sound(run) if not (run / name).exists()]
    if missing:
        raise ValueError(
            f"{run} lacks {', '.join(missing)}, which its {MANIFEST_FILE} lists; restore it, or take "
            "another run"
        )


def write_listed(run: Path, name: str, write: Callable[[BinaryIO], object]) -> None:
    """Write a file of a run atomically, and its checksum into the manifest.

    Args:
        name: the file's path in the run, e.g. "checkpoints/final.pt"; its folder is made.
    """
    path = run / name
    _list(run, {name: None})
    if path.parent != run:  # a run that was deleted is not made again
        path.parent.mkdir(exist_ok=True)
    write_atomically(path, write)
    _list(run, {name: checksum(path)})


def remove_listed(run: Path, name: str) -> None:
    """Remove a file of a run, if it is there, and its checksum from the manifest."""
    _list(run, {name: None})
    (run / name).unlink(missing_ok=True)


def rename_listed(run: Path, name: str, new: str) -> None:
    """Rename a file or folder of a run; checksums stay with their files. What has the new name is replaced,
    but for a folder, whose files are."""
    source = run / name
    target = run / new
    if source.is_dir():
        target.mkdir(exist_ok=True)
        for path in sorted(source.iterdir()):
            rename_listed(run, f"{name}/{path.name}", f"{new}/{path.name}")
        source.rmdir()
        return
    listed = _manifest(run)["files"].get(name)
    _list(run, {name: None, new: None})
    source.replace(target)
    _list(run, {new: listed})


def _list(run: Path, changes: Mapping[str, str | None]) -> None:
    """Write new checksums of files into the manifest; None for a file that is about to be replaced, since a
    kill before its new checksum must not leave that of another content."""
    before = _manifest(run)["files"]
    files = {name: digest for name, digest in sorted({**before, **changes}.items()) if digest is not None}
    if files != before:
        table = {"format": MANIFEST_FORMAT, "checksum": "blake2b, 16 bytes"}
        experiment = _experiment_in(run)
        table |= {} if experiment is None else {"experiment": experiment}
        write_json(run / MANIFEST_FILE, {**table, "files": files})


def _experiment_in(run: Path) -> str | None:
    """Return the checksum of the experiment in the recipe of a run, whatever its name and length; None where
    there is none."""
    try:
        experiment = read_json(run / RECIPE_FILE).get("experiment")
    except FileNotFoundError:
        return None
    if not isinstance(experiment, dict):
        return None
    return digest_of(json.dumps(without_length({**experiment, **FREE}), sort_keys=True))


def _sound(run: Path) -> dict[str, str]:
    """Return the checksums of the files of a run, beside the recipe of the run that wrote them."""
    table = _manifest(run)
    wrote = table.get("experiment")
    experiment = _experiment_in(run)
    if None not in (wrote, experiment) and wrote != experiment:
        raise ValueError(
            f"{run / MANIFEST_FILE} is of another experiment than {RECIPE_FILE} beside it: were the files of "
            "two runs mixed? restore them; if you changed the recipe yourself, remove the line with "
            f'"experiment" from {MANIFEST_FILE}'
        )
    files: dict[str, str] = table["files"]
    return files


def _manifest(run: Path) -> dict[str, Any]:
    """Read the manifest of a run; one that is not there lists nothing."""
    path = run / MANIFEST_FILE
    try:
        table = read_json(path)
    except FileNotFoundError:
        return {"files": {}}
    refuse_newer(path, table, MANIFEST_FORMAT)
    files = table.get("files") if table.get("format") == MANIFEST_FORMAT else None
    if not isinstance(files, dict) or not all(isinstance(digest, str) for digest in files.values()):
        raise ValueError(f"{path} is not the manifest of a run, of the format {MANIFEST_FORMAT}")
    return table


LOCK_FILE: Final = "run.lock"


class RunLockedError(ValueError):
    """Another process writes the directory, or may do so; the message names it."""


class RunLock:
    """The lock of a run's directory, or shares that of a study's; a context manager.

    The lock is a `flock` on `run.lock`, which the system releases when the process dies, however it dies. The
    file names host, process and start time. Where a file system is shared by several hosts a `flock` may not
    reach the others, so the lock file of another host is refused too, unless it is taken over. Whoever leaves
    last removes the file. On Windows, which has no `flock`, nothing is locked.

    Args:
        take_over: whether to take the lock of a run that a process on another host left behind. A lock that a
            living process on this host holds is never taken.
        study: tells a study from others: its directory is locked together with all who run the same one.

    Raises:
        RunLockedError: names the process that holds the lock.
    """

    def __init__(self, directory: Path, *, take_over: bool = False, study: str | None = None) -> None:
        self.directory = directory
        self.path = directory / LOCK_FILE
        self._take_over = take_over
        self._study = study
        self._file: int | None = None
        self.is_alone = True
        """Whether nobody else is known to have run the study when it was locked."""

    def __enter__(self) -> Self:
        refuse_links(self.directory)
        while fcntl is not None and self._file is None:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            with ExitStack() as closing:
                closing.callback(os.close, file)
                self._lock(file)
                if self._is_in_place(file):  # else once more: its holder ended in the meantime
                    holder = _holder(file)
                    if self._study is not None and holder.get("study") != self._study:
                        raise RunLockedError(
                            f"{self.directory} is run as another study by {_named(holder)}; wait until it "
                            "ends, or take another directory; if it ended with its machine, delete "
                            f"{self.path}"
                        )
                    closing.pop_all()
                    self._file = file
        return self

    def _lock(self, file: int) -> None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if self._study is None:
                raise RunLockedError(
                    f"{self.directory} is being written by {_named(_holder(file))}; wait until it ends, or "
                    "stop it"
                ) from None
            self.is_alone = False
        else:
            holder = _holder(file)
            here = socket.gethostname()
            # A process on another host may hold it, as far as the file says.
            self.is_alone = holder.get("host") in (None, here) or self._take_over
            if self.is_alone:
                self._sign(file)
            elif self._study is None:
                raise RunLockedError(
                    f"{self.directory} is locked by {_named(holder)}, on another host than this, {here}; if "
                    "that process has ended: --take-over (in Python take_over=True)"
                )
        if self._study is not None:
            fcntl.flock(file, fcntl.LOCK_SH)  # whoever else had it exclusively had it for this moment

    def _sign(self, file: int) -> None:
        started = datetime.now().astimezone().isoformat(timespec="seconds")
        holder = {"host": socket.gethostname(), "pid": os.getpid(), "started": started}
        holder |= {} if self._study is None else {"study": self._study}
        if os.fstat(file).st_nlink > 1 and self._is_in_place(file):
            self.path.unlink()  # a hard link, through which nothing is written; the next one is a new file
            return
        try:
            os.ftruncate(file, 0)
            os.pwrite(file, (json.dumps(holder) + "\n").encode(), 0)
        except OSError as error:  # e.g. of a full disk
            if self._is_in_place(file):
                self.path.unlink()
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def _is_in_place(self, file: int) -> bool:
        """Return whether the file is the one in the directory: its holder removes it at the end."""
        try:
            return os.path.samestat(os.fstat(file), os.stat(self.path))
        except FileNotFoundError:
            return False

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if self._file is None:
            return
        with suppress(OSError):  # BlockingIOError: it is left to those who still run the study
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Not that of another host, nor where the directory was deleted and made again.
            if _holder(self._file).get("host") == socket.gethostname() and self._is_in_place(self._file):
                self.path.unlink()
        os.close(self._file)
        self._file = None


def holder_of(directory: Path) -> str:
    """Return who holds the lock of a directory, as messages name a process."""
    with suppress(OSError), open(directory / LOCK_FILE, "rb") as file:
        return _named(_holder(file.fileno()))
    return _named({})


def _holder(file: int) -> dict[str, Any]:
    """Return who wrote the lock file; empty if it cannot be read, e.g. as its process is just starting."""
    try:
        holder = json.loads(os.pread(file, 4096, 0))
    except (ValueError, RecursionError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _named(holder: Mapping[str, Any]) -> str:
    if not holder:
        return "another process"
    return f"process {holder.get('pid')} on {holder.get('host')} since {holder.get('started')}"
