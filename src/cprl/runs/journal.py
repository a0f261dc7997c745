"""Journal: an Arrow stream on disk to which batches of rows are appended, each safe as soon as it is written.

Unlike a parquet file a stream needs no footer, so it stays readable if the process is killed. The metadata of
each batch holds the CRC-32 of the schema and of its values, so that a damaged batch is refused.
"""

import os
import zlib
from collections.abc import Iterable
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa

from cprl.runs.files import refuse_special, sync_folder, write_atomically

_CHECKSUM: Final = b"crc32"
_END: Final = 8
"""Bytes of the marker that ends a stream, which a journal does not have."""
_MARKER: Final = b"\xff\xff\xff\xff"
"""How every message of a stream begins, at a multiple of 8 bytes."""


class Content(NamedTuple):
    """What a journal holds."""

    schema: pa.Schema | None
    """None before the first batch."""
    batches: list[pa.RecordBatch]
    ends: list[int]
    """Where each batch ends, in bytes."""


class Journal:
    """Appends batches to a journal.

    Args:
        path: the file; it is created where it does not exist.
    """

    def __init__(self, path: Path) -> None:
        exists = path.exists()
        # Unbuffered, so that written data survives the process.
        self.path, self._file = path, FileIO(path, "r+" if exists else "x")
        self._header: bytes | None = None
        if not exists:
            sync_folder(path.parent)

    def begin(self, schema: pa.Schema) -> None:
        """Writes the schema of all batches."""
        header = schema.serialize().to_pybytes()
        self._write(memoryview(header))
        self._header = header

    def append(self, batch: pa.RecordBatch) -> None:
        """Appends all of a batch or nothing: behind half of one later ones would be unreadable."""
        assert self._header is not None
        self._write(_message(batch, self._header))

    def cut(self, content: Content, batches: int) -> None:
        """Continues after the first batches of its content; what follows is dropped."""
        end = content.ends[batches - 1] if batches else 0
        self._header = None if content.schema is None else content.schema.serialize().to_pybytes()
        if not batches:
            self._header = None
        self._file.truncate(end)
        self._file.seek(end)

    def sync(self) -> None:
        """Waits until all that was appended is on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the file. A second call does nothing."""
        self._file.close()

    def _write(self, left: memoryview) -> None:
        end = self._file.tell()
        try:
            while left:
                left = left[self._file.write(left) :]
        except BaseException:
            self._file.seek(end)
            self._file.truncate()
            raise


def write_journal(path: Path, batches: Iterable[pa.RecordBatch], schema: pa.Schema) -> None:
    """Writes a whole journal atomically."""
    header = schema.serialize().to_pybytes()

    def write(file: Any) -> None:
        file.write(header)
        for batch in batches:
            file.write(_message(batch, header))

    write_atomically(path, write)


def read_journal(path: Path) -> Content:
    """What a journal holds; a batch that a killed process left half written at the end is left out.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    refuse_special(path)
    data = path.read_bytes()
    source = pa.BufferReader(data)
    try:
        reader = pa.ipc.open_stream(source)
    except (pa.ArrowException, OSError):
        _refuse_damage(path, data, 0, rows=0)
        return Content(None, [], [])
    content = Content(reader.schema, [], [])
    rows = 0
    while (start := source.tell()) < len(data):
        try:
            batch, metadata = reader.read_next_batch_with_custom_metadata()
            batch.validate(full=True)
        except StopIteration:
            break
        except (pa.ArrowException, OSError):
            _refuse_damage(path, data, start, rows=rows)
            break
        checksum = None if metadata is None else metadata.get(_CHECKSUM)
        if checksum is None:
            raise ValueError(
                f"{path} has no checksum behind row {rows}: it was changed, or an earlier cprl wrote it; "
                "finish that run with the version that began it (its recipe.json has the commit)"
            )
        if checksum != _checksum(batch):
            raise _damaged(path, rows)
        if _has_message(data, start + 8, source.tell()):  # a damaged length swallowed the next one
            raise _damaged(path, rows)
        content.batches.append(batch)
        content.ends.append(source.tell())
        rows += batch.num_rows
    if content.ends and content.ends[-1] < len(data):
        _refuse_damage(path, data, content.ends[-1], rows=rows)
    return content


def _refuse_damage(path: Path, data: bytes, start: int, *, rows: int) -> None:
    """Refuses what cannot be read unless it is the last of the file: only the last can be half written."""
    if _has_message(data, start - start % 8, len(data)):
        raise _damaged(path, rows)


def _has_message(data: bytes, start: int, end: int) -> bool:
    """Whether a whole batch begins between two places."""
    at = start - 1
    while (at := data.find(_MARKER, at + 1, end)) >= 0:
        with suppress(pa.ArrowException, OSError, EOFError, MemoryError):
            if at % 8 == 0 and pa.ipc.read_message(pa.py_buffer(data)[at:]).type == "record batch":
                return True
    return False


def _damaged(path: Path, rows: int) -> ValueError:
    return ValueError(f"{path} is damaged or was changed behind row {rows}")


def _message(batch: pa.RecordBatch, header: bytes) -> memoryview:
    """A batch as it stands in a stream, with its checksum."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, batch.schema) as stream:
        stream.write_batch(batch, custom_metadata={_CHECKSUM: _checksum(batch)})
    return memoryview(sink.getvalue())[len(header) : -_END]


def _checksum(batch: pa.RecordBatch) -> bytes:
    """CRC-32 of the schema and of all values, in hexadecimal."""
    crc = zlib.crc32(repr([str(own) for own in batch.schema]).encode())
    for name, value in sorted((batch.schema.metadata or {}).items()):
        crc = zlib.crc32(value, zlib.crc32(name, crc))
    for column in batch.columns:
        crc = zlib.crc32(column.to_numpy(zero_copy_only=False).tobytes(), crc)
    return b"%08x" % crc
