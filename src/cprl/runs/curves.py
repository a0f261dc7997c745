"""The episodes of a run as curves: a number for each replica and episode, smoothed as in the study."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.measuring.table import complete, metrics_in, where, world_of
from cprl.measuring.windows import last_of
from cprl.runs.episodes import read_episodes
from cprl.values.arrays import Float64, Int64


def curves_of(run: Path, *, last: int | None = None) -> dict[str, Float64]:
    """Read every metric that a run's game reports, and each agent's return as `return_0` and so on.

    Args:
        last: of each replica only the last episodes, see `last_of`; by default all.

    Returns:
        float64 [R, E] by name, for R replicas and as many episodes as all of them have ended; NaN where a
        metric is undefined. Nothing of a run that has ended no episode.
    """
    return as_curves(read_episodes(run), last=last)


def as_curves(table: pa.Table, *, last: int | None = None) -> dict[str, Float64]:
    """Like `curves_of`, from a table of `read_episodes`."""
    if not table.num_rows:
        return {}
    table = complete((table if last is None else last_of(table, last)).sort_by(_ORDER))
    first = where(table, agent=0)
    at = _places(first)
    curves = {name: np.asarray(first[name].to_numpy()[at], np.float64) for name in metrics_in(table.schema)}
    for agent in table["agent"].unique().to_pylist():
        returns = where(table, agent=agent)["return"].to_numpy()
        curves[f"return_{agent}"] = np.asarray(returns[at], np.float64)
    return curves


def worlds_of(table: pa.Table) -> Int64:
    """Return the world of each episode of the curves of a table, int64 [R, E]; of a table that has none, the
    replica."""
    first = where(table.sort_by(_ORDER), agent=0)
    return world_of(first)[_places(first)]


_ORDER: Final = [("replica", "ascending"), ("episode", "ascending"), ("agent", "ascending")]


def _places(first: pa.Table) -> Int64:
    """Return the rows of one agent in which each episode of each replica stands, int64 [R, E]: as many as all
    replicas have."""
    _, starts, counts = np.unique(first["replica"].to_numpy(), return_index=True, return_counts=True)
    return np.asarray(starts[:, None] + np.arange(counts.min()))


def episode_of_turn(table: pa.Table, turn: float) -> float | None:
    """The episode with which the replicas of a training reach a turn, their mean; None if one does not."""
    first = where(table, agent=0)
    replica = first["replica"].to_numpy()
    steps = first["steps"].to_numpy()
    world = world_of(first)
    ended = np.zeros(len(steps), np.int64)
    for number in np.unique(world):
        ended[world == number] = steps[world == number].cumsum()
    return episode_reached([ended[replica == number] for number in np.unique(replica)], turn)


def episode_reached(ended: Iterable[NDArray[Any]], turn: float) -> float | None:
    """The episode with which the replicas reach a turn, their mean, from the turns in which the episodes of
    each ended, [E]; None if one does not."""
    reached = [of_replica >= turn for of_replica in ended]
    return float(np.mean([each.argmax() for each in reached])) if all(map(np.any, reached)) else None
