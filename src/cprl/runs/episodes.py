"""The episodes of a run as a table: one row for each replica, episode and agent.

During a run every episode is appended at once to a journal, `episodes.arrows`. `EpisodeTable.close` converts
it to `episodes.parquet`; `read_episodes` reads either.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from errno import EIO, ENOENT
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pyarrow.csv import write_csv

from cprl.measuring import Episode
from cprl.measuring.registry import IN_FORCE_PREFIX, METRICS, SOCIAL_METRICS, TOTALS, left_out_note
from cprl.measuring.table import stored_metrics, world_of
from cprl.runs.files import (
    RECIPE_FILE,
    RECIPE_FORMAT,
    read_json,
    refuse_newer,
    refuse_to_write_over,
    verify,
    write_atomically,
    write_listed,
)
from cprl.runs.journal import Journal, read_journal

FILE_NAME: Final = "episodes.parquet"

_ROWS_PER_GROUP: Final = 2**16
"""Rows of a group of a parquet file; files with small groups are slow to read."""


class EpisodeTable:
    """The table of episodes that is being written; a context manager, and a callback of `cprl.training`.

    Episodes survive a kill by SIGKILL once `add` has returned, and a power failure once `state_dict` has
    returned, which syncs them to the disk. After an OSError (a full disk) all earlier episodes are intact,
    and the same `add` or `close` can be repeated.

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
        self._open_journal: Journal | None = None
        for table in () if resumable else (self.path, self.journal):
            if table.exists():
                raise FileExistsError(f"{table} exists and is not overwritten; use another directory")
        if self.path.exists() and not self.journal.exists():
            _restore_journal(self.path, self.journal)
        elif not self.journal.exists():
            self._open()

    def _open(self, rows: int = 0) -> Journal:
        """Open the journal after its first `rows` rows, and drop the others."""
        if self._open_journal is not None:
            self._open_journal.close()
        self._open_journal = Journal(self.journal, rows=rows)
        return self._open_journal

    def state_dict(self) -> dict[str, int]:
        """Sync the rows to the disk and return their number."""
        if self._open_journal is None:
            return {"rows": 0}
        self._open_journal.sync()
        return {"rows": self._open_journal.rows}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continue after the given number of rows, and drop later ones."""
        self._open(int(state["rows"]))

    def add(self, *episodes: Episode) -> None:
        """Append episodes; the first one of a table determines the columns and metrics of all.

        Raises:
            OSError: if they cannot be written; the earlier ones are intact.
            ValueError: for an episode with other columns.
        """
        if not episodes:
            return
        journal = self._open_journal or self._open()  # start over if there was no checkpoint
        batch = rows_of(episodes, journal.schema or schema_of(episodes[0]))
        try:
            journal.add(batch)
        except OSError as error:
            what = f"could not add episodes; the {journal.rows} earlier rows are in {self.journal}"
            raise OSError(error.errno, f"{error.strerror or error}: {what}") from error

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self.add(episode)

    def close(self) -> None:
        """Convert the journal to the parquet file. A second call does nothing.

        Raises:
            OSError: if that fails; all episodes stay in the journal, unless it was deleted.
        """
        if self._is_closed:
            return
        journal = self._open_journal or self._open()
        journal.close()
        try:
            write_listed(self.path.parent, self.path.name, partial(_write_parquet, journal))
        except FileNotFoundError as error:
            raise FileNotFoundError(ENOENT, f"{error.strerror}: was {self.journal} deleted?") from error
        except OSError as error:
            what = f"could not write {self.path}; all episodes are in {self.journal}"
            raise OSError(error.errno, f"{error.strerror or error}: {what}") from error
        self.journal.unlink()
        self._is_closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if not self._resumable or error is None:
            self.close()
        elif self._open_journal is not None:
            self._open_journal.close()


def _write_parquet(journal: Journal, target: BinaryIO) -> None:
    """Write the rows of a closed journal as a parquet file."""
    table = _read_journal(journal.path)
    if table.num_rows != journal.rows:
        raise OSError(
            EIO, f"{journal.path} holds {table.num_rows} rows of the {journal.rows} that were added"
        )
    pq.write_table(table, target, row_group_size=_ROWS_PER_GROUP)


def _read_journal(path: Path) -> pa.Table:
    """Return the rows of a journal of episodes; an empty table with all columns if it has no whole batch."""
    metrics = (name for name in SOCIAL_METRICS if METRICS[name].is_stored)
    return read_journal(path, _schema([*COLUMNS, *metrics]))


def read_episodes(run_directory: str | os.PathLike[str]) -> pa.Table:
    """Return the episodes of a finished, running or killed run, in the order in which they ended.

    Raises:
        FileNotFoundError: if the directory is no run.
    """
    path = Path(run_directory) / FILE_NAME
    recipe = path.with_name(RECIPE_FILE)  # it holds the format of the journal
    if recipe.is_file():
        refuse_newer(recipe, read_json(recipe), RECIPE_FORMAT)
    try:
        # The journal comes first: while it exists it holds every row, also during a merge.
        table = _read_journal(path.with_suffix(".arrows"))
    except FileNotFoundError:
        if not path.exists():
            raise FileNotFoundError(f"{path} and its journal do not exist: is this a run?") from None
        return read_rows(path)
    _refuse_other_columns(path.with_suffix(".arrows"), table)
    return table


def stored_episodes(run: Path) -> Iterator[Episode]:
    """Yield the episodes of a run in the order in which they ended; nothing for a run without a table. Its
    table lacks who tagged whom, and what institutions counted."""
    try:
        table = read_episodes(run)
    except FileNotFoundError:
        return
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
    columns["world"] = world_of(table)
    metrics = stored_metrics(table.schema)
    in_force = [name for name in metrics if name.startswith(IN_FORCE_PREFIX)]
    agents = int(max(columns["agent"], default=0)) + 1
    for first in range(0, table.num_rows, agents):
        rows = {name: values[first : first + agents] for name, values in columns.items()}
        fields_of: dict[str, Any] = {name: int(rows[name][0]) for name in ("world", "replica", "episode")}
        for field in fields(Episode):
            name = field.name.removesuffix("_")
            if name in rows and name in TOTALS:
                fields_of[field.name] = rows[name] if TOTALS[name].axes == "N" else rows[name][0].item()
        if in_force:
            fields_of["in_force"] = np.array([rows[name][0] for name in in_force])
        yield Episode(**fields_of, metrics={name: float(rows[name][0]) for name in metrics})


def read_rows(path: str | os.PathLike[str]) -> pa.Table:
    """Read a parquet file with the columns of a run's table, e.g. an evaluation; see `read_table`."""
    table = read_table(path)
    _refuse_other_columns(path, table)
    return table


