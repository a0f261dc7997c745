"""The episodes of a run as curves: a number for each replica and episode, smoothed as in the study."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from numpy.typing import NDArray

from cprl.measuring.table import Numbers, complete, metrics_in, world_of
from cprl.measuring.windows import Values, last_of
from cprl.runs.episodes import read_episodes


def curves_of(run: Path, *, last: int | None = None) -> dict[str, Values]:
    """Read every metric that a run's game reports, and each agent's return as `return_0` and so on.

    Args:
        last: of each replica only the last episodes, see `last_of`; by default all.

    Returns:
        float64 [R, E] by name, for R replicas and as many episodes as all of them have ended; NaN where a
        metric is undefined. Nothing of a run that has ended no episode.
    """
    return as_curves(read_episodes(run), last=last)


def as_curves(table: pa.Table, *, last: int | None = None) -> dict[str, Values]:
    """Like `curves_of`, from a table of `read_episodes`."""
    if not table.num_rows:
        return {}
    table = complete(table if last is None else last_of(table, last))
    agent = table["agent"].to_numpy()
    replica, place, shape = _places(table)
    read = place < shape[1]
    cells = replica[read], place[read], agent[read]

    def values(name: str) -> Values:
        """A column as [R, E, N]."""
        column = np.full((*shape, int(agent.max()) + 1), np.nan)
        column[cells] = table[name].to_numpy()[read]
        return column

    curves = {name: values(name)[..., 0].copy() for name in metrics_in(table.schema)}
    returns = values("return")
    curves |= {f"return_{number}": returns[..., number].copy() for number in np.unique(agent)}
    return curves


def worlds_of(table: pa.Table) -> Numbers:
    """Return the world of each episode of the curves of a table, int64 [R, E]; of a table that has none, the
    replica."""
    replica, place, shape = _places(table)
    read = place < shape[1]
    worlds = np.zeros(shape, np.int64)
    worlds[replica[read], place[read]] = world_of(table)[read]
    return worlds


def _places(table: pa.Table) -> tuple[Numbers, Numbers, tuple[int, int]]:
    """Return the row and the place of each row's episode in its replica, and how many of both: R, and as many
    episodes as all replicas have."""
    replicas, replica = np.unique(table["replica"].to_numpy(), return_inverse=True)
    episode = table["episode"].to_numpy().astype(np.int64)
    size = int(episode.max()) + 1
    keys, row = np.unique(replica * size + episode, return_inverse=True)
    firsts = np.searchsorted(keys // size, np.arange(len(replicas)))
    counts = np.diff(np.append(firsts, len(keys)))
    return replica, row - firsts[replica], (len(replicas), int(counts.min()))


def episode_of_turn(table: pa.Table, turn: float) -> float | None:
    """The episode with which the replicas of a training reach a turn, their mean; None if one does not."""
    first = table.filter(pa.compute.equal(table["agent"], 0))
    replica, steps = first["replica"].to_numpy(), first["steps"].to_numpy()
    world = first["world"].to_numpy() if "world" in first.column_names else replica
    ended = np.zeros(len(steps), np.int64)
    for number in np.unique(world):
        ended[world == number] = steps[world == number].cumsum()
    return episode_reached([ended[replica == number] for number in np.unique(replica)], turn)


def episode_reached(ended: Iterable[NDArray[Any]], turn: float) -> float | None:
    """The episode with which the replicas reach a turn, their mean, from the turns in which the episodes of
    each ended, [E]; None if one does not."""
    reached = [of_replica >= turn for of_replica in ended]
    return float(np.mean([each.argmax() for each in reached])) if all(map(np.any, reached)) else None
