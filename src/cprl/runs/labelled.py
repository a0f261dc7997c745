"""Episodes of several players in one table, in columns of their own who played."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cprl.measuring import Episode
from cprl.runs.files import write_atomically
from cprl.runs.episodes import as_table

Label = Mapping[str, str | int]
"""What stands in the first columns, by their names."""


def labelled(parts: Iterable[tuple[Label, int, Sequence[Episode]]]) -> pa.Table:
    """A table as `episodes.parquet`, behind columns that say who played.

    Args:
        parts: labels, all with the same names; the number of a replica; and its episodes, which are numbered
            from 0.
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
    """Asked before hours of work whose outcome goes there.

    Raises:
        FileExistsError: where there is a file.
    """
    if path.exists():
        raise FileExistsError(f"{path} exists and is kept; name another file")


def write_table(path: Path, table: pa.Table) -> None:
    """Writes a parquet file, all or nothing.

    Raises:
        FileExistsError: where there is a file.
    """
    refuse_to_write_over(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: pq.write_table(table, file))
