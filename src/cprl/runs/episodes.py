"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`, see `cprl.runs.journal`.
`EpisodeTable.close` converts the journal to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from errno import EIO, ENOENT
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tensordict import TensorDictBase

from cprl.arguments import path as path_of
from cprl.measuring import Episode
from cprl.runs import formats
from cprl.runs.columns import rows_of, schema_of, whole_schema
from cprl.runs.files import read_json, refuse_special
from cprl.runs.journal import Content, Journal, read_journal, write_journal
from cprl.runs.manifest import verify, write_listed

FILE_NAME: Final = "episodes.parquet"

_ROWS_PER_GROUP: Final = 2**16
_EMPTY: Final = Content(None, [], [])


class EpisodeTable:
    """Writes a table of episodes; a context manager.

    Episodes are safe once `add` has returned, even if the process is killed by SIGKILL; after a power failure
    those up to the last `state_dict` are, which syncs them to the disk. After an OSError (a full disk) all
    earlier episodes are intact, and the same `add` or `close` can be repeated.

    Args:
        path: the parquet file to write, `episodes.parquet` in a run's directory.
        resumable: whether to continue an existing journal or table, see `load_state_dict`, and to leave the
            journal in place if the block ends with an error.
        run: the run whose manifest lists the table; by default the directory of the table.

    Raises:
        FileExistsError: if the table exists and is not to be resumed; nothing is ever overwritten.
        ValueError: if the table to be resumed is damaged.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, resumable: bool = False, run: Path | None = None
    ) -> None:
        self.path = path_of("path", path)
        self.journal = _journal_of(self.path)
        self._run = self.path.parent if run is None else path_of("run", run)
        self._resumable = resumable
        for table in () if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is not overwritten; use another directory")
        if self.path.exists() and not self.journal.exists():
            _reopen(self.path, self.journal)
        self._is_placed = not self.journal.exists()
        self._file = Journal(self.journal)
        self._schema: pa.Schema | None = None
        self._rows, self._is_closed = 0, False

    def state_dict(self) -> dict[str, int]:
        """The number of rows, which are on the disk once it returns."""
        self._file.sync()
        return {"rows": self._rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continues after the given number of rows of its journal; later rows are dropped.

        Raises:
            ValueError: if the journal is damaged, has fewer rows, or no episode ends there.
        """
        rows, found, batches = int(state["rows"]), 0, 0
        content = read_journal(self.journal) if rows else _EMPTY
        for batch in content.batches:
            if found >= rows:
                break
            found, batches = found + batch.num_rows, batches + 1
        if found != rows:
            raise ValueError(f"{self.journal} holds {found} rows up to there; the checkpoint has {rows}")
        self._file.cut(content, batches)
        self._schema, self._rows, self._is_placed = content.schema, rows, True

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
        try:
            if self._schema is None:
                self._begin(schema_of(episodes[0]))
            assert self._schema is not None
            rows = rows_of(episodes, replica, self._schema)
            self._file.append(rows)
        except OSError as error:
            kept = f"the {self._rows} earlier rows are in {self.journal}"
            raise OSError(
                error.errno, f"{error.strerror or error}: could not add episodes; {kept}"
            ) from error
        self._rows += rows.num_rows

    def on_step(self, batch: TensorDictBase) -> None:
        """Does nothing: a table stores whole episodes. With `on_episode` a callback of `cprl.training`."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Adds an episode."""
        self.add(episode)

    def close(self) -> None:
        """Converts the journal to the parquet file. A second call does nothing.

        Raises:
            OSError: if that fails; all episodes are in the journal, unless somebody deleted it.
        """
        if self._is_closed:
            return
        if self._schema is None:
            self._begin(whole_schema())
        self._file.close()
        try:
            name = self.path.relative_to(self._run).as_posix()
            write_listed(self._run, name, lambda file: _merge(self.journal, file, rows=self._rows))
        except FileNotFoundError as error:
            raise FileNotFoundError(ENOENT, f"{error.strerror}: was {self.journal} deleted?") from error
        except OSError as error:
            raise OSError(
                error.errno,
                f"{error.strerror or error}: could not write {self.path}; all episodes are in {self.journal}",
            ) from error
        self.journal.unlink()
        self._is_closed = True

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
        self._file.begin(schema)
        self._schema = schema


def read_episodes(run_directory: str | os.PathLike[str]) -> pa.Table:
    """The episodes of a finished, running or killed run, in the order in which they ended.

    Raises:
        FileNotFoundError: if there are none.
        ValueError: if the file is damaged, see `cprl.runs.manifest`, or a newer cprl wrote it.
    """
    path = path_of("run_directory", run_directory) / FILE_NAME
    recipe = path.with_name("recipe.json")  # with the format of the journal, which has none of its own
    if recipe.is_file():
        formats.refuse_newer(recipe, read_json(recipe), formats.RECIPE)
    try:
        # The journal first: while it exists it holds every row, and a merge does not change it.
        return _as_table(read_journal(_journal_of(path)))
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} and its journal do not exist: is this a run?") from None
    return read_table(path)


def read_table(path: str | os.PathLike[str]) -> pa.Table:
    """A parquet file of a run, checked against its manifest.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or no parquet file; names it.
    """
    path = path_of("path", path)
    refuse_special(path)
    verify(path)
    try:
        with open(path, "rb") as file:
            return pq.read_table(file)
    except FileNotFoundError:
        raise
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{path} is not a table: {error}") from error


def as_table(episodes: Sequence[Episode], replica: int) -> pa.Table:
    """At least one episode of a replica as a table with the columns of a run's table."""
    return pa.Table.from_batches([rows_of(episodes, replica, schema_of(episodes[0]))])


def _journal_of(path: Path) -> Path:
    return path.with_suffix(".arrows")


def _as_table(content: Content) -> pa.Table:
    schema = whole_schema() if content.schema is None else content.schema
    return pa.Table.from_batches(content.batches, schema)


def _reopen(path: Path, journal: Path) -> None:
    """Writes the journal of a finished table again, a batch for each episode."""
    table = read_table(path).combine_chunks()
    firsts = np.flatnonzero(table["agent"].to_numpy() == 0).tolist()
    episodes = (
        table.slice(first, end - first).combine_chunks().to_batches()[0]
        for first, end in pairwise([*firsts, table.num_rows])
    )
    write_journal(journal, episodes, table.schema)


def _merge(journal: Path, target: BinaryIO, *, rows: int) -> None:
    """Writes the journal as a parquet file."""
    content, merged = read_journal(journal), 0
    schema = _as_table(content).schema
    with pq.ParquetWriter(target, schema) as writer:
        for table in _large_tables(content.batches):
            writer.write_table(table)
            merged += table.num_rows
    if merged != rows:
        raise OSError(EIO, f"{journal} holds {merged} rows of the {rows} that were added")


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
