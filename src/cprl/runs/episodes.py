"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`, see `cprl.runs.journal`.
`EpisodeTable.close` converts the journal to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from errno import EIO, ENOENT
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tensordict import TensorDictBase

from cprl.institutions import COUNTS
from cprl.measuring import Episode, social
from cprl.measuring.metrics import left_out
from cprl.runs.files import (
    RECIPE_FORMAT,
    read_json,
    refuse_newer,
    refuse_special,
    refuse_to_write_over,
    verify,
    write_atomically,
    write_listed,
)
from cprl.runs.journal import Content, Journal, read_journal, write_journal

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
    """

    def __init__(
        self, path: str | os.PathLike[str], *, resumable: bool = False, run: Path | None = None
    ) -> None:
        self.path = Path(path)
        self.journal = _journal_of(self.path)
        self._run = self.path.parent if run is None else Path(run)
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
        """Continues after the given number of rows of its journal; later rows are dropped."""
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

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
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
    """
    path = Path(run_directory) / FILE_NAME
    recipe = path.with_name("recipe.json")  # with the format of the journal, which has none of its own
    if recipe.is_file():
        refuse_newer(recipe, read_json(recipe), RECIPE_FORMAT)
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
    """
    path = Path(path)
    refuse_special(path)
    verify(path)
    try:
        with open(path, "rb") as file:
            return pq.read_table(file)
    except FileNotFoundError:
        raise
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{path} is not a table: {error}") from error


EVALUATIONS: Final = "evaluation/training.parquet"
"""The evaluations while a run was trained: the columns of `episodes.parquet`, after "trained_episodes", the
episodes that the agents had been trained; "episode" counts those of an evaluation."""


def read_evaluations(run: Path) -> pa.Table | None:
    """The table of `EVALUATIONS`; None for a run without `Experiment.evaluate_every`, or before the first."""
    return read_table(run / EVALUATIONS) if (run / EVALUATIONS).exists() else None


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
