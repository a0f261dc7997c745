"""Export the results of a run, small enough to commit: its directory without recording and buffers."""

import json
import os
from collections.abc import Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from shutil import copyfileobj
from typing import Any, Final

import pyarrow as pa

from cprl.measuring.table import ROW_ORDER
from cprl.policies.asking import CALLS
from cprl.runs.checkpoints import CHECKPOINTS
from cprl.runs.episodes import FILE_NAME, read_episodes, read_table, write_small
from cprl.runs.files import (
    LOCK_FILE,
    REPORT,
    refuse_links,
    refuse_missing,
    remove_listed,
    verify,
    write_listed,
)
from cprl.runs.length import without_length
from cprl.runs.played import TURNS
from cprl.runs.recipe import RECIPE_FILE, read_recipe, with_runs_moved
from cprl.runs.weights import DECISIONS, FROZEN_FIELD, TRANSFORMS
from cprl.values import describe_changes

_REQUIRED_FILES: Final = (RECIPE_FILE, REPORT)
_WEIGHTS: Final = f"{CHECKPOINTS}/final.pt"
_AGENT_FILES: Final = (_WEIGHTS, f"{CHECKPOINTS}/{TRANSFORMS}", f"{CHECKPOINTS}/{DECISIONS}", TURNS, CALLS)
_RUN_FILES: Final = (LOCK_FILE, "run.rrd", "episodes.arrows", "logs", f"{CHECKPOINTS}/*-*.pt")
"""Files of a run that an export does not have."""


def export_results(run: Path, folder: Path, *, weights: bool = True) -> Path:
    """Copy the files of a finished run that a report needs: recipe, episodes, evaluation, weights.

    The runs of `Frozen` agents are not copied; the recipe names them by paths relative to the folder.

    Args:
        folder: the target, new, empty, or with an earlier copy of a run of the same experiment, whose files
            are replaced.
        weights: whether trained weights, most of a short run's size, and the turns that people played are
            copied. Without them a report has the training and its evaluation, but `cprl.load` refuses the
            copy, since nothing can play its agents.

    Returns:
        The folder, which `cprl.load`, `read_episodes` and reports accept like the run. Metrics and returns
        are float32, and rows are sorted by replica, episode and agent.
    """
    run = Path(run)
    folder = Path(folder)
    recipe = read_recipe(run)
    _refuse_another(folder, run, recipe)
    refuse_links(folder)
    for name in (*_REQUIRED_FILES, _WEIGHTS) if weights else _REQUIRED_FILES:
        if not (run / name).exists():
            raise FileNotFoundError(f"{run / name} does not exist: has the run ended?")
    refuse_missing(run)
    agent_files = [name for name in _AGENT_FILES if weights and (run / name).exists()]
    for name in agent_files:
        verify(run / name)
    folder.mkdir(parents=True, exist_ok=True)
    for name in {*_AGENT_FILES} - {*agent_files}:  # left from an earlier copy
        remove_listed(folder, name)
    moved = _with_frozen_moved(recipe, run, folder)
    contents = {name: (run / name).read_bytes() for name in (*_REQUIRED_FILES, *agent_files)}
    if moved != recipe:
        contents[RECIPE_FILE] = (json.dumps(moved, indent=2) + "\n").encode()
    for name, content in contents.items():
        write_listed(folder, name, partial(copyfileobj, BytesIO(content)))
    _write_small_table(read_episodes(run), folder, FILE_NAME)
    for path in sorted((run / "evaluation").glob("*.parquet")):
        _write_small_table(read_table(path), folder, f"evaluation/{path.name}")
    return folder


def _refuse_another(folder: Path, run: Path, recipe: Mapping[str, Any]) -> None:
    allowed = "allowed: a new folder, or one with an earlier export of the same experiment"
    if folder.exists() and folder.resolve() == run.resolve():
        raise ValueError(f"folder is {folder}, the run itself; {allowed}")
    for pattern in _RUN_FILES:
        for path in folder.glob(pattern):
            raise ValueError(f"folder is {folder}, a run of its own: it has {path.name}; {allowed}")
    if (folder / RECIPE_FILE).exists():
        earlier = _with_frozen_moved(read_recipe(folder), folder, run)
        before, now = (without_length(table["experiment"]) for table in (earlier, recipe))
        differ = describe_changes(before, now, "experiment")
        if differ:
            raise ValueError(f"folder is {folder}, which holds another run: {differ[0]}; {allowed}")


def _with_frozen_moved(recipe: Mapping[str, Any], run: Path, folder: Path) -> dict[str, Any]:
    """Return a recipe in which the paths of `Frozen` agents' runs are relative to `folder` instead of
    `run`."""
    table: dict[str, Any] = with_runs_moved(recipe, run, folder)
    if FROZEN_FIELD in table:
        checksums = table[FROZEN_FIELD].items()
        table[FROZEN_FIELD] = {os.path.relpath(run / path, folder): digest for path, digest in checksums}
    return table


def _write_small_table(table: pa.Table, folder: Path, name: str) -> None:
    kinds = {field.name: pa.float32() if field.type == pa.float64() else field.type for field in table.schema}
    small = table.sort_by(ROW_ORDER).cast(pa.schema(kinds, table.schema.metadata))
    write_listed(folder, name, partial(write_small, small))