def _refuse_other_columns(path: str | os.PathLike[str], table: pa.Table) -> None:
    """Refuse a table whose columns are not those of episodes, e.g. one that another program wrote."""
    is_not = f"{path} is not a table of episodes: "
    names = table.column_names
    for name in (*_INDEX_COLUMNS, "return", "steps", "terminated"):
        if name not in names:
            raise ValueError(f"{is_not}it has no column {name}")
    for name, kind in _COLUMN_TYPES.items():
        if name not in names:
            continue
        if names.count(name) > 1:
            raise ValueError(f"{is_not}it has the column {name} more than once")
        if not _is_same_family(table[name].type, kind):
            raise ValueError(f"{is_not}its column {name} is {table[name].type}; allowed: {kind}")
        if table[name].null_count and name != "wanted_return":
            raise ValueError(f"{is_not}its column {name} has empty places")
    for name in _INDEX_COLUMNS:
        if table.num_rows and pc.min(table[name]).as_py() < 0:
            raise ValueError(f"{is_not}its column {name} has numbers below 0")


def _is_same_family(kind: pa.DataType, other: pa.DataType) -> bool:
    """Return whether two types are equal up to their size: exports hold float32."""
    families = (pa.types.is_floating, pa.types.is_integer)
    return kind == other or any(family(kind) and family(other) for family in families)


def read_table(path: str | os.PathLike[str]) -> pa.Table:
    """Read a parquet file of a run, checked for damage.

    Raises:
        FileNotFoundError: if there is none.
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
"""The file of evaluations during training. Its columns are "trained_episodes", the episodes of training so
far, then those of `episodes.parquet`, where "episode" counts the episodes of an evaluation."""


def read_evaluations(run: Path) -> pa.Table | None:
    """Read the table of `EVALUATIONS`; None for a run without `evaluate_every`, or before the first."""
    return read_rows(run / EVALUATIONS) if (run / EVALUATIONS).exists() else None


def _restore_journal(path: Path, journal: Path) -> None:
    """Write the journal of a finished table again, one batch for each episode."""
    table = read_rows(path).combine_chunks()
    agents = max(table["agent"].to_pylist(), default=0) + 1

    def write(file: BinaryIO) -> None:
        with pa.ipc.new_stream(file, table.schema) as stream:
            stream.write_table(table, max_chunksize=agents)

    write_atomically(journal, write)


_INDEX_COLUMNS: Final = ("replica", "episode", "agent")
"""The columns that identify a row."""

_STORED_TOTALS: Final = {name: total for name, total in TOTALS.items() if total.column is not None}
COLUMNS: Final = {
    **dict.fromkeys(("replica", "world", "episode", "agent"), pa.int32()),
    **{name: total.column for name, total in _STORED_TOTALS.items() if not total.is_of_institutions},
}
"""The columns of a table, as in `Episode`; those of `INSTITUTION_COLUMNS` and the metrics follow, float64,
NaN where undefined.

