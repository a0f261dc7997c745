"""The episodes of a run as curves: a number for each replica and episode, smoothed as in the study."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.measuring.table import ROW_ORDER, complete, stored_metrics, where, world_of
from cprl.measuring.windows import last_of
from cprl.runs.episodes import read_episodes
from cprl.values.array_types import Float64, Int64


def curves_of(run: Path, *, last: int | None = None) -> dict[str, Float64]:
    """Read every metric that a run's game reports, and each agent's return as `return_0` and so on.

    Args:
        last: how many of the last episodes of each replica are read, see `last_of`; by default all.

    Returns:
        float64 [R, E] by name, for R replicas and as many episodes as all of them have ended; NaN where a
        metric is undefined. Empty for a run that has ended no episode.
    """
    return as_curves(read_episodes(run), last=last)


def as_curves(table: pa.Table, *, last: int | None = None) -> dict[str, Float64]:
    """Return the curves of a table of `read_episodes`, see `curves_of`."""
    if not table.num_rows:
        return {}
    table = complete((table if last is None else last_of(table, last)).sort_by(ROW_ORDER))
    first = where(table, agent=0)
    rows = _episode_rows(first)
    curves = {
        name: np.asarray(first[name].to_numpy()[rows], np.float64) for name in stored_metrics(table.schema)
    }
    for agent in table["agent"].unique().to_pylist():
        returns = where(table, agent=agent)["return"].to_numpy()
        curves[f"return_{agent}"] = np.asarray(returns[rows], np.float64)
    return curves


def curve_worlds(table: pa.Table) -> Int64:
    """Return the world of each episode of a table's curves, int64 [R, E]; the replica if the table has no
    worlds."""
    first = where(table.sort_by(ROW_ORDER), agent=0)
    return world_of(first)[_episode_rows(first)]


def _episode_rows(first: pa.Table) -> Int64:
    """Return the row of each episode of each replica in the rows of one agent, int64 [R, E], for as many
    episodes as all replicas have."""
    _, starts, counts = np.unique(first["replica"].to_numpy(), return_index=True, return_counts=True)
    return np.asarray(starts[:, None] + np.arange(counts.min()))


def episode_of_turn(table: pa.Table, turn: float) -> float | None:
    """Return the episode in which the replicas of a training reach a turn, as a mean over replicas; None if
    one does not reach it."""
    first = where(table, agent=0)
    replica = first["replica"].to_numpy()
    steps = first["steps"].to_numpy()
    world = world_of(first)
    ended = np.zeros(len(steps), np.int64)
    for number in np.unique(world):
        ended[world == number] = steps[world == number].cumsum()
    return episode_reached([ended[replica == number] for number in np.unique(replica)], turn)


def episode_reached(ended: Iterable[NDArray[Any]], turn: float) -> float | None:
    """Return the episode in which the replicas reach a turn, as a mean over replicas; None if one does not
    reach it.

    Args:
        ended: for each replica, the turns in which its episodes ended, [E].
    """
    firsts = []
    for turns in ended:
        if not (turns >= turn).any():
            return None
        firsts.append((turns >= turn).argmax())
    return float(np.mean(firsts))
