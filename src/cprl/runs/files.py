"""Write and read the files of a run: atomically, with checksums, under a lock on the directory.

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
from cprl.values import refuse_other_keys, short_repr

try:
    import fcntl
except ImportError:  # Windows, where runs are not locked
    fcntl = None  # type: ignore[assignment]

RECIPE_FILE: Final = "recipe.json"
REPORT: Final = "report.json"
"""The file that is written when a run is finished."""
RECIPE_FORMAT: Final = 2
"""The format of `recipe.json`, and of the journal and `report.json` beside it."""
MANIFEST_FORMAT: Final = 1
"""The format of `manifest.json`, and of what it lists: weights, tables, transforms, decisions."""
TRAINING_STATE_FORMAT: Final = 9
"""The format of checkpoints."""
STUDY_FORMAT: Final = 1
"""The format of `study.json`."""
STUDY_TABLE_FORMAT: Final = 2
"""The format of the table of a study."""

_MOST_NESTED: Final = 128
"""The most levels that a JSON file may nest: those of a `Custom`, and as many around it."""
_PARTIAL_PATTERN: Final = f"*.{8 * '[0-9a-f]'}.partial"
"""The names of files that are being written, or whose writing was interrupted."""


def refuse_to_write_over(path: Path) -> None:
    """Raise a FileExistsError for a file that exists, before hours of work."""
    if os.path.lexists(path):  # also a dangling link, through which a file would be written
        raise FileExistsError(f"{path} exists and is not overwritten; use another name")


def write_atomically(
    path: Path, write: Callable[[BinaryIO], object], *, name: Callable[[Path], str] | None = None
) -> Path:
    """Write a temporary file of a unique name, sync it to the disk and rename it; an existing file is
    replaced.

    Args:
        name: returns the final name for the complete temporary file, if it depends on the content.

    Raises:
        OSError: if it cannot be written; an existing file is intact.
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


def break_hard_links(path: Path) -> None:
    """Replace a file with several hard links, as some backups make, by a copy, so that writing in place does
    not change the others."""
    if path.is_file() and path.stat().st_nlink > 1:
        with open(path, "rb") as source:
            write_atomically(path, lambda file: copyfileobj(source, file))


def sync_folder(folder: Path) -> None:
    """Sync a folder, if the system supports it, so that new names in it survive a power failure."""
    if sys.platform == "win32":
        return
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def remove_partial(*folders: Path) -> None:
    """Remove the temporary files of killed processes from folders that nobody else writes."""
    for folder in folders:
        for path in folder.glob(_PARTIAL_PATTERN):
            path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a text atomically, with "?" for what UTF-8 cannot encode."""
    return write_atomically(path, lambda file: file.write(text.encode("utf-8", "replace")))


def write_json(path: Path, value: object) -> None:
    """Write a JSON value atomically."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: for any other content.
    """
    refuse_no_file(path)
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


def refuse_no_file(path: Path) -> None:
    """Refuse a directory or a pipe, which would block the reader."""
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is not a file")


_SEPARATE_FOLDERS: Final = ("runs", "runs-earlier")
"""Folders of a study that may be links, e.g. to another disk; each run in them is checked by itself."""
_LOGGER_FOLDERS: Final = ("wandb",)
"""Folders in which a logger keeps links of its own."""


def refuse_links(folder: Path) -> None:
    """Refuse the directory of a run or study if a symbolic link in it leads out, where files would be
    overwritten.

    The directory itself may be reached through a link.
    """
    real_folder = Path(os.path.realpath(folder))
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name not in _SEPARATE_FOLDERS]
        for path in (Path(parent, name) for name in (*folders, *names)):
            if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(real_folder):
                raise ValueError(
                    f"{path} is a symbolic link out of {folder}, where nothing is written; replace it by a "
                    "copy, or remove it"
                )
        folders[:] = [name for name in folders if name not in _LOGGER_FOLDERS]


def written_by_another(recipe: object) -> str:
    """Return the end of a message about an unreadable recipe, which names the version of cprl that wrote it;
    "" if it is this version."""
    versions = recipe.get("versions") if isinstance(recipe, Mapping) else None
    wrote = versions.get("cprl") if isinstance(versions, Mapping) else None
    here = version("cprl")
    return f"; cprl {short_repr(wrote)} wrote it, and this is {here}" if wrote not in (None, here) else ""


def refuse_newer(what: object, table: Mapping[str, Any], newest: int) -> None:
    """Refuse content in a format above `newest`, which a newer cprl wrote; other formats are left to the
    reader."""
    number = table.get("format")
    if isinstance(number, int) and number > newest:
        raise ValueError(
            f"{what} has the format {short_repr(number)}, and cprl {version('cprl')} reads up to {newest}: a "
            "newer cprl wrote it; upgrade cprl"
        )


NEUTRAL_FIELDS: Final = {"name": "", "on_nan": ""}
"""Fields of an experiment, beside its length, that may change for the same run, with neutral values."""

MANIFEST_FILE: Final = "manifest.json"
_NAMED_CHECKSUM: Final = re.compile(r"-([0-9a-f]{32})\.pt")


def time_now() -> str:
    """Return the time as files of runs hold it, to the second, with the zone."""
    return datetime.now().astimezone().isoformat(timespec="seconds")


def checksum(path: Path) -> str:
    """Return the BLAKE2b checksum of a file, 16 bytes in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def digest_of(text: str, *, size: int = 16) -> str:
    """Return the BLAKE2b checksum of a text, `size` bytes in hexadecimal."""
    return hashlib.blake2b(text.encode(), digest_size=size).hexdigest()


