"""Episodes of several policies in one table, with columns that label them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cprl.measuring import Episode
from cprl.runs.episodes import as_table
from cprl.runs.files import write_atomically

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


def refuse_to_write_over(path: Path) -> None:
    """Checks before hours of work that its output file does not exist.

    Raises:
        FileExistsError: if the file exists.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists and is not overwritten; use another name")


def write_table(path: Path, table: pa.Table, *, over: bool = False) -> None:
    """Writes a parquet file atomically, as small as it gets.

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
    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd", compression_level=19))
