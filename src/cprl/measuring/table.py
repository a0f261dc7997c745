"""Tables of episode results: what every run and every evaluation returns, and what all statistics read.

A table has one row for each replica, world, episode and agent. Its columns are, in this order: labels,
which say what was played, such as "policy"; "replica"; "world" in tables of trainings; "episode"; "agent";
"role" if agents of several runs play together; then totals and metrics, by their names in
`cprl.measuring.registry`. The table of a run, `episodes.parquet`, is such a table.

A table of windows, as studies store it, has no rows of agents. It has the columns "metric", "value",
"window_episodes" and "undefined", one row for each metric and window of episodes.

Functions that take a `metric` accept the name of a metric of whole episodes ("equality",
"institutions/violations", one of the user's own), or WHO/WHAT for the mean of a column over some agents:
"agent_2/fines", "focal/return", "background/return".
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    FINES_TOTAL,
    IN_FORCE_PREFIX,
    INCOME,
    INSTITUTIONS,
    METRICS,
    TOTALS,
    compute_metrics,
    is_custom_metric,
)
from cprl.measuring.social import are_equal
from cprl.values.array_types import Int64

ROLE: Final = "role"
"""The column with the role of an agent among others: `FOCAL`, `BACKGROUND`, or `BOTH` in self-play."""
FOCAL: Final = "focal"
BACKGROUND: Final = "background"
BOTH: Final = "both"
WINDOWS: Final = "window_episodes"
"""The column with the number of episodes of a window; only tables of windows have it."""
_EPISODE_KEYS: Final = ("replica", "world", "episode")
"""The columns that tell an episode from others with the same labels."""
ROW_ORDER: Final = [(name, "ascending") for name in ("replica", "episode", "agent")]
"""The order of the rows of one run, for `pyarrow.Table.sort_by`."""
_AGENT: Final = "agent_"
"""The beginning of an agent's name in the name of a metric."""
_AGENT_NAMES: Final = b"agents"
"""The key of a table's metadata with the names that the game gives its agents."""


def complete(table: pa.Table) -> pa.Table:
    """Return the table with all metrics of the registry that its totals determine.

    Raises:
        ValueError: if a metric has to be computed and the rows are not whole episodes, each with all agents
            in order.
    """
    columns = {*table.column_names}
    missing = [name for name in METRICS if name not in columns]
    computable = [name for name in missing if columns >= {*METRICS[name].needs}]
    if not computable or not len(table) or WINDOWS in columns:
        return table
    agents = _count_agents(table)
    totals = {}
    needed = chain.from_iterable(METRICS[name].needs for name in computable)
    for name in columns & {*TOTALS} & {*needed}:
        values = table[name].to_numpy(zero_copy_only=False).astype(np.float64).reshape(-1, agents)
        is_of_each_agent = bool(TOTALS[name].axes)
        totals[name] = values if is_of_each_agent else values[:, 0]
    for name, values in compute_metrics(totals, computable).items():
        table = table.append_column(name, pa.array(np.repeat(values, agents)))
    return table


def _count_agents(table: pa.Table) -> int:
    """Return the number of agents of an episode; refuse rows that are not whole episodes."""
    agent = table["agent"].to_numpy()
    agents = int(agent.max()) + 1
    is_whole = np.array_equal(agent, np.arange(len(agent)) % agents)
    if is_whole and {"harvest", COLLECTIVE_RETURN} <= {*table.column_names}:
        # Rows that were chosen or sorted may still count 0, 1, 0, 1, but mix agents of different episodes.
        harvests = table["harvest"].to_numpy().astype(np.float64).reshape(-1, agents).sum(-1)
        is_whole = np.allclose(harvests, table[COLLECTIVE_RETURN].to_numpy()[::agents], rtol=1e-5)
    if not is_whole:
        raise ValueError(
            "the rows are not whole episodes, each of all agents in order; allowed: a table of one game that "
            "is sorted by agent last, or `cprl.measuring.table.complete` of it before rows are chosen"
        )
    return agents


def store_agent_names(table: pa.Table, agents: Sequence[str]) -> pa.Table:
    """Return the table with the names that the game gives its agents in the metadata, for `display_name`."""
    metadata = {**(table.schema.metadata or {}), _AGENT_NAMES: "\n".join(agents).encode()}
    return table.replace_schema_metadata(metadata)


def display_name(table: pa.Table, metric: str) -> str:
    """Return the name of a metric for readers: "ann/return" for "agent_0/return", if the game calls its first
    agent "ann"."""
    agent, _, total = metric.rpartition("/")
    names = (table.schema.metadata or {}).get(_AGENT_NAMES, b"").decode().splitlines()
    if not names or not agent.startswith(_AGENT):
        return metric
    return f"{names[int(agent.removeprefix(_AGENT))]}/{total}"


def where(table: pa.Table, **labels: object) -> pa.Table:
    """Return the rows in which each of these columns has the given value, or one of a tuple of values."""
    for name, value in labels.items():
        values = value if isinstance(value, tuple) else (value,)
        table = table.filter(pc.is_in(table[name], pa.array(values)))
    return table


Label = Mapping[str, str | int]
"""The labels of rows, by column: they say what was played."""


def labelled(table: pa.Table, **labels: object) -> pa.Table:
    """Return the table with labels as its first columns, the same in all rows; integers become int32."""
    for position, (name, value) in enumerate(labels.items()):
        dtype = pa.int32() if isinstance(value, int) else None
        table = table.add_column(position, name, pa.array([value] * len(table), dtype))
    return table


def labels_of(table: pa.Table) -> list[str]:
    """Return the names of the labels: the columns before the replica."""
    return list(table.column_names[: table.column_names.index("replica")])


