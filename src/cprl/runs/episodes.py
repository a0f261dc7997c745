"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`: an Arrow stream, which unlike
a parquet file needs no footer and so stays readable if the process is killed. `EpisodeTable.close` converts
it to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from errno import EIO, ENOENT
from functools import partial
from io import BytesIO, FileIO
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from tensordict import TensorDictBase

from cprl.measuring import Episode
from cprl.measuring.registry import IN_FORCE, METRICS, SOCIAL, TOTALS, left_out
from cprl.measuring.table import metrics_in, world_of
from cprl.runs.files import (
    RECIPE_FILE,
    RECIPE_FORMAT,
    read_json,
    refuse_newer,
    refuse_special,
    refuse_to_write_over,
    sync_folder,
    take_apart,
    verify,
    write_atomically,
    write_listed,
)

FILE_NAME: Final = "episodes.parquet"

_ROWS_PER_GROUP: Final = 2**16
"""Parquet files with row groups of a few rows are slow to read."""


def batches_in(path: Path) -> Iterator[tuple[pa.RecordBatch, int]]:
    """Yield the whole batches of a journal, each with the byte at which it ends."""
    refuse_special(path)
    source = pa.BufferReader(path.read_bytes())
    try:
        for batch in pa.ipc.open_stream(source):
            batch.validate()
            yield batch, source.tell()
    except (pa.ArrowException, OSError):  # half a batch, or half the schema, at the end
        return


def read_journal(path: Path) -> pa.Table:
    """Return the rows of a journal; of one without a whole batch, none of all columns."""
    batches = [batch for batch, _ in batches_in(path)]
    if batches:
        return pa.Table.from_batches(batches)
    return _schema([*COLUMNS, *(name for name in SOCIAL if METRICS[name].is_stored)]).empty_table()


def _message(batch: pa.RecordBatch, *, is_first: bool) -> bytes:
    """Return a batch as it stands in a stream, the first behind the schema."""
    header = batch.schema.serialize().to_pybytes() if is_first else b""
    message: bytes = header + batch.serialize().to_pybytes()
    return message


class EpisodeTable:
    """The table of episodes that is being written; a context manager, and a callback of `cprl.training`.

    Episodes are safe once `add` has returned, even if the process is killed by SIGKILL; after a power failure
    those up to the last `state_dict` are, which syncs them to the disk. After an OSError (a full disk) all
    earlier episodes are intact, and the same `add` or `close` can be repeated.

    Args:
        path: the parquet file to write, `episodes.parquet` in a run's directory, whose manifest lists it.
        resumable: whether to continue an existing journal or table, see `load_state_dict`, and to leave the
            journal in place if the block ends with an error.

    Raises:
        FileExistsError: if the table exists and is not to be resumed; nothing is ever overwritten.
    """

    def __init__(self, path: str | os.PathLike[str], *, resumable: bool = False) -> None:
        self.path = Path(path)
        self.journal = self.path.with_suffix(".arrows")
        self._resumable = resumable
        self._is_closed = False
        self._file: FileIO | None = None
        self._rows = 0
        self._schema = None
        for table in () if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is not overwritten; use another directory")
        if self.path.exists() and not self.journal.exists():
            _reopen(self.path, self.journal)
        elif not self.journal.exists():
            self._open()

    def _open(self, rows: int = 0) -> FileIO:
        """Open the journal behind so many of its rows; what follows them is dropped."""
        count = 0
        bytes_kept = 0
        schema = None
        for batch, end in batches_in(self.journal) if rows else ():
            count += batch.num_rows
            bytes_kept = end
            schema = batch.schema
            if count >= rows:
                break
        if count != rows:
            raise ValueError(f"{self.journal} holds {count} rows up to there; the checkpoint has {rows}")
        is_new = not self.journal.exists()
        if self._file is not None:
            self._file.close()
        take_apart(self.journal)
        self._file = FileIO(self.journal, "x" if is_new else "r+")  # unbuffered: it survives the process
        self._file.truncate(bytes_kept)
        self._file.seek(bytes_kept)
        self._rows = count
        self._schema = schema
        if is_new:
            sync_folder(self.journal.parent)
        return self._file

    def state_dict(self) -> dict[str, int]:
        """Return the number of rows, which are on the disk once it returns."""
        if self._file is not None:
            os.fsync(self._file.fileno())
        return {"rows": self._rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continue after the given number of rows of its journal; later rows are dropped."""
        self._open(int(state["rows"]))

    def add(self, *episodes: Episode) -> None:
        """Append episodes; the first one of a table determines the columns and metrics of all."""
        if not episodes:
            return
        file = self._file or self._open()  # without a checkpoint of the last attempt it starts over
        batch = rows_of(episodes, self._schema or schema_of(episodes[0]))
        end = file.tell()
        left = memoryview(_message(batch, is_first=self._schema is None))
        try:
            while left:
                left = left[file.write(left) :]
        except BaseException as error:
            file.seek(end)  # behind half of a batch later ones would be unreadable
            file.truncate()
            if isinstance(error, OSError):
                what = f"could not add episodes; the {self._rows} earlier rows are in {self.journal}"
                raise OSError(error.errno, f"{error.strerror or error}: {what}") from error
            raise
        self._schema = batch.schema
        self._rows += batch.num_rows

    def on_step(self, batch: TensorDictBase) -> None:
        """Do nothing: a table stores whole episodes."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self.add(episode)

    def close(self) -> None:
        """Convert the journal to the parquet file. A second call does nothing.

        Raises:
            OSError: if that fails; all episodes are in the journal, unless somebody deleted it.
        """
        if self._is_closed:
            return
        (self._file or self._open()).close()
        try:
            write_listed(self.path.parent, self.path.name, self._merge)
        except FileNotFoundError as error:
            raise FileNotFoundError(ENOENT, f"{error.strerror}: was {self.journal} deleted?") from error
        except OSError as error:
            what = f"could not write {self.path}; all episodes are in {self.journal}"
            raise OSError(error.errno, f"{error.strerror or error}: {what}") from error
        self.journal.unlink()
        self._is_closed = True

    def _merge(self, target: BinaryIO) -> None:
        table = read_journal(self.journal)
        if table.num_rows != self._rows:
            raise OSError(
                EIO, f"{self.journal} holds {table.num_rows} rows of the {self._rows} that were added"
            )
        pq.write_table(table, target, row_group_size=_ROWS_PER_GROUP)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if not self._resumable or error is None:
            self.close()
        elif self._file is not None:
            self._file.close()


def read_episodes(run_directory: str | os.PathLike[str]) -> pa.Table:
    """Return the episodes of a finished, running or killed run, in the order in which they ended; of what is
    no run they are a FileNotFoundError."""
    path = Path(run_directory) / FILE_NAME
    recipe = path.with_name(RECIPE_FILE)  # with the format of the journal, which has none of its own
    if recipe.is_file():
        refuse_newer(recipe, read_json(recipe), RECIPE_FORMAT)
    try:
        # The journal first: while it exists it holds every row, and a merge does not change it.
        table = read_journal(path.with_suffix(".arrows"))
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} and its journal do not exist: is this a run?") from None
        return read_rows(path)
    _refuse_other_columns(path.with_suffix(".arrows"), table)
    return table


