"""Episodes of several policies in one table, with columns that label them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from cprl.measuring import Episode
from cprl.runs.episodes import as_table
from cprl.runs.files import refuse_to_write_over, write_atomically

_COMPRESSED: Final = {"compression": "zstd", "compression_level": 19}

Label = Mapping[str, str | int]
"""The values of the first columns, by name."""


def labelled(parts: Iterable[tuple[Label, int, Sequence[Episode]]]) -> pa.Table:
    """A table like `episodes.parquet`, with label columns first.

    Args:
        parts: labels, all with the same names; the index of a replica; and its episodes, numbered from 0.
    """
    tables = []
    for label, replica, episodes in parts:
        table = as_table([replace(episode, episode=nth) for nth, episode in enumerate(episodes)], replica)
        for place, (name, value) in enumerate(label.items()):
            kind = pa.string() if isinstance(value, str) else pa.int32()
            table = table.add_column(place, pa.field(name, kind), pa.array([value] * len(table), kind))
        tables.append(table)
    return pa.concat_tables(tables)


def write_table(path: Path, table: pa.Table, *, over: bool = False) -> None:
    """Writes a parquet file atomically, in little room.

    Args:
        path: the file.
        table: what it holds.
        over: whether a file that exists is replaced.

    Raises:
        FileExistsError: if the file exists and is not to be replaced.
    """
    if not over:
        refuse_to_write_over(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    how = small(table)
    write_atomically(path, lambda file: pq.write_table(table, file, **how))


def small(table: pa.Table) -> dict[str, Any]:
    """How parquet holds a table in little room: each column by dictionary, split into bytes, or as it is,
    whichever is smallest."""
    chosen: dict[str, list[str]] = {"use_dictionary": [], "use_byte_stream_split": []}
    for field in table.schema:
        ways: list[dict[str, Any]] = [{"use_dictionary": True}, {"use_dictionary": False}]
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            ways.append({"use_dictionary": False, "use_byte_stream_split": True})
        best = min(ways, key=partial(_size, table.select([field.name])))
        for way, columns in chosen.items():
            if best.get(way):
                columns.append(field.name)
    return {**_COMPRESSED, **chosen}


def _size(column: pa.Table, how: Mapping[str, Any]) -> int:
    written = BytesIO()
    pq.write_table(column, written, compression="zstd", compression_level=3, **how)  # which is quick
    return written.tell()
