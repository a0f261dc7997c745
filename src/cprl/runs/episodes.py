"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`: an Arrow stream, which unlike
a parquet file needs no footer and so stays readable if the process is killed. `EpisodeTable.close` converts
it to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from errno import EIO, ENOENT
from functools import partial
from io import BytesIO, FileIO
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
    sync_folder,
    verify,
    write_atomically,
    write_listed,
)

FILE_NAME: Final = "episodes.parquet"

_ROWS_PER_GROUP: Final = 2**16
"""Parquet files with row groups of a few rows are slow to read."""


class Journal:
    """Appends batches to a journal.

    Args:
        path: the file; it is created where it does not exist.
        rows: how many of its rows are kept; what follows them is dropped.
    """

    def __init__(self, path: Path, *, rows: int = 0) -> None:
        self.rows, bytes_kept = 0, 0
        self.schema: pa.Schema | None = None
        """Of all batches; None before the first."""
        for batch, end in batches_in(path) if rows else ():
            self.schema, self.rows, bytes_kept = batch.schema, self.rows + batch.num_rows, end
            if self.rows >= rows:
                break
        if self.rows != rows:
            raise ValueError(f"{path} holds {self.rows} rows up to there; the checkpoint has {rows}")
        exists = path.exists()
        self._file = FileIO(path, "r+" if exists else "x")  # unbuffered: what is written survives the process
        self._file.truncate(bytes_kept)
        self._file.seek(bytes_kept)
        if not exists:
            sync_folder(path.parent)

    def append(self, batch: pa.RecordBatch) -> None:
        """Append all of a batch or nothing: behind half of one later ones would be unreadable."""
        end = self._file.tell()
        left = memoryview(_message(batch, is_first=self.schema is None))
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException:
            self._file.seek(end)
            self._file.truncate()
            raise
        self.schema, self.rows = batch.schema, self.rows + batch.num_rows

    def sync(self) -> None:
        """Wait until all that was appended is on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._file.close()


def batches_in(path: Path) -> Iterator[tuple[pa.RecordBatch, int]]:
    """The whole batches of a journal, each with the byte at which it ends.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    refuse_special(path)
    source = pa.BufferReader(path.read_bytes())
    try:
        for batch in pa.ipc.open_stream(source):
            batch.validate()
            yield batch, source.tell()
    except (pa.ArrowException, OSError):  # half a batch, or half the schema, at the end
        return


def read_journal(path: Path) -> pa.Table:
    """The rows of a journal; of one without a whole batch, none of all columns."""
    batches = [batch for batch, _ in batches_in(path)]
    return pa.Table.from_batches(batches) if batches else whole_schema().empty_table()


def _message(batch: pa.RecordBatch, *, is_first: bool) -> bytes:
    """A batch as it stands in a stream, the first behind the schema."""
    header = batch.schema.serialize().to_pybytes() if is_first else b""
    message: bytes = header + batch.serialize().to_pybytes()
    return message


class EpisodeTable:
    """Writes a table of episodes; a context manager, and a callback of `cprl.training`.

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
        self.journal = self.path.with_suffix(".arrows")
        self._run = self.path.parent if run is None else Path(run)
        self._resumable, self._is_closed = resumable, False
        for table in () if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is not overwritten; use another directory")
        if self.path.exists() and not self.journal.exists():
            _reopen(self.path, self.journal)
        self._file = None if self.journal.exists() else Journal(self.journal)

    def state_dict(self) -> dict[str, int]:
        """The number of rows, which are on the disk once it returns."""
        if self._file is None:
            return {"rows": 0}
        self._file.sync()
        return {"rows": self._file.rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continue after the given number of rows of its journal; later rows are dropped."""
        file = Journal(self.journal, rows=int(state["rows"]))
        if self._file is not None:
            self._file.close()
        self._file = file

    def _placed(self) -> Journal:
        """The journal; without a checkpoint of the last attempt it starts over."""
        if self._file is None:
            self._file = Journal(self.journal)
        return self._file

    def add(self, *episodes: Episode, replica: int | None = None) -> None:
        """Append episodes; the first one of a table determines the columns and metrics of all.

        Args:
            replica: the index of their replica; by default each episode's world.
        """
        if not episodes:
            return
        file = self._placed()
        try:
            file.append(rows_of(episodes, replica, file.schema or schema_of(episodes[0])))
        except OSError as error:
            raise OSError(
                error.errno,
                f"{error.strerror or error}: could not add episodes; the {file.rows} earlier rows are in "
                f"{self.journal}",
            ) from error

    def on_step(self, batch: TensorDictBase) -> None:
        """Do nothing: a table stores whole episodes."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Add an episode."""
        self.add(episode)

    def close(self) -> None:
        """Convert the journal to the parquet file. A second call does nothing.

        Raises:
            OSError: if that fails; all episodes are in the journal, unless somebody deleted it.
        """
        if self._is_closed:
            return
        file = self._placed()
        file.close()
        try:
            name = self.path.relative_to(self._run).as_posix()
            write_listed(self._run, name, partial(_merge, self.journal, rows=file.rows))
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
        if not self._resumable or error is None:
            self.close()
        elif self._file is not None:
            self._file.close()


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
        return read_journal(path.with_suffix(".arrows"))
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} and its journal do not exist: is this a run?") from None
    return read_table(path)


