"""Files that are never seen, nor left behind, half written."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a file beside its place, puts it safely on the disk, and only then gives it its name.

    Args:
        path: the file to be; one of this name is replaced.
        write: writes the content.
    """
    place_atomically(path.with_name(path.name + ".partial"), write, lambda partial: path)


def place_atomically(
    partial: Path, write: Callable[[BinaryIO], object], name: Callable[[Path], Path]
) -> Path:
    """The same, for a file whose name follows from its content.

    Args:
        partial: the name until it is complete.
        write: writes the content.
        name: the file to be, out of the complete one.

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
    """Makes a new name in a folder survive a loss of power, where the system can."""
    if sys.platform == "win32":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
