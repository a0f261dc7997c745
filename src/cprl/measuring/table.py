"""The one currency after an episode: a tidy table, a row for each label, replica, world, episode and agent.

Its columns are labels, which say what was played; "replica", "world" where it is of a training, "episode" and
"agent"; "role", of an agent among others; totals and metrics, by the names of `cprl.measuring.registry`. So
are the table of a run, `episodes.parquet`, and what every evaluation returns. A table of windows, as studies
keep it, has instead of agents "metric", "window_episodes", "undefined" and "value".

A number of episodes has a name: a metric ("equality", "institutions/violations", one of the user's own), or
WHO/WHAT of some agents, the mean of theirs: "agent_2/fines", "focal/return", "background/return".
"""

from collections.abc import Mapping, Sequence
from itertools import chain
from math import inf
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    FINES,
    IN_FORCE,
    INCOME,
    INSTITUTIONS,
    METRICS,
    TOTALS,
    is_own,
    measured,
)
from cprl.values.arrays import Int64

ROLE: Final = "role"
"""The column that says what an agent is among others: `FOCAL`, `BACKGROUND`, or `BOTH` in self-play."""
FOCAL: Final = "focal"
BACKGROUND: Final = "background"
BOTH: Final = "both"
WINDOWS: Final = "window_episodes"
"""The column that tables of windows have."""
_INDICES: Final = ("replica", "world", "episode", "agent")
_AGENT: Final = "agent_"
_NAMES: Final = b"agents"
"""Of a table's metadata: what the game calls the agents."""


def complete(table: pa.Table, constants: Mapping[str, Any] | None = None) -> pa.Table:
    """Return a table with every metric of the registry that its totals give, where it lacks one.

    Args:
        constants: of the game, see `cprl.measuring.registry.measured`.

    Raises:
        ValueError: if it lacks one and its rows are not whole episodes, each of all agents in order.
    """
    columns = {*table.column_names}
    given = columns | {*(constants or {})}
    lacking = [name for name, metric in METRICS.items() if name not in columns and given >= {*metric.needs}]
    if not lacking or not len(table) or WINDOWS in columns:
        return table
    agents = _agents_of(table)
    totals = dict(constants or {})
    needs = chain.from_iterable(METRICS[name].needs for name in lacking)
    for name in columns & {*TOTALS} & {*needs}:
        values = table[name].to_numpy(zero_copy_only=False).astype(np.float64).reshape(-1, agents)
        totals[name] = values if TOTALS[name].axes else values[:, 0]
    for name, values in measured(totals, lacking).items():
        table = table.append_column(name, pa.array(np.repeat(values, agents)))
    return table


def _agents_of(table: pa.Table) -> int:
    """Return how many agents the episodes have; refuse rows that are not those of all, in order."""
    agent = table["agent"].to_numpy()
    agents = int(agent.max()) + 1
    is_whole = np.array_equal(agent, np.arange(len(agent)) % agents)
    if is_whole and {"harvest", COLLECTIVE_RETURN} <= {*table.column_names}:
        apples = table["harvest"].to_numpy().astype(np.float64).reshape(-1, agents).sum(-1)
        is_whole = np.allclose(apples, table[COLLECTIVE_RETURN].to_numpy()[::agents], rtol=1e-5)
    if not is_whole:
        raise ValueError(
            "the rows are not whole episodes, each of all agents in order; allowed: a table of one game that "
            "is sorted by agent last, or `cprl.measuring.table.complete` of it before rows are chosen"
        )
    return agents


def naming(table: pa.Table, agents: Sequence[str]) -> pa.Table:
    """Return a table whose metadata say what its game calls the agents, see `agents_named`."""
    metadata = {**(table.schema.metadata or {}), _NAMES: "\n".join(agents).encode()}
    return table.replace_schema_metadata(metadata)


def agents_named(table: pa.Table, number: str) -> str:
    """Return a number by what the game calls its agent, e.g. "ann/return" for "agent_0/return"."""
    who, _, what = number.rpartition("/")
    names = (table.schema.metadata or {}).get(_NAMES, b"").decode().splitlines()
    if not names or not who.startswith(_AGENT):
        return number
    return f"{names[int(who.removeprefix(_AGENT))]}/{what}"


def where(table: pa.Table, **labels: object) -> pa.Table:
    """Return the rows with these labels; a tuple stands for any of them."""
    for name, value in labels.items():
        each = value if isinstance(value, tuple) else (value,)
        table = table.filter(pc.is_in(table[name], pa.array(each)))
    return table


Label = Mapping[str, str | int]
"""What was played: the values of the first columns of a table, by name."""


def labelled(table: pa.Table, **labels: object) -> pa.Table:
    """Return a table with these columns first, each of one value."""
    for place, (name, value) in enumerate(labels.items()):
        kind = pa.int32() if isinstance(value, int) else None
        table = table.add_column(place, name, pa.array([value] * len(table), kind))
    return table


def labels_of(table: pa.Table) -> list[str]:
    """Return the columns before the replica: what was played."""
    return list(table.column_names[: table.column_names.index("replica")])