def stored_metrics(schema: pa.Schema) -> list[str]:
    """Return the metrics that a table stores as columns, those of the user included."""
    floats = [field.name for field in schema if pa.types.is_floating(field.type)]
    totals_too = [name for name in METRICS if name in TOTALS and name in schema.names]
    return [*(name for name in floats if name not in TOTALS), *totals_too]


def all_metrics(table: pa.Table) -> list[str]:
    """Return the metrics of whole episodes that a table stores or determines, in the order in which pages
    show them: social metrics, the user's, those of institutions, decisions. The income is left out where it
    equals the harvest.
    """
    full = complete(table)
    columns = full.column_names
    if {INCOME, COLLECTIVE_RETURN} <= {*columns} and FINES_TOTAL not in columns:
        income = full[INCOME].to_numpy()
        if are_equal(income, full[COLLECTIVE_RETURN].to_numpy()):
            columns = [name for name in columns if name != INCOME]
    known = [name for name in METRICS if name in columns]
    custom = [name for name in stored_metrics(table.schema) if is_custom_metric(name)]
    social = [name for name in known if not name.startswith(INSTITUTIONS)]
    institutional = [name for name in known if name.startswith(INSTITUTIONS)]
    decisions = [name for name in columns if name.startswith(IN_FORCE_PREFIX)]
    return [*social, *custom, *institutional, *decisions]


def gain_metric(table: pa.Table) -> str:
    """Return the metric of what all agents get: the collective return, or the income in a game without a
    harvest."""
    return COLLECTIVE_RETURN if COLLECTIVE_RETURN in table.column_names else INCOME


def episodes(table: pa.Table, metric: str) -> pa.Table:
    """Return one row for each episode: its labels, replica, world and episode, and the "value" of the metric,
    null where it is undefined.

    Raises:
        KeyError: if the table does not have the metric.
    """
    if metric in METRICS and metric not in table.column_names:
        table = complete(table)
    rows, column = _rows_with(table, metric)
    names = [*labels_of(table), *_EPISODE_KEYS]
    keys = [name for name in names if name in rows.column_names]
    values = pc.cast(rows[column], pa.float64())
    values = pc.if_else(pc.is_nan(values), None, values)
    rows = rows.select(keys).append_column("value", values)
    if metric == column or metric.startswith(_AGENT):
        return rows
    # Several agents have the same role: their mean.
    rows = rows.group_by(keys, use_threads=False).aggregate([("value", "mean")])
    return rows.rename_columns([*keys, "value"])


def _rows_with(table: pa.Table, metric: str) -> tuple[pa.Table, str]:
    """Return the rows that hold a metric, and the column in which they hold it: for "agent_2/fines" the rows
    of agent 2 and the column "fines"."""
    columns = table.column_names
    is_of_each_agent = metric in TOTALS and bool(TOTALS[metric].axes)
    if metric in columns and not is_of_each_agent:
        return where(table, agent=0), metric  # all agents of an episode have the same value
    prefix, _, column = metric.rpartition("/")
    if column in columns:
        agents = {f"{_AGENT}{agent}": agent for agent in table["agent"].unique().to_pylist()}
        if prefix in agents:
            return where(table, agent=agents[prefix]), column
        if prefix in (FOCAL, BACKGROUND) and ROLE in columns:
            return where(table, **{ROLE: (prefix, BOTH)}), column
    raise KeyError(f"the table has no metric {metric}")


def by_replica(table: pa.Table, metric: str, by: Sequence[str] = ()) -> pa.Table:
    """Return one row for each replica and choice of labels: the mean "value" over the episodes in which the
    metric is defined, null if there are none; the number of "episodes"; and in how many of them the metric is
    "undefined".

    Args:
        by: the labels that tell rows apart; episodes that differ in other labels count together.

    Raises:
        KeyError: if the table has no such label or metric.
    """
    unknown = [name for name in by if name not in table.column_names]
    if unknown:
        raise KeyError(f"the table has no label {', '.join(unknown)}; it has {', '.join(labels_of(table))}")
    keys = [*by, "replica"]
    if WINDOWS in table.column_names:
        return _by_replica_of_windows(where(table, metric=metric), keys)
    return _by_replica_of_episodes(episodes(table, metric), keys)


def _by_replica_of_windows(windows: pa.Table, keys: Sequence[str]) -> pa.Table:
    """Return the mean of the windows' values, each weighted by the episodes in which it is defined."""
    defined = pc.cast(pc.subtract(windows[WINDOWS], windows["undefined"]), pa.float64())
    values = pc.if_else(pc.is_nan(windows["value"]), None, windows["value"])
    rows = windows.append_column("sum", pc.multiply(values, defined))
    rows = rows.group_by(keys, use_threads=False).aggregate(
        [(name, "sum") for name in ("sum", WINDOWS, "undefined")]
    )
    rows = rows.rename_columns([*keys, "sum", "episodes", "undefined"])
    means = pc.divide(rows["sum"], pc.subtract(rows["episodes"], rows["undefined"]))
    return rows.drop_columns("sum").add_column(len(keys), "value", means)


def _by_replica_of_episodes(rows: pa.Table, keys: Sequence[str]) -> pa.Table:
    """Return the mean over the episodes in which the value is not null."""
    count_all = pc.CountOptions(mode="all")
    count_undefined = pc.CountOptions(mode="only_null")
    groups = rows.group_by(keys, use_threads=False)
    means = groups.aggregate(
        [("value", "mean"), ("value", "count", count_all), ("value", "count", count_undefined)]
    )
    return means.rename_columns([*keys, "value", "episodes", "undefined"])


def world_of(table: pa.Table) -> Int64:
    """Return the world of each row, or its replica in tables without worlds."""
    name = "world" if "world" in table.column_names else "replica"
    return np.asarray(table[name].to_numpy().astype(np.int64))
