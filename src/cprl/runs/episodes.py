"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`, an Arrow stream. Unlike a
parquet file a stream needs no footer, so it stays readable if the process is killed. `EpisodeTable.close`
converts the journal to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from errno import EIO
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tensordict import TensorDictBase

from cprl.measuring import Episode, social
from cprl.measuring.reported import FIELDS, left_out

FILE_NAME: Final = "episodes.parquet"

COLUMNS: Final = {
    "replica": pa.int32(),
    "episode": pa.int32(),
    "agent": pa.int32(),
    "return": pa.float32(),
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
no column."""

LEFT_OUT: Final = b"left_out"
"""The key of the schema's metadata whose value says which columns are left out, and why, if any are."""

_ROWS_PER_GROUP: Final = 2**16


class EpisodeTable:
    """Writes a table of episodes; a context manager.

    Episodes are safe once `add` has returned, even if the process is killed by SIGKILL; a power failure may
    lose the last seconds. After an OSError (a full disk) all earlier episodes are intact, and the same `add`
    or `close` can be repeated.

    Args:
        path: the parquet file to write, `episodes.parquet` in a run's directory.
        resumable: whether to continue an existing journal, see `load_state_dict`, and to leave the journal in
            place if the block ends with an error.

    Raises:
        FileExistsError: if the table exists; nothing is ever overwritten.
    """

    def __init__(self, path: str | os.PathLike[str], *, resumable: bool = False) -> None:
        self.path = Path(path)
        self.journal = _journal_of(self.path)
        self._resumable = resumable
        for table in (self.path,) if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is not overwritten; use another directory")
        exists = self.journal.exists()
        # Unbuffered, so that written data survives the process.
        self._file = FileIO(self.journal, "r+" if exists else "x")
        self._schema: pa.Schema | None = None
        self._rows = 0
        self._is_placed = not exists

    def state_dict(self) -> dict[str, int]:
        """The number of rows."""
        return {"rows": self._rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continues after the given number of rows of its journal; later rows are dropped.

        Raises:
            ValueError: if the journal has fewer rows, or no batch of rows ends there.
        """
        rows, found, end = int(state["rows"]), 0, 0
        schema = None
        if rows:
            with pa.OSFile(str(self.journal)) as source:
                schema, batches = _read_journal(source)
                for batch in batches:
                    found += batch.num_rows
                    end = source.tell()
                    if found >= rows:
                        break
        if found != rows:
            raise ValueError(f"{self.journal} holds {found} rows up to there; the checkpoint has {rows}")
        self._file.truncate(end)
        self._file.seek(end)
        self._schema, self._rows, self._is_placed = schema, rows, True

    def add(self, *episodes: Episode, replica: int | None = None) -> None:
        """Appends episodes; the first one of a table determines the columns and metrics of all.

        Args:
            episodes: the episodes.
            replica: the index of their replica; by default each episode's world.
        """
        if not episodes:
            return
        if not self._is_placed:  # there is no checkpoint of the last attempt: start over
            self.load_state_dict({"rows": 0})
        if self._schema is None:
            self._begin(_schema_of(episodes[0]))
        rows = _rows(episodes, replica, self._schema)
        self._write(rows.serialize())
        self._rows += rows.num_rows

    def on_step(self, batch: TensorDictBase) -> None:
        """Does nothing: a table stores whole episodes. With `on_episode` a callback of `cprl.training`."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Adds an episode."""
        self.add(episode)

    def close(self) -> None:
        """Converts the journal to the parquet file. A second call does nothing."""
        if not self.journal.exists():
            return
        if self._schema is None:
            self._begin(_schema(COLUMNS, social.METRICS))
        if not self._file.closed:
            self._file.close()
        partial = self.path.with_name(self.path.name + ".partial")
        try:
            _merge(self.journal, partial, rows=self._rows)
            os.replace(partial, self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise OSError(
                error.errno, f"{error}: could not write {self.path}; all episodes are in {self.journal}"
            ) from error
        self.journal.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._resumable and error is not None:
            self._file.close()
        else:
            self.close()

    def _begin(self, schema: pa.Schema) -> None:
        self._write(schema.serialize())
        self._schema = schema

    def _write(self, message: pa.Buffer) -> None:
        """Appends all of a message or nothing: a partial message would make later ones unreadable."""
        end = self._file.tell()
        left = memoryview(message)
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException as error:
            self._file.seek(end)
            self._file.truncate()
            if isinstance(error, OSError):
                kept = f"the {self._rows} earlier rows are in {self.journal}"
                raise OSError(error.errno, f"{error}: could not add episodes; {kept}") from error
            raise


def read_episodes(run_directory: str | os.PathLike[str]) -> pa.Table:
    """The episodes of a finished, running or killed run, in the order in which they ended.

    Raises:
        FileNotFoundError: if there are none.
    """
    path = Path(run_directory) / FILE_NAME
    try:
        # The journal first: while it exists it holds every row, and a merge does not change it.
        with pa.OSFile(str(_journal_of(path))) as journal:
            schema, batches = _read_journal(journal)
            return pa.Table.from_batches(list(batches), schema)
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} and its journal do not exist: is this a run?") from None
    return pq.read_table(path)


def as_table(episodes: Sequence[Episode], replica: int) -> pa.Table:
    """At least one episode of a replica as a table with the columns of a run's table."""
    return pa.Table.from_batches([_rows(episodes, replica, _schema_of(episodes[0]))])


def _journal_of(path: Path) -> Path:
    return path.with_suffix(".arrows")


def _schema(columns: Iterable[str], metrics: Iterable[str]) -> pa.Schema:
    return pa.schema({name: COLUMNS[name] for name in columns} | dict.fromkeys(metrics, pa.float64()))


def _schema_of(episode: Episode) -> pa.Schema:
    """The columns that an episode has; the schema's metadata names those that it lacks."""
    schema, missing = _schema(_columns_of(episode), episode.metrics), left_out(episode.reported)
    return schema.with_metadata({LEFT_OUT: missing}) if missing else schema


def _columns_of(episode: Episode) -> list[str]:
    return [name for name in COLUMNS if name not in FIELDS or getattr(episode, name) is not None]


def _rows(episodes: Sequence[Episode], replica: int | None, schema: pa.Schema) -> pa.RecordBatch:
    of_each = [_cells(episode, episode.world if replica is None else replica) for episode in episodes]
    for cells in of_each:
        if cells.keys() != set(schema.names):
            more, lacks = cells.keys() - set(schema.names), set(schema.names) - cells.keys()
            raise ValueError(
                f"the episode has the extra columns {sorted(more)} and lacks {sorted(lacks)}; allowed: the "
                "columns of the table's first episode"
            )
    return pa.record_batch(
        [
            pa.array(np.concatenate([cells[column.name] for cells in of_each]), column.type)
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
        **episode.metrics,
    }
    return {name: np.broadcast_to(cell, agents.shape) for name, cell in cells.items()}


def _read_journal(journal: pa.NativeFile) -> tuple[pa.Schema, Iterator[pa.RecordBatch]]:
    """The schema and all batches that were written completely."""
    try:
        reader = pa.ipc.open_stream(journal)
    except pa.ArrowInvalid:  # the process was killed before it wrote the schema
        return _schema(COLUMNS, social.METRICS), iter(())
    return reader.schema, _whole_batches(reader)


def _whole_batches(reader: pa.RecordBatchReader) -> Iterator[pa.RecordBatch]:
    while True:
        try:
            yield reader.read_next_batch()
        except StopIteration:
            return
        except (pa.ArrowInvalid, OSError) as error:
            if getattr(error, "errno", None) is not None:
                raise
            return  # the process was killed while it wrote this one


def _merge(journal: Path, target: Path, *, rows: int) -> None:
    """Writes the journal as a parquet file, synced to disk."""
    merged = 0
    with pa.OSFile(str(journal)) as source:
        schema, batches = _read_journal(source)
        with pq.ParquetWriter(target, schema) as writer:
            for table in _large_tables(batches):
                writer.write_table(table)
                merged += table.num_rows
    if merged != rows:
        raise OSError(EIO, f"{journal} holds {merged} rows of the {rows} that were added")
    with open(target, "rb") as written:
        os.fsync(written.fileno())


def _large_tables(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Table]:
    """The batches in groups, because parquet files with row groups of a few rows are slow to read."""
    group, rows = list[pa.RecordBatch](), 0
    for batch in batches:
        group.append(batch)
        rows += batch.num_rows
        if rows >= _ROWS_PER_GROUP:
            yield pa.Table.from_batches(group)
            group, rows = [], 0
    if group:
        yield pa.Table.from_batches(group)
