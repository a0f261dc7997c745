"""The table of a run: one row for each replica, episode and agent, kept from the moment an episode ends.

While a run goes on, every episode is appended at once to a journal, `episodes.arrows`, an Arrow stream:
whatever kills the process, all that was added stays readable, since a stream, unlike a parquet file, needs
no footer. `EpisodeTable.close` turns the journal into `episodes.parquet`; `read_episodes` reads either.
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
"""The columns of every table, as in `Episode`; behind them come the metrics, float64, NaN where undefined.
What concerns the whole episode stands in the row of each of its agents."""

_ROWS_PER_GROUP: Final = 2**16


class EpisodeTable:
    """Writes a table of episodes; a context manager.

    What `add` has returned from survives the death of the process, SIGKILL included; when the machine
    itself loses power, the last seconds may be lost. After an OSError (a full disk) all earlier episodes
    are still there, and the same `add` or `close` can be tried again.

    Args:
        path: the parquet file to be, `episodes.parquet` in a run's directory.
        resumable: whether a journal that is there is gone on with, see `load_state_dict`, and stays as it
            is where the block ends with an error.

    Raises:
        FileExistsError: where there is a table already: nothing is ever written over.
    """

    def __init__(self, path: str | os.PathLike[str], *, resumable: bool = False) -> None:
        self.path = Path(path)
        self.journal = _journal_of(self.path)
        self._resumable = resumable
        for table in (self.path,) if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is kept; give the table a directory of its own")
        exists = self.journal.exists()
        # Not buffered: what is written has left this process.
        self._file = FileIO(self.journal, "r+" if exists else "x")
        self._schema: pa.Schema | None = None
        self._rows = 0
        self._is_placed = not exists

    def state_dict(self) -> dict[str, int]:
        """How many rows it has."""
        return {"rows": self._rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Goes on behind so many rows of its journal; what stands behind them is forgotten.

        Raises:
            ValueError: where the journal has fewer rows, or a batch of rows ends elsewhere.
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
            raise ValueError(f"{self.journal} holds {found} rows up to there; the checkpoint says {rows}")
        self._file.truncate(end)
        self._file.seek(end)
        self._schema, self._rows, self._is_placed = schema, rows, True

    def add(self, *episodes: Episode, replica: int | None = None) -> None:
        """Appends episodes, whose metrics must have the same names in all of a table.

        Args:
            replica: the repetition of the training that they belong to; by default each episode's world.
        """
        if not episodes:
            return
        if not self._is_placed:  # nothing says how far the last run was kept: it begins anew
            self.load_state_dict({"rows": 0})
        if self._schema is None:
            self._begin(episodes[0].metrics)
        rows = _rows(episodes, replica, self._schema)
        self._write(rows.serialize())
        self._rows += rows.num_rows

    def on_step(self, batch: TensorDictBase) -> None:
        """Nothing: a table keeps whole episodes. An observer of `cprl.training`, as `on_episode` is."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Adds an episode."""
        self.add(episode)

    def close(self) -> None:
        """Turns the journal into the parquet file. A second call does nothing."""
        if not self.journal.exists():
            return
        if self._schema is None:
            self._begin(social.METRICS)
        if not self._file.closed:
            self._file.close()
        partial = self.path.with_name(self.path.name + ".partial")
        try:
            _merge(self.journal, partial, rows=self._rows)
            os.replace(partial, self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise OSError(
                error.errno, f"{error}: could not write {self.path}; every episode stays in {self.journal}"
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

    def _begin(self, metrics: Iterable[str]) -> None:
        schema = _schema(metrics)
        self._write(schema.serialize())
        self._schema = schema

    def _write(self, message: pa.Buffer) -> None:
        """Appends all of a message or nothing: behind a torn one, the rest could not be read."""
        end = self._file.tell()
        left = memoryview(message)
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException as error:
            self._file.seek(end)
            self._file.truncate()
            if isinstance(error, OSError):
                kept = f"the {self._rows} rows before stay in {self.journal}"
                raise OSError(error.errno, f"{error}: could not add episodes; {kept}") from error
            raise


def read_episodes(run_directory: str | os.PathLike[str]) -> pa.Table:
    """The episodes of a run, finished, going on or killed, in the order in which they ended.

    Raises:
        FileNotFoundError: where there are none.
    """
    path = Path(run_directory) / FILE_NAME
    try:
        # First the journal: as long as it is there it holds every row, and a merge does not disturb it.
        with pa.OSFile(str(_journal_of(path))) as journal:
            schema, batches = _read_journal(journal)
            return pa.Table.from_batches(list(batches), schema)
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} is not there, nor is its journal: is this a run?") from None
    return pq.read_table(path)


def as_table(episodes: Sequence[Episode], replica: int) -> pa.Table:
    """Episodes of a replica, at least one, as such a table has them."""
    return pa.Table.from_batches([_rows(episodes, replica, _schema(episodes[0].metrics))])


def _journal_of(path: Path) -> Path:
    return path.with_suffix(".arrows")


def _schema(metrics: Iterable[str]) -> pa.Schema:
    return pa.schema([*COLUMNS.items(), *((name, pa.float64()) for name in metrics)])


def _rows(episodes: Sequence[Episode], replica: int | None, schema: pa.Schema) -> pa.RecordBatch:
    of_each = [_cells(episode, episode.world if replica is None else replica) for episode in episodes]
    for cells in of_each:
        if cells.keys() != set(schema.names):
            came, wanted = list(cells)[len(COLUMNS) :], schema.names[len(COLUMNS) :]
            raise ValueError(f"the episode has the metrics {came}; this table has {wanted}")
    return pa.record_batch(
        [
            pa.array(np.concatenate([cells[column.name] for cells in of_each]), column.type)
            for column in schema
        ],
        schema=schema,
    )


def _cells(episode: Episode, replica: int) -> dict[str, Any]:
    """What stands in each column, [N]."""
    own = {name: getattr(episode, name, None) for name in COLUMNS}
    agents = np.arange(len(episode.harvest))
    cells: dict[str, Any] = {
        **own,
        "replica": replica,
        "agent": agents,
        "return": episode.return_,
        **episode.metrics,
    }
    return {name: np.broadcast_to(cell, agents.shape) for name, cell in cells.items()}


def _read_journal(journal: pa.NativeFile) -> tuple[pa.Schema, Iterator[pa.RecordBatch]]:
    """Everything that was written whole."""
    try:
        reader = pa.ipc.open_stream(journal)
    except pa.ArrowInvalid:  # killed before even the names of the columns were written
        return _schema(social.METRICS), iter(())
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
    """Writes the journal as a parquet file that lies safe on the disk."""
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
    """The batches in groups, since parquet is slow to read in groups of a few rows."""
    group, rows = list[pa.RecordBatch](), 0
    for batch in batches:
        group.append(batch)
        rows += batch.num_rows
        if rows >= _ROWS_PER_GROUP:
            yield pa.Table.from_batches(group)
            group, rows = [], 0
    if group:
        yield pa.Table.from_batches(group)
