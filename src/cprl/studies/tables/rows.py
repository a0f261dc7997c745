"""The rows of a table: its columns, their order, and that none is there twice."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.studies.tables.sources import Design, Source
from cprl.studies.tables.windows import NET, PARTS, Windows, ordered

COLUMNS: Final = {
    "condition": pa.string(),
    "checksum": pa.string(),
    "run": pa.string(),
    "marks": pa.string(),
    "replica": pa.int32(),
    "part": pa.string(),
    "metric": pa.string(),
    "episode": pa.int32(),
    "window_episodes": pa.int32(),
    "undefined": pa.int32(),
    "value": pa.float64(),
}
"""All but those of factors, which follow "checksum"."""
_NUMBERS: Final = ("replica", "episode", "window_episodes", "undefined", "value")


def column_of(factor: str) -> str:
    """The column of a factor."""
    return f"factor {factor}" if factor in COLUMNS else factor


def rows_of(design: Design, found: list[tuple[Source, list[Windows]]], marked: Mapping[str, str]) -> pa.Table:
    """The sorted rows of a table, with the columns that `cprl.studies.tables.table` lists.

    Args:
        design: the conditions.
        found: runs, and what was measured in them.
        marked: the marks of each run by its name.

    Raises:
        ValueError: if a replica of a condition is there twice.
    """
    names = list(design.conditions)
    is_net_known = not any(own.metric == "collective_return" for _, every in found for own in every)
    is_net_known |= any(own.metric.startswith("institutions/") for _, every in found for own in every)
    kept = [(source, own) for source, every in found for own in every if own.metric != NET or is_net_known]
    metrics, parts, runs = ordered({own.metric for _, own in kept}), list(PARTS), [own for own, _ in found]
    places = {id(source): nth for nth, source in enumerate(runs)}
    blocks: dict[str, list[NDArray[Any]]] = {
        name: [] for name in (*_NUMBERS, "condition", "part", "metric", "run")
    }
    for source, own in kept:
        replicas, windows = own.values.shape
        shape = (replicas, windows)
        cells: dict[str, Any] = {
            "condition": names.index(source.condition),
            "run": places[id(source)],
            "part": parts.index(own.part),
            "metric": metrics.index(own.metric),
            "replica": source.first + np.arange(replicas)[:, None],
            "episode": own.episodes,
            "window_episodes": own.lengths,
            "undefined": own.undefined,
            "value": own.values,
        }
        for name, cell in cells.items():
            blocks[name].append(np.broadcast_to(cell, shape).reshape(-1))
    arrays = {name: np.concatenate([np.zeros(0, np.int64), *own]) for name, own in blocks.items()}
    keys = ("condition", "replica", "part", "metric", "episode")
    order = np.lexsort([arrays[name] for name in reversed(keys)])
    arrays = {name: own[order] for name, own in arrays.items()}
    _refuse_twice(arrays, keys, names)
    columns: dict[str, pa.Array] = {
        "condition": _texts(names, arrays["condition"]),
        "checksum": _texts([own.checksum for own in runs], arrays["run"]),
    }
    for factor in design.factors:
        levels = _levels([own[factor] for own in design.conditions.values()])
        columns[column_of(factor)] = levels.take(pa.array(arrays["condition"]))
    columns |= {
        "run": _texts([own.name for own in runs], arrays["run"]),
        "marks": _texts([marked[own.name] for own in runs], arrays["run"]),
        "replica": pa.array(arrays["replica"], pa.int32()),
        "part": _texts(parts, arrays["part"]),
        "metric": _texts(metrics, arrays["metric"]),
    }
    columns |= {
        name: pa.array(arrays[name], COLUMNS[name])
        for name in ("episode", "window_episodes", "undefined", "value")
    }
    return pa.table(columns)


def _refuse_twice(arrays: Mapping[str, NDArray[Any]], keys: tuple[str, ...], names: list[str]) -> None:
    """Raises a ValueError where a row is there twice."""
    same = np.ones(max(len(arrays["value"]) - 1, 0), bool)
    for name in keys:
        same &= arrays[name][1:] == arrays[name][:-1]
    if same.any():
        at = int(same.argmax())
        raise ValueError(
            f"replica {arrays['replica'][at]} of the condition {names[arrays['condition'][at]]!r} is "
            "there twice"
        )


def _texts(names: list[str], codes: NDArray[Any]) -> pa.Array:
    return pa.array(names, pa.string()).take(pa.array(codes, pa.int64()))


def _levels(levels: list[Any]) -> pa.Array:
    """The levels of all conditions as a column: whole numbers, numbers, truth values, or else texts."""
    if all(isinstance(own, bool) for own in levels):
        return pa.array(levels, pa.bool_())
    if all(isinstance(own, int | float) and not isinstance(own, bool) for own in levels):
        whole = all(isinstance(own, int) and abs(own) < 2**63 for own in levels)
        return pa.array(levels, pa.int64() if whole else pa.float64())
    return pa.array([own if isinstance(own, str) else str(own) for own in levels], pa.string())
