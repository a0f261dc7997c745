"""Journal: an Arrow stream on disk to which batches of rows are appended, each safe as soon as it is written.

Unlike a parquet file a stream needs no footer, so it stays readable if the process is killed; a batch that
was left half written at the end is left out.
"""

import os
from collections.abc import Iterable, Iterator
from io import FileIO
from pathlib import Path

import pyarrow as pa

from cprl.runs.files import refuse_special, sync_folder, write_atomically


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


def read_journal(path: Path) -> pa.Table | None:
    """The rows of a journal; None where it has no whole batch."""
    batches = [batch for batch, _ in batches_in(path)]
    return pa.Table.from_batches(batches) if batches else None


def write_journal(path: Path, batches: Iterable[pa.RecordBatch]) -> None:
    """Write a whole journal atomically."""
    messages = [_message(batch, is_first=place == 0) for place, batch in enumerate(batches)]
    write_atomically(path, lambda file: file.writelines(messages))


def _message(batch: pa.RecordBatch, *, is_first: bool) -> bytes:
    """A batch as it stands in a stream, the first behind the schema."""
    header = batch.schema.serialize().to_pybytes() if is_first else b""
    message: bytes = header + batch.serialize().to_pybytes()
    return message