def stored_episodes(run: Path) -> Iterator[Episode]:
    """Yield the episodes of a run in the order in which they ended, without what its table lacks: who tagged
    whom, and what institutions counted. A run without a table has none."""
    try:
        table = read_episodes(run)
    except FileNotFoundError:
        return
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
    columns["world"] = world_of(table)
    metrics = metrics_in(table.schema)
    in_force = [name for name in metrics if name.startswith(IN_FORCE)]
    agents = int(max(columns["agent"], default=0)) + 1
    for first in range(0, table.num_rows, agents):
        rows = {name: values[first : first + agents] for name, values in columns.items()}
        fields_of: dict[str, Any] = {name: int(rows[name][0]) for name in ("world", "replica", "episode")}
        for field in fields(Episode):
            name = field.name.removesuffix("_")
            if name in rows and name in TOTALS:
                fields_of[field.name] = rows[name] if TOTALS[name].axes == "N" else rows[name][0].item()
        yield Episode(
            **fields_of,
            metrics={name: float(rows[name][0]) for name in metrics},
            in_force=np.array([rows[name][0] for name in in_force]) if in_force else None,
        )


def read_rows(path: str | os.PathLike[str]) -> pa.Table:
    """Read a parquet file that has the columns of a run's table, as its evaluations do; see `read_table`."""
    table = read_table(path)
    _refuse_other_columns(path, table)
    return table


_OF_ANY_SIZE: Final = (pa.types.is_floating, pa.types.is_integer)


def _refuse_other_columns(path: str | os.PathLike[str], table: pa.Table) -> None:
    """Refuse a table whose columns are not those of episodes, e.g. one that another program wrote."""
    is_not = f"{path} is not a table of episodes: "
    names = table.column_names
    for name in (*_NUMBERED, "return", "steps", "terminated"):
        if name not in names:
            raise ValueError(f"{is_not}it has no column {name}")
    for name, kind in _KINDS.items():
        if name not in names:
            continue
        if names.count(name) > 1:
            raise ValueError(f"{is_not}it has the column {name} more than once")
        both = (table[name].type, kind)  # which may differ in size: an export has float32
        if kind != table[name].type and not any(all(map(of, both)) for of in _OF_ANY_SIZE):
            raise ValueError(f"{is_not}its column {name} is {table[name].type}; allowed: {kind}")
        if table[name].null_count and name != "wanted_return":
            raise ValueError(f"{is_not}its column {name} has empty places")
    for name in _NUMBERED:
        if table.num_rows and pc.min(table[name]).as_py() < 0:
            raise ValueError(f"{is_not}its column {name} has numbers below 0")


