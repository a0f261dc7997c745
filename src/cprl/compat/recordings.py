"""Recordings of Rerun."""

import ctypes
from collections.abc import Callable, Mapping
from typing import Any


def end_recordings() -> None:
    """Flushes and ends recordings to which nothing refers any more: until then Rerun keeps two threads and
    the buffers of each. `rerun.init` does the same, but makes another recording."""
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    flush_and_cleanup_orphaned_recordings()


def send_chunk(
    recording: Any, entity: str, timelines: Mapping[str, Any], components: Mapping[Any, Any]
) -> None:
    """`RecordingStream.send_columns` without its checks and conversions, which take most of its time where a
    row is sent: `pyarrow` arrays of equal length by timeline and by component descriptor, without timelines a
    static row."""
    from rerun_bindings import send_arrow_chunk

    send_arrow_chunk(
        entity, timelines=dict(timelines), components=dict(components), recording=recording.to_native()
    )


def rows_made(entity: str, components: Mapping[Any, Any]) -> list[Any]:
    """The rows of `pyarrow` arrays of equal length, by component descriptor, as static chunks for
    `send_made`."""
    from rerun_bindings import ChunkInternal

    count = len(next(iter(components.values())))
    return [
        ChunkInternal.from_columns(entity, {}, {kind: own.slice(row, 1) for kind, own in components.items()})
        for row in range(count)
    ]


def send_made(recording: Any, made: Any) -> None:
    """Sends a chunk that has been made before, in a fifth of the time of `send_chunk` on cold caches."""
    from rerun_bindings import send_chunks

    send_chunks(made, recording.to_native())


def keep_native(recording: Any, keep: Callable[..., object] = ctypes.pythonapi.Py_IncRef) -> None:
    """In place of a recording's end, which waits for a viewer: its native part, the private `inner`, stays
    until the process ends.

    Args:
        recording: a `rerun.RecordingStream`, as its `__del__` gets it.
        keep: bound here, because the interpreter clears modules before it deletes the last recordings.
    """
    keep(ctypes.py_object(recording.inner))