def verify(path: Path) -> None:
    """Refuse a file whose content does not match the checksum in its name or in its run's manifest; a file
    without a checksum is not checked."""
    refuse_no_file(path)
    expected = _expected_checksum(path)
    if expected is None:
        return
    actual = checksum(path)
    if actual != expected:
        raise ValueError(f"{path} is damaged or was changed: its checksum is {actual}, not {expected}")


def _expected_checksum(path: Path) -> str | None:
    in_name = _NAMED_CHECKSUM.search(path.name)
    if in_name:
        return in_name[1]
    for run in (path.parent, path.parent.parent):
        if (run / MANIFEST_FILE).exists():
            return _checksums(run).get(path.relative_to(run).as_posix())
    return None


def refuse_missing(run: Path) -> None:
    """Refuse a run that lacks files of its manifest; name them."""
    missing = [legible(name) for name in _checksums(run) if not (run / name).exists()]
    if missing:
        raise ValueError(
            f"{run} lacks {', '.join(missing)}, which its {MANIFEST_FILE} lists; restore it, or take "
            "another run"
        )


def write_listed(run: Path, name: str, write: Callable[[BinaryIO], object]) -> None:
    """Write a file of a run atomically, and its checksum into the manifest.

    Args:
        name: the file's path in the run, e.g. "checkpoints/final.pt"; its folder is created.
    """
    path = run / name
    _update_manifest(run, {name: None})
    if path.parent != run:  # do not recreate a deleted run
        path.parent.mkdir(exist_ok=True)
    write_atomically(path, write)
    _update_manifest(run, {name: checksum(path)})


def remove_listed(run: Path, name: str) -> None:
    """Remove a file of a run, if it exists, and its checksum from the manifest."""
    _update_manifest(run, {name: None})
    (run / name).unlink(missing_ok=True)


def rename_listed(run: Path, name: str, new: str) -> None:
    """Rename a file or folder of a run, with its checksums. An existing file of the new name is replaced; an
    existing folder is merged."""
    source = run / name
    target = run / new
    if source.is_dir():
        target.mkdir(exist_ok=True)
        for path in sorted(source.iterdir()):
            rename_listed(run, f"{name}/{path.name}", f"{new}/{path.name}")
        source.rmdir()
        return
    listed = _read_manifest(run)["files"].get(name)
    _update_manifest(run, {name: None, new: None})
    source.replace(target)
    _update_manifest(run, {new: listed})


def _update_manifest(run: Path, changes: Mapping[str, str | None]) -> None:
    """Update checksums in the manifest. None removes the checksum of a file that is about to change, so that
    no outdated one remains if the process is killed."""
    before = _read_manifest(run)["files"]
    files = {name: digest for name, digest in sorted({**before, **changes}.items()) if digest is not None}
    if files != before:
        table = {"format": MANIFEST_FORMAT, "checksum": "blake2b, 16 bytes"}
        experiment = _experiment_in(run)
        table |= {} if experiment is None else {"experiment": experiment}
        write_json(run / MANIFEST_FILE, {**table, "files": files})


def _experiment_in(run: Path) -> str | None:
    """Return the checksum of the experiment in a run's recipe, without its name and length; None without a
    recipe."""
    try:
        experiment = read_json(run / RECIPE_FILE).get("experiment")
    except FileNotFoundError:
        return None
    if not isinstance(experiment, dict):
        return None
    return digest_of(json.dumps(without_length({**experiment, **NEUTRAL_FIELDS}), sort_keys=True))


def _checksums(run: Path) -> dict[str, str]:
    """Return the checksums in a run's manifest by file; refuse a manifest of another experiment."""
    table = _read_manifest(run)
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