Values of the whole episode are repeated in the row of each agent. Values that the game does not report have
no column. Outside of a training there are no columns "world", which numbers the worlds of all replicas, and
"wanted_return", which is null for agents that do not learn."""
INSTITUTION_COLUMNS: Final = {
    name: total.column for name, total in _STORED_TOTALS.items() if total.is_of_institutions
}
"""The columns of games with institutions; a count has one only where `cprl.measuring.registry.counts_for`
lists it."""


_COLUMN_TYPES: Final = {**COLUMNS, **INSTITUTION_COLUMNS}

LEFT_OUT: Final = b"left_out"
"""The key of the schema's metadata that says which columns are left out, and why."""


def _schema(names: Iterable[str]) -> pa.Schema:
    return pa.schema({name: _COLUMN_TYPES.get(name, pa.float64()) for name in names})


def schema_of(episode: Episode) -> pa.Schema:
    """Return the schema of an episode's columns; its metadata names missing columns."""
    schema = _schema(_columns(episode))
    missing = left_out_note(episode.reported)
    return schema.with_metadata({LEFT_OUT: missing}) if missing else schema


def rows_of(episodes: Sequence[Episode], schema: pa.Schema) -> pa.RecordBatch:
    """Return a row for each episode and agent, with the schema of the table's first episode.

    Raises:
        ValueError: for an episode with other columns.
    """
    columns_of_episodes = list(map(_columns, episodes))
    for columns in columns_of_episodes:
        if columns.keys() != set(schema.names):
            more = columns.keys() - set(schema.names)
            lacks = set(schema.names) - columns.keys()
            raise ValueError(
                f"the episode has the extra columns {sorted(more)} and lacks {sorted(lacks)}; allowed: the "
                "columns of the table's first episode"
            )
    arrays = []
    for field in schema:
        values = np.concatenate([columns[field.name] for columns in columns_of_episodes])
        is_nan_null = field.name == "wanted_return"  # for agents that do not learn
        arrays.append(pa.array(values, field.type, from_pandas=is_nan_null))
    return pa.record_batch(arrays, schema=schema)


def _columns(episode: Episode) -> dict[str, Any]:
    """Return the columns of an episode in order, [N] each."""
    agents = np.arange(len(episode.return_))
    entries = {**(episode.counts or {}), **vars(episode), "agent": agents, "return": episode.return_}
    if episode.wanted_return is None:  # outside of a training
        del entries["world"]
    columns = {name: entries[name] for name in _COLUMN_TYPES if entries.get(name) is not None}
    columns = {**columns, **episode.metrics, **columns}
    return {name: np.broadcast_to(values, agents.shape) for name, values in columns.items()}


def table_of(episodes: Sequence[Episode], replicas: Sequence[int] = (0,)) -> pa.Table:
    """Return episodes outside of a training as a table: equally many of each replica in turn, numbered from
    0."""
    count = len(episodes) // len(replicas)
    numbered = [
        replace(episode, replica=replicas[index // count], episode=index % count)
        for index, episode in enumerate(episodes)
    ]
    return pa.Table.from_batches([rows_of(numbered, schema_of(episodes[0]))])


def write_table(path: Path, table: pa.Table, *, over: bool = False) -> None:
    """Write a small parquet file atomically.

    Args:
        over: whether an existing file is replaced; else it raises a FileExistsError.
    """
    if not over:
        refuse_to_write_over(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: write_small(table, file))


def csv_text(table: pa.Table) -> str:
    """Return a table as CSV, with the names of the columns and without those of lists."""
    columns = [field.name for field in table.schema if not pa.types.is_list(field.type)]
    file = BytesIO()
    write_csv(table.select(columns), file)
    return file.getvalue().decode()


def write_small(table: pa.Table, file: BinaryIO) -> None:
    """Write a table as a small parquet file: each column as a dictionary, split into bytes, or plain,
    whichever is smallest."""
    encodings: dict[str, list[str]] = {"use_dictionary": [], "use_byte_stream_split": []}
    for field in table.schema:
        choices: list[dict[str, bool]] = [{"use_dictionary": True}, {"use_dictionary": False}]
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            choices.append({"use_dictionary": False, "use_byte_stream_split": True})
        best = min(choices, key=partial(_compressed_size, table.select([field.name])))
        for encoding, columns in encodings.items():
            if best.get(encoding):
                columns.append(field.name)
    pq.write_table(table, file, compression="zstd", compression_level=19, **encodings)


def _compressed_size(column: pa.Table, encoding: Mapping[str, bool]) -> int:
    file = BytesIO()
    pq.write_table(column, file, compression="zstd", compression_level=3, **encoding)  # a quick estimate
    return file.tell()
