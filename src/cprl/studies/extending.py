"""Trials that go on from others of the same pool, which are the same but for fewer episodes."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from cprl.config import differences
from cprl.experiment import Experiment
from cprl.runs.checkpoints import FOLDER, checkpoints_in, is_ending
from cprl.runs.directory import FILE_NAME as RECIPE
from cprl.runs.directory import changed_code, read_recipe
from cprl.runs.extension import REPORT, depends_on_episodes
from cprl.runs.lock import FILE_NAME as LOCK

_FREE: Final = {"episodes": 0, "name": "", "on_nan": ""}
"""What may differ: how long it is, and what changes no number."""


def begin_from_shorter(run: Path, experiment: Experiment, recipe: Mapping[str, Any]) -> Path | None:
    """Makes a run that is not there of the longest finished one beside it that has fewer episodes, keeps the
    state of its training and is the same otherwise; it is then to be resumed with its own episodes.

    The other run stays as it is. A copy that was interrupted is made anew.

    Args:
        run: the directory that is not there.
        experiment: what is to be run; one with callbacks that may depend on the number of episodes goes on
            from nothing.
        recipe: what `Experiment.to_recipe` gave for it.

    Returns:
        The run that was copied; None if there is none such.
    """
    callbacks = [own.resolve() for own in experiment.callbacks]
    if any(not isinstance(own, type) or depends_on_episodes(own) for own in callbacks):
        return None
    wanted = recipe["experiment"]
    found: list[tuple[int, Path]] = []
    for other in sorted(run.parent.glob(f"*/{RECIPE}")):
        own = _experiment_of(other.parent)
        if (
            own is not None
            and own["episodes"] < wanted["episodes"]
            and not differences({**own, **_FREE}, {**wanted, **_FREE}, "experiment", Experiment)
            and any(map(is_ending, checkpoints_in(other.parent / FOLDER)))
        ):
            found.append((own["episodes"], other.parent))
    if not found:
        return None
    _, shorter = max(found)
    copying = run.with_name(f".{run.name}.copying-{os.getpid()}")
    shutil.rmtree(copying, ignore_errors=True)
    try:
        shutil.copytree(shorter, copying, ignore=shutil.ignore_patterns(REPORT, LOCK))
        copying.rename(run)
    except OSError:
        if not run.exists():  # else somebody else has begun it meanwhile
            raise
        return None
    finally:
        shutil.rmtree(copying, ignore_errors=True)
    return shorter


def _experiment_of(run: Path) -> dict[str, Any] | None:
    """The experiment of a finished run; None for any other directory, and one made with other code."""
    if not (run / REPORT).exists():
        return None
    try:
        recipe = read_recipe(run)
        found: dict[str, Any] = recipe["experiment"]
        return found if isinstance(found["episodes"], int) and not changed_code(recipe) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
