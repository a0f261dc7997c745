"""Journal: rows as an Arrow stream, which unlike a parquet file needs no footer, so that it stays readable if
the process is killed."""

import os
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import pyarrow as pa

from cprl.runs.files import break_hard_links, refuse_no_file, sync_folder


def batches_in(path: Path) -> Iterator[tuple[pa.RecordBatch, int]]:
    """Yield the whole batches of a journal, each with the byte at which it ends."""
    refuse_no_file(path)
    source = pa.BufferReader(path.read_bytes())
    try:
        for batch in pa.ipc.open_stream(source):
            batch.validate()
            yield batch, source.tell()
    except (pa.ArrowException, OSError):  # the journal ends within a batch, or within the schema
        return


def read_journal(path: Path, schema: pa.Schema) -> pa.Table:
    """Return the rows of a journal.

    Args:
        schema: the columns of a journal that holds no whole batch.
    """
    batches = [batch for batch, _ in batches_in(path)]
    return pa.Table.from_batches(batches, None if batches else schema)


class Journal:
    """The open file of a journal, unbuffered: what `add` wrote survives SIGKILL.

    Args:
        path: the file, which is made if it does not exist.
        rows: after how many rows of an earlier file it is continued, without those that follow; by default
            after its last whole batch.

    Raises:
        ValueError: if the file has fewer rows, or no batch ends there.
    """

    def __init__(self, path: Path, *, rows: int | None = None) -> None:
        self.path = path
        self.rows = 0
        """The number of rows."""
        self.schema: pa.Schema | None = None
        """The columns; None before the first batch."""
        is_new = not path.exists()
        end = 0
        for batch, batch_end in () if is_new or rows == 0 else batches_in(path):
            self.rows += batch.num_rows
            self.schema = batch.schema
            end = batch_end
            if rows is not None and self.rows >= rows:
                break
        if rows is not None and self.rows != rows:
            raise ValueError(f"{path} holds {self.rows} rows up to there; the checkpoint has {rows}")
        break_hard_links(path)
        self._file = FileIO(path, "x" if is_new else "r+")
        self._file.truncate(end)
        self._file.seek(end)
        if is_new:
            sync_folder(path.parent)

    def add(self, batch: pa.RecordBatch) -> None:
        """Append a batch, whole or not at all: after half a batch nothing could be read."""
        end = self._file.tell()
        header = batch.schema.serialize().to_pybytes() if self.schema is None else b""
        left = memoryview(header + batch.serialize().to_pybytes())
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException:
            self._file.seek(end)
            self._file.truncate()
            raise
        self.schema = batch.schema
        self.rows += batch.num_rows

    def sync(self) -> None:
        """Sync the rows to the disk, so that they survive a power failure."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file, which can be continued later."""
        self._file.close()
