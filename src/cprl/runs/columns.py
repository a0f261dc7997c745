"""The columns of a table of episodes, and episodes as rows of it."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from cprl.institutions import COUNTS
from cprl.measuring import Episode, social
from cprl.measuring.reported import left_out

COLUMNS: Final = {
    "replica": pa.int32(),
    "episode": pa.int32(),
    "agent": pa.int32(),
    "return": pa.float32(),
    "wanted_return": pa.float32(),
    "harvest": pa.float32(),
    "steps": pa.int32(),
    "in_play_steps": pa.int32(),
    "shots": pa.int32(),
    "hits": pa.int32(),
    "tagged": pa.int32(),
    "stock_left": pa.int32(),
    "depletion_step": pa.int32(),
    "terminated": pa.bool_(),
}
"""The columns of a table, as in `Episode`; the metrics follow, float64, NaN where undefined.

Values of the whole episode are repeated in the row of each agent. Values that the game does not report have
no column; nor has the wanted return outside of a training. It is null for agents that do not learn."""

_WANTED: Final = "wanted_return"
_LATER: Final = {_WANTED, "yield_share"}
"""Columns that tables of earlier versions lack."""

OF_INSTITUTIONS: Final = {
    "decision": pa.int32(),
    "fines": pa.float64(),
    "transfers": pa.float64(),
    "violations": pa.int32(),
    **{name: pa.int32() for name in COUNTS if name != "violations"},
}
"""The columns of a game with institutions, between those of `COLUMNS` and the metrics; those of counts only
where `cprl.measuring.institutions.counts_for` has them. One for each decision in force follows, `in_force_0`
and so on, float64."""

LEFT_OUT: Final = b"left_out"
"""The key of the schema's metadata whose value says which columns are left out, and why, if any are."""


def whole_schema() -> pa.Schema:
    """All columns and metrics, for a table without an episode."""
    return _schema(COLUMNS, (), (*social.METRICS, "yield_share"))


def _schema(columns: Iterable[str], more: Iterable[str], metrics: Iterable[str]) -> pa.Schema:
    return pa.schema(
        {name: COLUMNS[name] for name in columns}
        | {name: OF_INSTITUTIONS.get(name, pa.float64()) for name in more}
        | dict.fromkeys(metrics, pa.float64())
    )


def schema_of(episode: Episode) -> pa.Schema:
    """The columns that an episode has; the schema's metadata names those that it lacks."""
    schema = _schema(_columns_of(episode), _of_institutions(episode), episode.metrics)
    missing = left_out(episode.reported)
    return schema.with_metadata({LEFT_OUT: missing}) if missing else schema


def _columns_of(episode: Episode) -> list[str]:
    return [name for name in COLUMNS if getattr(episode, name, "") is not None]


def _of_institutions(episode: Episode) -> dict[str, Any]:
    """The values of the columns of institutions, [N] or a number; none for a game without them."""
    payments = {"fines": episode.fines, "transfers": episode.transfers, "violations": episode.violations}
    payments["decision"] = episode.decision
    found = {**(episode.counts or {}), **{name: own for name, own in payments.items() if own is not None}}
    in_force: list[float] = [] if episode.in_force is None else episode.in_force.tolist()
    return {
        **{name: found[name] for name in OF_INSTITUTIONS if name in found},
        **{f"in_force_{nth}": value for nth, value in enumerate(in_force)},
    }


def rows_of(episodes: Sequence[Episode], replica: int | None, schema: pa.Schema) -> pa.RecordBatch:
    """A row for each episode and agent.

    Args:
        episodes: at least one.
        replica: the index of their replica; None for each episode's world.
        schema: what `schema_of` gave for the first episode of the table.

    Raises:
        ValueError: if an episode has other columns.
    """
    of_each = [_cells(episode, episode.world if replica is None else replica) for episode in episodes]
    for cells in of_each:
        for name in _LATER - set(schema.names):  # a table that an earlier cprl began goes on without it
            cells.pop(name, None)
        if cells.keys() != set(schema.names):
            more, lacks = cells.keys() - set(schema.names), set(schema.names) - cells.keys()
            raise ValueError(
                f"the episode has the extra columns {sorted(more)} and lacks {sorted(lacks)}; allowed: the "
                "columns of the table's first episode"
            )
    return pa.record_batch(
        [
            pa.array(
                np.concatenate([cells[column.name] for cells in of_each]),
                column.type,
                from_pandas=column.name == _WANTED,  # no number, of agents that do not learn, is null
            )
            for column in schema
        ],
        schema=schema,
    )


def _cells(episode: Episode, replica: int) -> dict[str, Any]:
    """The values of each column, [N]."""
    own = {name: getattr(episode, name, None) for name in _columns_of(episode)}
    agents = np.arange(len(episode.return_))
    cells: dict[str, Any] = {
        **own,
        "replica": replica,
        "agent": agents,
        "return": episode.return_,
        **_of_institutions(episode),
        **episode.metrics,
    }
    return {name: np.broadcast_to(cell, agents.shape) for name, cell in cells.items()}
