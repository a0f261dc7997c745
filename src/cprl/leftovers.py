"""What a run that is over, never began or goes on leaves in its directory: removed, or said."""

import shutil
from contextlib import suppress
from pathlib import Path

from cprl.output import console
from cprl.runs.checkpoints import FOLDER, Checkpointer, checkpoints_in
from cprl.runs.directory import changed_circumstances, say_changes, write_changed_circumstances
from cprl.runs.lock import FILE_NAME as LOCK
from cprl.runs.manifest import refuse_missing


def tidy_up(finished: Path, *, keep_checkpoint: bool, take_over: bool) -> None:
    """Says that a run is finished, and tidies up if its process died before it had.

    Raises:
        ValueError: if a file that its manifest lists is not there.
    """
    refuse_missing(finished)
    if (finished / LOCK).exists():
        with Checkpointer(finished, keep_ending=keep_checkpoint, take_over=take_over) as left:
            left.done()
    console().print(f"{finished} is finished; with more --episodes it is extended", soft_wrap=True)


def remove(directory: Path, *, but_keep_empty: bool) -> None:
    """Removes a run that never began; nobody else has written into its directory."""
    with suppress(OSError):
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if not but_keep_empty:
            directory.rmdir()


def say_what_is_kept(directory: Path) -> None:
    """Says what of a finished run serves to extend it, and how large it is."""
    for kept in checkpoints_in(directory / FOLDER):
        console().print(
            f"Kept so that it can be extended (--resume with more --episodes): {kept}, "
            f"{kept.stat().st_size / 1e6:,.1f} MB",
            soft_wrap=True,
        )


def say_what_changed(directory: Path) -> None:
    """Warns where a run that goes on was begun under other versions or other code, and writes that down."""
    changed = changed_circumstances(directory)
    say_changes(directory, changed)
    if changed:
        write_changed_circumstances(directory)
