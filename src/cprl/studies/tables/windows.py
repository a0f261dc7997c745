"""The episodes of a run as means over windows of them, by part of the run, replica and metric."""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.measuring import social
from cprl.runs.curves import as_curves
from cprl.runs.episodes import read_episodes, read_table
from cprl.studies.tables.sources import Source

TRAINING: Final = "training"
EVALUATION: Final = "evaluation"
RANDOM: Final = "random"
PARTS: Final = {TRAINING: None, EVALUATION: "trained", RANDOM: "random"}
"""The parts of a run: its training, its agents in fresh worlds afterwards, and random play in these worlds;
with the name of the table that holds it."""
NET: Final = "net"
"""The return of all agents together: harvest - fines + transfers, where a game has institutions."""

Values = NDArray[np.float64]


class Windows(NamedTuple):
    """A metric in one part of a run, for R replicas and W windows."""

    part: str
    metric: str
    episodes: NDArray[np.int64]
    """The first episode of each window, [W]."""
    lengths: NDArray[np.int64]
    """Episodes of each window, [W]; the last one may be shorter."""
    undefined: NDArray[np.int64]
    """Episodes in which the metric is undefined, [R, W]."""
    values: Values
    """Means over the episodes in which it is defined, [R, W]; NaN where there are none."""


def windows_of(source: Source, window: int) -> Iterator[Windows]:
    """Every metric of every part of a finished run.

    In training, windows are of so many episodes; evaluation and random play are one window each, but for
    `window=1`.

    Raises:
        ValueError: for a damaged file, and for episodes that are there twice or not at all.
        FileNotFoundError: if a part is missing.
    """
    for part, table_name in PARTS.items():
        if table_name is None:
            table = read_episodes(source.run)
        else:
            table = read_table(source.run / "evaluation" / f"{table_name}.parquet")
        _check_episodes(table, source, part)
        curves = as_curves(table)
        curves[NET] = np.sum([own for name, own in curves.items() if name.startswith("return_")], axis=0)
        for metric, values in curves.items():
            length = window if part == TRAINING or window == 1 else values.shape[1]
            yield Windows(part, metric, *in_windows(values, length))


def in_windows(values: Values, window: int) -> tuple[Any, Any, Any, Values]:
    """First episodes, [W], lengths, [W], undefined episodes, [R, W], and means, [R, W], of values [R, E]."""
    firsts = np.arange(0, values.shape[1], window)
    lengths = np.diff(np.append(firsts, values.shape[1]))
    defined = ~np.isnan(values)
    counts = np.add.reduceat(defined.astype(np.int64), firsts, axis=1)
    with np.errstate(invalid="ignore"):
        means = np.add.reduceat(np.where(defined, values, 0.0), firsts, axis=1) / counts
    return firsts, lengths, lengths - counts, means


def ordered(metrics: set[str]) -> list[str]:
    """Metrics in the order of tables: social ones, returns of single agents, those of institutions."""
    social_ones = [*social.METRICS, "yield_share", NET]

    def place(name: str) -> tuple[int, int, str]:
        if name in social_ones:
            return 0, social_ones.index(name), ""
        number = name.removeprefix("return_")
        return (1, int(number), "") if number.isdecimal() else (2, 0, name)

    return sorted(metrics, key=place)


def _check_episodes(table: pa.Table, source: Source, part: str) -> None:
    """Raises a ValueError unless each episode of each replica is there once."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    rows = np.stack([replica, episode, agent], axis=1)
    each, times = np.unique(rows, axis=0, return_counts=True)
    if (times > 1).any():
        twice = each[times > 1][0].tolist()
        raise ValueError(f"{source.name} has episode {twice[1]} of replica {twice[0]} in {part} twice")
    played = np.unique(rows[:, :2], axis=0)
    replicas, counts = np.unique(played[:, 0], return_counts=True)
    wanted = source.episodes if part == TRAINING else counts.max(initial=0)
    if replicas.tolist() != list(range(source.replicas)) or not (counts == wanted).all() or not wanted:
        found = dict(zip(replicas.tolist(), counts.tolist(), strict=True))
        raise ValueError(
            f"{source.name} has these episodes by replica in {part}: {found}; allowed: {wanted} of each of "
            f"{source.replicas} replicas"
        )
