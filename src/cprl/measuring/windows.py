"""Windows of episodes, in which every world of a replica counts alike.

"The last n episodes" of a replica in W worlds are the last ceil(n / W) that each of its worlds has ended: of
worlds that begin together, those who ended last are the longest episodes, those who ended first the shortest.
"""

from typing import Final

import numpy as np
import pyarrow as pa

from cprl.measuring.table import labels_of, world_of
from cprl.values.array_types import Float64, Int64

SMOOTHED_EPISODES: Final = 100
"""The default window of running means, in episodes."""


def last_of(table: pa.Table, number: int) -> pa.Table:
    """Return the rows of the last `number` episodes of each replica, rounded up to equally many of each of
    its W worlds.

    The last ones of all worlds together would be the longest, if worlds began together. If a world has ended
    fewer episodes, fewer of each world are returned.

    Raises:
        ValueError: if the table has labels, and so may hold several runs.
    """
    if labels := labels_of(table):
        raise ValueError(f"the table is labelled by {', '.join(labels)}; allowed: the episodes of one run")
    world = world_of(table)
    episode = table["episode"].to_numpy().astype(np.int64)
    size = int(episode.max(initial=0)) + 1
    keys, row = np.unique(world * size + episode, return_inverse=True)
    worlds, counts = np.unique(keys // size, return_counts=True)
    count = episodes_per_world(number, len(worlds) // len(np.unique(table["replica"].to_numpy())))
    is_last = episodes_after(keys // size) < min(count, counts.min())
    return table.filter(pa.array(is_last[row]))


def episodes_per_world(number: int, worlds: int) -> int:
    """Return the episodes of each of W worlds in a mean over `number` episodes."""
    return -(-number // worlds)


def episodes_after(world: Int64) -> Int64:
    """Return for each episode of a replica how many later episodes its world has, [E] in order."""
    order = np.argsort(world, kind="stable")
    counts = np.unique(world, return_counts=True)[1]
    after = np.empty(len(world), np.int64)
    after[order] = np.repeat(counts.cumsum(), counts) - 1 - np.arange(len(world))
    return after


def smoothed_episodes(episodes: int) -> int:
    """Return the episodes of the running means of a training: 100, or 1/20 of all if that is less, so that
    the curve of a short one keeps its shape."""
    return min(SMOOTHED_EPISODES, max(1, episodes // 20))


def mean_of_worlds(values: Float64, worlds: Int64, window: int) -> Float64:
    """Return the mean over the last episodes at each episode of a replica, in which every world counts alike.

    Args:
        values: [E], in the order in which episodes ended.
        worlds: [E], the world of each.
        window: the episodes of the mean, rounded up to a multiple of the number of worlds; in one world it is
            the `running_mean`.

    Returns:
        [E], each mean at its last episode; NaN until each world has ended enough episodes.
    """
    distinct_worlds, counts = np.unique(worlds, return_counts=True)
    count = min(episodes_per_world(min(window, len(values)), len(distinct_worlds)), int(counts.min()))
    if len(distinct_worlds) == 1:
        return np.concatenate([np.full(count - 1, np.nan), running_mean(values, count)])
    means = np.full((len(distinct_worlds), len(values)), np.nan)
    for index, world in enumerate(distinct_worlds):
        ended = np.flatnonzero(worlds == world)
        curve = running_mean(values[ended], count)
        latest = np.searchsorted(ended, np.arange(len(values)), side="right") - count
        means[index, latest >= 0] = curve[latest[latest >= 0]]
    return np.asarray(means.mean(0))


def running_mean(values: Float64, window: int = SMOOTHED_EPISODES) -> Float64:
    """Return means over `window` consecutive values, each at the position of the first,
    [..., len - window + 1].

    With fewer values, it is the mean of all. Undefined values are skipped; NaN if all are undefined.
    """
    window = min(window, values.shape[-1])
    is_defined = ~np.isnan(values)
    sums = np.cumsum(_after_a_zero(np.where(is_defined, values, 0.0)), -1)
    counts = np.cumsum(_after_a_zero(is_defined.astype(np.float64)), -1)
    with np.errstate(invalid="ignore"):
        means: Float64 = (sums[..., window:] - sums[..., :-window]) / (
            counts[..., window:] - counts[..., :-window]
        )
    return means


def _after_a_zero(values: Float64) -> Float64:
    return np.concatenate([np.zeros((*values.shape[:-1], 1)), values], -1)