def _read_manifest(run: Path) -> dict[str, Any]:
    """Read the manifest of a run; a missing one lists no files."""
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
    """Another process writes the directory, or may do so; the message names the process."""


class RunLock:
    """The exclusive lock of a run's directory, or a share of the lock of a study's; a context manager.

    The lock is a `flock` on `run.lock`, which the system releases when the process dies, however it dies. The
    file names host, process and start time. Where a file system is shared by several hosts a `flock` may not
    reach the others, so the lock file of another host is refused too, unless it is taken over. Whoever leaves
    last removes the file. On Windows, which has no `flock`, nothing is locked. The package filelock does
    without what a study needs: a lock on a file that several processes hold together.

    Args:
        take_over: whether to take a lock that a process on another host left behind. The lock of a living
            process on this host is never taken.
        study: the checksum of a study; processes with the same one share the lock.

    Raises:
        RunLockedError: if another process holds the lock; the message names it.
    """

    def __init__(self, directory: Path, *, take_over: bool = False, study: str | None = None) -> None:
        self.directory = directory
        self.path = directory / LOCK_FILE
        self._take_over = take_over
        self._study = study
        self._file: int | None = None
        self.is_alone = True
        """True if nobody else is known to have run the study when it was locked."""

    def __enter__(self) -> Self:
        refuse_links(self.directory)
        while fcntl is not None and self._file is None:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            with ExitStack() as closing:
                closing.callback(os.close, file)
                self._acquire(file)
                if self._is_in_place(file):  # else try again: its holder has ended and removed it
                    self._refuse_other_study(_read_holder(file))
                    closing.pop_all()
                    self._file = file
        return self

    def _refuse_other_study(self, holder: Mapping[str, Any]) -> None:
        if self._study is not None and holder.get("study") != self._study:
            raise RunLockedError(
                f"{self.directory} is run as another study by {_describe_holder(holder)}; wait until it "
                f"ends, or take another directory; if it ended with its machine, delete {self.path}"
            )

    def _acquire(self, file: int) -> None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if self._study is None:
                holder = _describe_holder(_read_holder(file))
                raise RunLockedError(
                    f"{self.directory} is being written by {holder}; wait until it ends, or stop it"
                ) from None
            self.is_alone = False
        else:
            last = _read_holder(file)
            here = socket.gethostname()
            # By its content, a process on another host may still hold it.
            self.is_alone = last.get("host") in (None, here) or self._take_over
            if self.is_alone:
                self._write_holder(file)
            elif self._study is None:
                raise RunLockedError(
                    f"{self.directory} is locked by {_describe_holder(last)}, on another host than this, "
                    f"{here}; if that process has ended: --take-over (in Python take_over=True)"
                )
        if self._study is not None:
            fcntl.flock(file, fcntl.LOCK_SH)  # an exclusive lock by others lasts only this moment

    def _write_holder(self, file: int) -> None:
        holder = {"host": socket.gethostname(), "pid": os.getpid(), "started": time_now()}
        holder |= {} if self._study is None else {"study": self._study}
        if os.fstat(file).st_nlink > 1 and self._is_in_place(file):
            self.path.unlink()  # do not write through a hard link; the next attempt makes a new file
            return
        try:
            os.ftruncate(file, 0)
            os.pwrite(file, (json.dumps(holder) + "\n").encode(), 0)
        except OSError as error:  # e.g. a full disk
            if self._is_in_place(file):
                self.path.unlink()
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def _is_in_place(self, file: int) -> bool:
        """Return whether the file is still the one in the directory, since its holder removes it at the
        end."""
        try:
            return os.path.samestat(os.fstat(file), os.stat(self.path))
        except FileNotFoundError:
            return False

    def __exit__(self, *error: object) -> None:
        if self._file is None:
            return
        with suppress(OSError):  # BlockingIOError if others still run the study
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Keep the file of another host, and one in a new directory of the same name.
            if _read_holder(self._file).get("host") == socket.gethostname() and self._is_in_place(self._file):
                self.path.unlink()
        os.close(self._file)
        self._file = None


def holder_of(directory: Path) -> str:
    """Return in words which process holds the lock of a directory."""
    with suppress(OSError), open(directory / LOCK_FILE, "rb") as file:
        return _describe_holder(_read_holder(file.fileno()))
    return _describe_holder({})


def _read_holder(file: int) -> dict[str, Any]:
    """Return the content of the lock file; empty if it cannot be read, e.g. while its process is starting."""
    try:
        holder = json.loads(os.pread(file, 4096, 0))
    except (ValueError, RecursionError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _describe_holder(holder: Mapping[str, Any]) -> str:
    if not holder:
        return "another process"
    return f"process {holder.get('pid')} on {holder.get('host')} since {holder.get('started')}"