def read_table(path: str | os.PathLike[str]) -> pa.Table:
    """A parquet file of a run, checked for damage.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    path = Path(path)
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


def _reopen(path: Path, journal: Path) -> None:
    """Write the journal of a finished table again, a batch for each episode."""
    table = read_table(path).combine_chunks()
    batches = table.to_batches(max_chunksize=max(table["agent"].to_pylist(), default=0) + 1)
    messages = [_message(batch, is_first=place == 0) for place, batch in enumerate(batches)]
    write_atomically(journal, lambda file: file.writelines(messages))


def _merge(journal: Path, target: BinaryIO, *, rows: int) -> None:
    table = read_journal(journal)
    if table.num_rows != rows:
        raise OSError(EIO, f"{journal} holds {table.num_rows} rows of the {rows} that were added")
    pq.write_table(table, target, row_group_size=_ROWS_PER_GROUP)


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
    return _schema([*COLUMNS, *social.METRICS, "yield_share"])


def _schema(names: Iterable[str]) -> pa.Schema:
    kinds = {**COLUMNS, **OF_INSTITUTIONS}
    return pa.schema({name: kinds.get(name, pa.float64()) for name in names})


def schema_of(episode: Episode) -> pa.Schema:
    """The columns that an episode has; the schema's metadata names those that it lacks."""
    schema = _schema([*_columns_of(episode), *_of_institutions(episode), *episode.metrics])
    missing = left_out(episode.reported)
    return schema.with_metadata({LEFT_OUT: missing}) if missing else schema


def _columns_of(episode: Episode) -> list[str]:
    return [name for name in COLUMNS if getattr(episode, name, "") is not None]


def _of_institutions(episode: Episode) -> dict[str, Any]:
    """The values of the columns of institutions, [N] or a number; none for a game without them."""
    values: dict[str, Any] = {**(episode.counts or {})}
    for name in ("fines", "transfers", "violations", "decision"):
        if getattr(episode, name) is not None:
            values[name] = getattr(episode, name)
    in_force: list[float] = [] if episode.in_force is None else episode.in_force.tolist()
    return {
        **{name: values[name] for name in OF_INSTITUTIONS if name in values},
        **{f"in_force_{place}": value for place, value in enumerate(in_force)},
    }


def rows_of(episodes: Sequence[Episode], replica: int | None, schema: pa.Schema) -> pa.RecordBatch:
    """A row for each episode and agent.

    Args:
        episodes: at least one.
        replica: the index of their replica; None for each episode's world.
        schema: what `schema_of` gave for the first episode of the table.
    """
    values = [_values(episode, episode.world if replica is None else replica) for episode in episodes]
    for columns in values:
        if columns.keys() != set(schema.names):
            more, lacks = columns.keys() - set(schema.names), set(schema.names) - columns.keys()
            raise ValueError(
                f"the episode has the extra columns {sorted(more)} and lacks {sorted(lacks)}; allowed: the "
                "columns of the table's first episode"
            )
    return pa.record_batch(
        [
            pa.array(
                np.concatenate([columns[field.name] for columns in values]),
                field.type,
                from_pandas=field.name == "wanted_return",  # NaN, of agents that do not learn, is null
            )
            for field in schema
        ],
        schema=schema,
    )


def _values(episode: Episode, replica: int) -> dict[str, Any]:
    agents = np.arange(len(episode.return_))
    values: dict[str, Any] = {
        **{name: getattr(episode, name, None) for name in _columns_of(episode)},
        "replica": replica,
        "agent": agents,
        "return": episode.return_,
        **_of_institutions(episode),
        **episode.metrics,
    }
    return {name: np.broadcast_to(value, agents.shape) for name, value in values.items()}


Label = Mapping[str, str | int]
"""The values of the first columns, by name."""


def labelled(parts: Iterable[tuple[Label, int, Sequence[Episode]]]) -> pa.Table:
    """A table like `episodes.parquet`, with label columns first.

    Args:
        parts: labels, all with the same names; the index of a replica; and its episodes, numbered from 0.
    """
    tables = []
    for label, replica, episodes in parts:
        table = as_table(
            [replace(episode, episode=number) for number, episode in enumerate(episodes)], replica
        )
        for place, (name, value) in enumerate(label.items()):
            kind = pa.string() if isinstance(value, str) else pa.int32()
            table = table.add_column(place, pa.field(name, kind), pa.array([value] * len(table), kind))
        tables.append(table)
    return pa.concat_tables(tables)


def write_table(path: Path, table: pa.Table, *, over: bool = False) -> None:
    """Write a parquet file atomically, in little room.

    Raises:
        FileExistsError: if the file exists and is not to be replaced.
    """
    if not over:
        refuse_to_write_over(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: write_small(table, file))


def write_small(table: pa.Table, file: BinaryIO) -> None:
    """Write a table as parquet in little room: each column by dictionary, split into bytes, or as it is,
    whichever is smallest."""
    encodings: dict[str, list[str]] = {"use_dictionary": [], "use_byte_stream_split": []}
    for field in table.schema:
        choices: list[dict[str, bool]] = [{"use_dictionary": True}, {"use_dictionary": False}]
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            choices.append({"use_dictionary": False, "use_byte_stream_split": True})
        best = min(choices, key=partial(_size, table.select([field.name])))
        for encoding, columns in encodings.items():
            if best.get(encoding):
                columns.append(field.name)
    pq.write_table(table, file, compression="zstd", compression_level=19, **encodings)


def _size(column: pa.Table, encoding: Mapping[str, bool]) -> int:
    file = BytesIO()
    pq.write_table(column, file, compression="zstd", compression_level=3, **encoding)  # which is quick
    return file.tell()