def read_table(path: str | os.PathLike[str]) -> pa.Table:
    """Read a parquet file of a run, checked for damage; one that is missing is a FileNotFoundError."""
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
    """Read the table of `EVALUATIONS`; None for a run without `evaluate_every`, or before the first."""
    return read_rows(run / EVALUATIONS) if (run / EVALUATIONS).exists() else None


def _reopen(path: Path, journal: Path) -> None:
    """Write the journal of a finished table again, a batch for each episode."""
    table = read_rows(path).combine_chunks()
    batches = table.to_batches(max_chunksize=max(table["agent"].to_pylist(), default=0) + 1)
    messages = [_message(batch, is_first=place == 0) for place, batch in enumerate(batches)]
    write_atomically(journal, lambda file: file.writelines(messages))


_NUMBERED: Final = ("replica", "episode", "agent")
"""The columns that say whose a row is."""

_OF_TOTALS: Final = {name: total for name, total in TOTALS.items() if total.column is not None}
COLUMNS: Final = {
    **dict.fromkeys(("replica", "world", "episode", "agent"), pa.int32()),
    **{name: total.column for name, total in _OF_TOTALS.items() if not total.is_of_institutions},
}
"""The columns of a table, as in `Episode`; those of `OF_INSTITUTIONS` and the metrics follow, float64, NaN
where undefined.

Values of the whole episode are repeated in the row of each agent. Values that the game does not report have
no column; nor have, outside of a training, the world, which counts through those of all replicas, and the
wanted return. It is null for agents that do not learn."""
OF_INSTITUTIONS: Final = {name: one.column for name, one in _OF_TOTALS.items() if one.is_of_institutions}
"""The columns of a game with institutions; those of counts only where
`cprl.measuring.registry.counts_for` has them."""


_KINDS: Final = {**COLUMNS, **OF_INSTITUTIONS}

LEFT_OUT: Final = b"left_out"
"""The key of the schema's metadata whose value says which columns are left out, and why, if any are."""


def _schema(names: Iterable[str]) -> pa.Schema:
    return pa.schema({name: _KINDS.get(name, pa.float64()) for name in names})


def schema_of(episode: Episode) -> pa.Schema:
    """Return the columns that an episode has; the schema's metadata names those that it lacks."""
    schema = _schema(_columns(episode))
    missing = left_out(episode.reported)
    return schema.with_metadata({LEFT_OUT: missing}) if missing else schema


def rows_of(episodes: Sequence[Episode], schema: pa.Schema) -> pa.RecordBatch:
    """Return a row for each episode and agent, with the schema of the table's first episode."""
    parts = list(map(_columns, episodes))
    for columns in parts:
        if columns.keys() != set(schema.names):
            more = columns.keys() - set(schema.names)
            lacks = set(schema.names) - columns.keys()
            raise ValueError(
                f"the episode has the extra columns {sorted(more)} and lacks {sorted(lacks)}; allowed: the "
                "columns of the table's first episode"
            )
    arrays = [
        pa.array(
            np.concatenate([columns[field.name] for columns in parts]),
            field.type,
            from_pandas=field.name == "wanted_return",  # NaN, of agents that do not learn, is null
        )
        for field in schema
    ]
    return pa.record_batch(arrays, schema=schema)


def _columns(episode: Episode) -> dict[str, Any]:
    """Return the columns of an episode in order, [N] each."""
    agents = np.arange(len(episode.return_))
    entries = {**(episode.counts or {}), **vars(episode), "agent": agents, "return": episode.return_}
    if episode.wanted_return is None:  # no training, of whose worlds it is one
        del entries["world"]
    columns = {name: entries[name] for name in _KINDS if entries.get(name) is not None}
    columns = {**columns, **episode.metrics, **columns}
    return {name: np.broadcast_to(values, agents.shape) for name, values in columns.items()}


def table_of(episodes: Sequence[Episode], replicas: Sequence[int] = (0,)) -> pa.Table:
    """Return episodes outside of a training as a table, as many of each replica in turn, numbered from 0."""
    each = len(episodes) // len(replicas)
    numbered = [
        replace(episode, replica=replicas[place // each], episode=place % each)
        for place, episode in enumerate(episodes)
    ]
    return pa.Table.from_batches([rows_of(numbered, schema_of(episodes[0]))])


def write_table(path: Path, table: pa.Table, *, over: bool = False) -> None:
    """Write a parquet file atomically, in little room; one that exists is refused by a FileExistsError, or
    replaced."""
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
