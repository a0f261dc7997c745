"""Extends a run, finished or stopped, to more episodes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from cprl.runs.checkpoints import FOLDER, checkpoints_in, is_ending, read_checkpoint, steps_of
from cprl.runs.directory import write_more_episodes
from cprl.runs.manifest import refuse_missing, rename_listed

REPORT: Final = "report.json"
"""Written when everything of a run is finished."""
_RESULTS: Final = (
    REPORT,
    *(f"{FOLDER}/{name}.pt" for name in ("final", "transforms", "decisions")),
    "evaluation",
)


def refuse_to_extend(run: Path, episodes: int, callbacks: Iterable[Any]) -> None:
    """Checks that a run of more episodes would equal one that had been begun with so many.

    Args:
        run: its directory.
        episodes: how many it has so far.
        callbacks: those of the training; one with `on_start` sees the number of episodes, and may depend on
            it unless it has a true `is_extendable`.

    Raises:
        ValueError: if it would not, or lacks a file that its manifest lists; says why.
    """
    refuse_missing(run)
    for callback in callbacks:
        if depends_on_episodes(callback):
            raise ValueError(
                f"{run} has the callback {type(callback).__name__}, whose on_start sees the number of "
                "episodes, so that a longer training may differ from the first episode on; if it does not: "
                "is_extendable = True in its class"
            )
    kept = checkpoints_in(run / FOLDER)
    endings = [path for path in kept if is_ending(path)]
    if endings:
        read_checkpoint(endings[-1])
    elif (run / REPORT).exists() or (run / FOLDER / "final.pt").exists():
        raise ValueError(
            f"{run} keeps no state of its training to extend it from: it was run without keep_checkpoint, or "
            "by an earlier cprl"
        )
    elif kept and max(read_checkpoint(kept[-1])["played"]) >= episodes:
        raise ValueError(
            f"{run} was stopped while its last replicas played their last episodes, and keeps no state from "
            "before; finish it with as many episodes as it has"
        )


def depends_on_episodes(callback: Any) -> bool:
    """Whether a callback, or a class of callbacks, may depend on the number of episodes of a training."""
    return hasattr(callback, "on_start") and not getattr(callback, "is_extendable", False)


def extend(run: Path, before: int, episodes: int) -> None:
    """Makes a run one of more episodes, to be resumed; results so far are kept under a name with the number
    of their episodes: `checkpoints/final-4800.pt`, `evaluation-4800/`, `report-4800.json`.

    It can be repeated if it was interrupted. The recipe changes last.

    Args:
        run: its directory, which `refuse_to_extend` has checked.
        before: the number of episodes so far.
        episodes: the number to be.
    """
    for name in _RESULTS:
        path = run / name
        if path.exists():
            rename_listed(run, name, path.with_stem(f"{path.stem}-{before}").relative_to(run).as_posix())
    kept = checkpoints_in(run / FOLDER)
    last = max((steps_of(path) for path in kept if is_ending(path)), default=None)
    for path in kept:
        if last is not None and steps_of(path) > last:
            path.unlink()
    write_more_episodes(run, episodes)