def metrics_in(schema: pa.Schema) -> list[str]:
    """Return the stored metrics among the columns of a table, those of the user's own included."""
    floats = [field.name for field in schema if pa.types.is_floating(field.type)]
    counted = [name for name in METRICS if name in TOTALS and name in schema.names]
    return [*(name for name in floats if name not in TOTALS), *counted]


def numbers_in(table: pa.Table) -> list[str]:
    """Return the names of the numbers of whole episodes in a table in the order of pages: the social ones,
    the user's own, those of institutions, and what was decided.

    The income is among them where it is not the harvest.
    """
    whole = complete(table)
    columns = whole.column_names
    if {INCOME, COLLECTIVE_RETURN} <= {*columns} and FINES not in columns:
        income = whole[INCOME].to_numpy()
        if np.allclose(income, whole[COLLECTIVE_RETURN].to_numpy(), rtol=1e-6, atol=1e-6, equal_nan=True):
            columns = [name for name in columns if name != INCOME]
    known = [name for name in METRICS if name in columns]
    own = [name for name in metrics_in(table.schema) if is_own(name)]
    is_social = {name: not name.startswith(INSTITUTIONS) for name in known}
    social = [name for name in known if is_social[name]]
    of_institutions = [name for name in known if not is_social[name]]
    return [*social, *own, *of_institutions, *(name for name in columns if name.startswith(IN_FORCE))]


def episodes(table: pa.Table, number: str) -> pa.Table:
    """Return a row for each episode: its labels, replica, world, episode, and the "value" of a number, null
    where it is undefined."""
    if number in METRICS and number not in table.column_names:
        table = complete(table)
    who, _, what = number.rpartition("/")
    columns = table.column_names
    agent = who.removeprefix(_AGENT)
    if number in columns and not (number in TOTALS and TOTALS[number].axes):
        rows = where(table, agent=0)
        column = number
    elif what in columns and who != agent and agent in map(str, table["agent"].unique().to_pylist()):
        rows = where(table, agent=int(agent))
        column = what
    elif what in columns and who in (FOCAL, BACKGROUND) and ROLE in columns:
        rows = where(table, **{ROLE: (who, BOTH)})
        column = what
    else:
        raise KeyError(f"the table has no number {number}")
    names = [*labels_of(table), *_INDICES[:3]]
    keys = [name for name in names if name in rows.column_names]
    values = pc.cast(rows[column], pa.float64())
    values = pc.if_else(pc.is_nan(values), None, values)
    found = rows.select(keys).append_column("value", values)
    if who not in (FOCAL, BACKGROUND):
        return found
    found = found.group_by(keys, use_threads=False).aggregate([("value", "mean")])
    return found.rename_columns([*keys, "value"])


def by_replica(table: pa.Table, number: str, by: Sequence[str] = ()) -> pa.Table:
    """Return a row for each replica of each choice of labels: the mean "value" over the episodes in which a
    number is defined, null where there are none, how many "episodes" there were, and in how many it is
    "undefined".

    Args:
        by: the labels that are kept apart; episodes of all others count together.
    """
    unknown = [name for name in by if name not in table.column_names]
    if unknown:
        raise KeyError(f"the table has no label {', '.join(unknown)}; it has {', '.join(labels_of(table))}")
    keys = [*by, "replica"]
    counts = ["episodes", "undefined"]
    if WINDOWS in table.column_names:
        rows = where(table, metric=number)
        defined = pc.cast(pc.subtract(rows[WINDOWS], rows["undefined"]), pa.float64())
        sums = pc.if_else(pc.equal(defined, 0), 0.0, pc.multiply(rows["value"], defined))
        parts = {"sum": sums, "defined": defined, "episodes": rows[WINDOWS], "undefined": rows["undefined"]}
        rows = pa.table({**{name: rows[name] for name in keys}, **parts})
        rows = rows.group_by(keys, use_threads=False).aggregate([(name, "sum") for name in parts])
        rows = rows.rename_columns([*keys, *parts])
        count = pc.if_else(pc.equal(rows["defined"], 0), None, rows["defined"])
        return rows.select([*keys, *counts]).add_column(len(keys), "value", pc.divide(rows["sum"], count))
    every = pc.CountOptions(mode="all")
    null = pc.CountOptions(mode="only_null")
    rows = episodes(table, number).group_by(keys, use_threads=False)
    rows = rows.aggregate([("value", "mean"), ("value", "count", every), ("value", "count", null)])
    return rows.rename_columns([*keys, "value", *counts])


def clock_of(table: pa.Table) -> float:
    """Return the steps of an episode that the clock ended, infinity where none was."""
    columns = {*table.column_names}
    if WINDOWS in columns or not {"terminated", "steps"} <= columns:
        return inf
    steps = table.filter(pc.invert(table["terminated"]))["steps"]
    return float(pc.max(steps).as_py()) if len(steps) else inf


def world_of(table: pa.Table) -> Int64:
    """Return the world of each row; of a table that has none, the replica."""
    name = "world" if "world" in table.column_names else "replica"
    return np.asarray(table[name].to_numpy().astype(np.int64))
