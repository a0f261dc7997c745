"""Atomic writes: files are complete or absent."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a temporary file, syncs it to disk and renames it.

    Args:
        path: the file; an existing file is replaced.
        write: writes the content.
    """
    place_atomically(path.with_name(path.name + ".partial"), write, lambda partial: path)


def place_atomically(
    partial: Path, write: Callable[[BinaryIO], object], name: Callable[[Path], Path]
) -> Path:
    """Like `write_atomically`, for a file whose name depends on its content.

    Args:
        partial: the temporary name.
        write: writes the content.
        name: returns the final name, given the complete temporary file.

    Returns:
        The file.
    """
    try:
        with open(partial, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        path = name(partial)
        os.replace(partial, path)
        _sync_folder(path.parent)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    return path


def _sync_folder(folder: Path) -> None:
    """Syncs a folder, so that a new name in it survives a power failure, if the system supports it."""
    if sys.platform == "win32":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
