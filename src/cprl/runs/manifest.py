"""The manifest of a run: the checksum of each file of results, verified whenever one is read.

`manifest.json` lists final weights, tables of episodes and the state of transforms. `recipe.json`, which
people read and copy, the recording and figures are not in it. A checkpoint has its checksum in its name, and
the journal of episodes one for each episode.
"""

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from cprl.runs import formats
from cprl.runs.files import checksum, read_json, write_atomically, write_json

FILE_NAME: Final = "manifest.json"
FORMAT: Final = formats.MANIFEST


def write_listed(run: Path, name: str, write: Callable[[BinaryIO], object]) -> Path:
    """Writes a file of a run atomically, and its checksum into the manifest.

    Args:
        run: the run's directory, which exists.
        name: the file's path in it, e.g. "checkpoints/final.pt"; its folder is made.
        write: writes the content.

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
    _write(run, files)


def unlist(run: Path, *names: str) -> None:
    """Removes files from the manifest, which is to be done before they are replaced: a kill in between must
    not leave the checksum of another content."""
    files = _files(run)
    left = {name: own for name, own in files.items() if name not in names}
    if left != files:
        _write(run, left)


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
        _write(run, {**_files(run), new: listed})


def verify(path: Path) -> None:
    """Checks a file against the manifest of its run; files that no manifest lists are not checked.

    Args:
        path: a file in a run's directory, or in a folder of it.

    Raises:
        ValueError: if the content is not the one that was written, or the manifest cannot be read.
    """
    for run in (path.parent, path.parent.parent):
        if (run / FILE_NAME).exists():
            listed = _files(run).get(path.relative_to(run).as_posix())
            if listed is not None and (found := checksum(path)) != listed:
                raise ValueError(
                    f"{path} is damaged or was changed: its checksum is {found}; {run / FILE_NAME} has "
                    f"{listed}"
                )
            return


def refuse_missing(run: Path) -> None:
    """Raises a ValueError where a file that the manifest lists is not there; names each."""
    missing = [name for name in _files(run) if not (run / name).exists()]
    if missing:
        raise ValueError(
            f"{run} lacks {', '.join(missing)}, which its {FILE_NAME} lists; restore it, or take another run"
        )


def _files(run: Path) -> dict[str, str]:
    """The checksum of each listed file, by its path in the run."""
    path = run / FILE_NAME
    try:
        table = read_json(path)
    except FileNotFoundError:
        return {}
    formats.refuse_newer(path, table, FORMAT)
    files = table.get("files") if table.get("format") == FORMAT else None
    if not isinstance(files, dict) or not all(isinstance(own, str) for own in files.values()):
        raise ValueError(f"{path} is not the manifest of a run, of the format {FORMAT}")
    return files


def _write(run: Path, files: dict[str, str]) -> None:
    listed = dict(sorted(files.items()))
    write_json(run / FILE_NAME, {"format": FORMAT, "checksum": "blake2b, 16 bytes", "files": listed})
