"""Exports the results of a run, small enough to commit: its directory without recording and buffers."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from cprl.runs.episodes import FILE_NAME, read_episodes, read_table, small
from cprl.runs.files import refuse_links, refuse_missing, unlist, verify, write_listed
from cprl.runs.recipe import RECIPE_FILE, read_recipe
from cprl.runs.weights import DECISIONS, TRANSFORMS
from cprl.runs.weights import FIELD as FROZEN
from cprl.values import differences

_IF_ANY = tuple(f"checkpoints/{name}" for name in (TRANSFORMS, DECISIONS))
_WHOLE = ("recipe.json", "report.json")
_WEIGHTS = "checkpoints/final.pt"


def export_results(run: Path, folder: Path, *, weights: bool = True) -> Path:
    """Copies the files of a finished run that a report needs: recipe, episodes, evaluation, weights.

    Args:
        folder: the target, new, empty, or with an earlier copy of a run of the same experiment, whose files
            are replaced.
        weights: whether trained weights are copied, which are most of a short run. Without them a report has
            what the training and its evaluation tell; nothing can play the agents, and `cprl.load` refuses
            the copy.

    The runs of `Frozen` agents are not copied: the recipe names them from the folder on, so a folder that is
    moved finds them where it would find a run beside it.

    Returns:
        The folder, which `cprl.load`, `read_episodes` and a report accept like the run itself. Metrics and
        returns are float32, and rows are sorted by replica, episode and agent.

    Raises:
        FileNotFoundError: if the run has not ended.
    """
    run, folder = Path(run), Path(folder)
    recipe = read_recipe(run)
    _refuse_another(folder, run, recipe)
    refuse_links(folder)
    for name in (*_WHOLE, _WEIGHTS) if weights else _WHOLE:
        if not (run / name).exists():
            raise FileNotFoundError(f"{run / name} does not exist: has the run ended?")
    refuse_missing(run)
    of_agents = (_WEIGHTS, *_IF_ANY)
    copied = [name for name in (*_WHOLE, *(of_agents if weights else ())) if (run / name).exists()]
    for name in copied:
        verify(run / name)
    folder.mkdir(parents=True, exist_ok=True)
    for name in {*of_agents} - {*copied}:  # of an earlier copy
        unlist(folder, name)
        (folder / name).unlink(missing_ok=True)
    for name in copied:
        _copy(run / name, folder, name)
    moved = _with_frozen_moved(recipe, run, folder)
    if FROZEN in recipe:
        moved[FROZEN] = {os.path.relpath(run / own, folder): digest for own, digest in recipe[FROZEN].items()}
    if moved != recipe:
        content = (json.dumps(moved, indent=2) + "\n").encode()
        write_listed(folder, RECIPE_FILE, lambda file: file.write(content))
    _write(read_episodes(run), folder, FILE_NAME)
    for path in sorted((run / "evaluation").glob("*.parquet")):
        _write(read_table(path), folder, f"evaluation/{path.name}")
    return folder


_OF_RUNS: Final = ("run.lock", "run.rrd", "episodes.arrows", "logs", "checkpoints/*-*.pt")
"""Files that a run leaves and an export does not."""


def _refuse_another(folder: Path, run: Path, recipe: Mapping[str, Any]) -> None:
    """Refuses to write over what is no earlier copy of such a run."""
    allowed = "allowed: a new folder, or one with an earlier export of the same experiment"
    if folder.exists() and folder.resolve() == run.resolve():
        raise ValueError(f"folder is {folder}, the run itself; {allowed}")
    for pattern in _OF_RUNS:
        for path in folder.glob(pattern):
            raise ValueError(f"folder is {folder}, a run of its own: it has {path.name}; {allowed}")
    if (folder / RECIPE_FILE).exists():
        there = _with_frozen_moved(read_recipe(folder), folder, run)
        differ = differences(_experiment(there), _experiment(recipe), "experiment")
        if differ:
            raise ValueError(f"folder is {folder}, which holds another run: {differ[0]}; {allowed}")


def _experiment(recipe: Mapping[str, Any]) -> Any:
    """What the recipe says of the experiment, but for how long it is."""
    return {**(recipe.get("experiment") or recipe), "episodes": 0}


def _with_frozen_moved(table: Any, run: Path, folder: Path) -> Any:
    """A recipe whose paths of `Frozen` agents, which are relative to `run`, are relative to `folder`."""
    if isinstance(table, list):
        return [_with_frozen_moved(own, run, folder) for own in table]
    if not isinstance(table, Mapping):
        return table
    moved = {name: _with_frozen_moved(own, run, folder) for name, own in table.items()}
    if moved.get("kind") == "Frozen" and isinstance(moved.get("run"), str):
        moved["run"] = os.path.relpath(run / moved["run"], folder)
    return moved


def _copy(path: Path, folder: Path, name: str) -> None:
    content = path.read_bytes()
    write_listed(folder, name, lambda file: file.write(content))


def _write(table: pa.Table, folder: Path, name: str) -> None:
    ordered = table.sort_by([(name, "ascending") for name in ("replica", "episode", "agent")])
    kinds = pa.schema(
        [(own.name, pa.float32() if own.type == pa.float64() else own.type) for own in table.schema]
    ).with_metadata(table.schema.metadata)
    smaller = ordered.cast(kinds)
    write_listed(folder, name, lambda file: pq.write_table(smaller, file, **small(smaller)))
