"""The episodes of a run as curves: a number for each replica and episode, smoothed as in the study."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute
import torch
from numpy.typing import NDArray

from cprl.institutions import COUNTS
from cprl.measuring import phases
from cprl.measuring.institutions import METRICS
from cprl.measuring.social import Totals, measured
from cprl.runs.episodes import OF_INSTITUTIONS, metrics_in, read_episodes

Values = NDArray[np.float64]
Numbers = NDArray[np.int64]

SMOOTHED_EPISODES: Final = 100
"""The window of running means in episodes, where nothing else is asked for."""


def curves_of(run: Path, *, last: int | None = None) -> dict[str, Values]:
    """Read every metric that a run's game reports, and each agent's return as `return_0` and so on.

    Those of institutions are there as `institutions/fines` and so on.

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
    table = table if last is None else last_of(table, last)
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
    return _of_institutions(table.column_names, values) | curves


def worlds_of(table: pa.Table) -> Numbers:
    """Return the world of each episode of the curves of a table, int64 [R, E]; of a table that has none, the
    replica."""
    replica, place, shape = _places(table)
    read = place < shape[1]
    worlds = np.zeros(shape, np.int64)
    worlds[replica[read], place[read]] = _world(table)[read]
    return worlds


LAST_EPISODES: Final = 30
"""Those at the end of a training, unless somebody says how many."""


def last_of(table: pa.Table, number: int) -> pa.Table:
    """Return the rows of the last episodes of each replica: as many of each of its W worlds, and so many of
    all together, or the next multiple of W.

    The last that have ended, of all worlds, would be the longest ones where worlds began together. Where a
    world has ended fewer, only as many of each world are there.
    """
    world = _world(table)
    episode = table["episode"].to_numpy().astype(np.int64)
    size = int(episode.max(initial=0)) + 1
    keys, row = np.unique(world * size + episode, return_inverse=True)
    lanes, counts = np.unique(keys // size, return_counts=True)
    each = rounds_of(number, len(lanes) // len(np.unique(table["replica"].to_numpy())))
    is_last = episodes_after(keys // size) < min(each, counts.min())
    return table.filter(pa.array(is_last[row]))


def rounds_of(number: int, worlds: int) -> int:
    """Return of how many episodes of each of W worlds a mean of so many episodes is."""
    return -(-number // worlds)


def episodes_after(world: Numbers) -> Numbers:
    """Return how many later episodes its world has, of each episode of a replica, [E] in order."""
    order = np.argsort(world, kind="stable")
    counts = np.unique(world, return_counts=True)[1]
    after = np.empty(len(world), np.int64)
    after[order] = np.repeat(counts.cumsum(), counts) - 1 - np.arange(len(world))
    return after


def mean_of_worlds(values: Values, worlds: Numbers, window: int) -> Values:
    """Return the mean of the last episodes at each episode of a replica, in which every world counts alike.

    Args:
        values: [E], in the order in which episodes ended.
        worlds: [E], that of each.
        window: of so many episodes, or the next multiple of the number of worlds; in one world it is the
            `running_mean`.

    Returns:
        [E], at the last of the episodes that it is a mean of; NaN before each world has ended so many.
    """
    lanes = np.unique(worlds)
    each = rounds_of(min(window, len(values)), len(lanes))
    each = min(each, int(np.unique(worlds, return_counts=True)[1].min()))
    means = np.full((len(lanes), len(values)), np.nan)
    for lane, world in enumerate(lanes):
        ended = np.flatnonzero(worlds == world)
        of_world = running_mean(values[ended], each)
        latest = np.searchsorted(ended, np.arange(len(values)), side="right") - each
        means[lane, latest >= 0] = of_world[latest[latest >= 0]]
    return np.asarray(means.mean(0))


def _world(table: pa.Table) -> Numbers:
    name = "world" if "world" in table.column_names else "replica"
    return np.asarray(table[name].to_numpy().astype(np.int64))


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


def net_of(curves: Mapping[str, Values]) -> Values:
    """Return the sum of the rewards of all agents, [R, E]: the harvest after fines and transfers."""
    returns = [curve for name, curve in curves.items() if name.startswith("return_")]
    return np.asarray(np.sum(returns, axis=0))


def _of_institutions(names: Sequence[str], values: Callable[[str], Values]) -> dict[str, Values]:
    """Return the curves of institutions, [R, E] by name; none for a game without them.

    Tables of before 0.1.0 have no column for their metrics: these are computed from the columns that they
    have, but for the share of unjust tags and for groups.
    """
    if not {*names} & {*OF_INSTITUTIONS}:
        return {}

    def tensors(columns: Sequence[str]) -> dict[str, Any]:
        return {name: torch.from_numpy(values(name)) for name in columns if name in names}

    given = tensors(("harvest", "in_play_steps", "fines", "transfers", "violations"))
    if "violations" in given:
        given["counts"] = tensors(COUNTS)
    curves = {name: curve.numpy() for name, curve in measured(METRICS, Totals(**given)).items()}
    curves |= {name: values(name)[..., 0] for name in names if name.startswith("in_force_")}
    return {f"institutions/{name}": curve for name, curve in curves.items()}


def running_mean(values: Values, window: int = SMOOTHED_EPISODES) -> Values:
    """Return means over `window` consecutive values, each at the position of the first,
    [..., len - window + 1].

    With fewer values, the mean of all. Undefined values are skipped; NaN where no value is defined.
    """
    window = min(window, values.shape[-1])
    is_defined = ~np.isnan(values)
    sums = np.cumsum(_after_a_zero(np.where(is_defined, values, 0.0)), -1)
    counts = np.cumsum(_after_a_zero(is_defined.astype(np.float64)), -1)
    with np.errstate(invalid="ignore"):
        means: Values = (sums[..., window:] - sums[..., :-window]) / (
            counts[..., window:] - counts[..., :-window]
        )
    return means


def centres(values: Values, window: int) -> Values:
    """The episode at the centre of each running mean over `window` of these values, [..., E] to [...]."""
    window = min(window, values.shape[-1])
    return np.arange(values.shape[-1] - window + 1) + (window - 1) / 2


def phases_of(curves: dict[str, Values], *, centred: bool = False) -> list[phases.Phase] | None:
    """Return the phases of a training, of running means over `SMOOTHED_EPISODES`.

    Args:
        centred: whether an episode is the centre of its running mean; else its first, as in the study.

    Returns:
        None for a number of episodes that is not in `phases.EPISODES`, a single agent, a game that does not
        report the metrics, or a metric that is undefined in a whole window.
    """
    if not set(phases.METRICS) <= set(curves) or "return_1" not in curves:
        return None
    whole = curves["survival_steps"]
    if whole.shape[1] not in phases.EPISODES:
        return None
    smoothed = {name: running_mean(curves[name]) for name in phases.METRICS}
    if any(np.isnan(means).all(0).any() for means in smoothed.values()):
        return None
    at = centres(whole, SMOOTHED_EPISODES)
    return phases.find_phases(at if centred else at - at[0], smoothed)


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


def _after_a_zero(values: Values) -> Values:
    return np.concatenate([np.zeros((*values.shape[:-1], 1)), values], -1)
