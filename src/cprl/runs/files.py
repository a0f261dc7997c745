"""Files of a run: complete or absent, JSON, and checksums."""

import hashlib
import json
import os
import secrets
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

from cprl.checks import check_nesting

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
        write: writes the content.
    """
    place_atomically(path, write, lambda partial: path)


def place_atomically(path: Path, write: Callable[[BinaryIO], object], name: Callable[[Path], Path]) -> Path:
    """Like `write_atomically`, for a file whose name depends on its content.

    Args:
        path: names the temporary file, to which each writer adds letters of its own.
        write: writes the content.
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
        ValueError: if it cannot be read, is nested too deeply or is not an object; names the file.
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

    Raises:
        ValueError: names the link.
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
