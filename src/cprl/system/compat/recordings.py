"""Recordings of Rerun."""

import ctypes
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from typing import Any

from cprl.system.libraries import relying_on


@cache
def _binding(name: str) -> Any:
    """A part of the private module of Rerun's native code."""
    with relying_on("rerun-sdk", f"rerun_bindings.{name}"):
        return getattr(import_module("rerun_bindings"), name)


def end_recordings() -> None:
    """Flushes and ends recordings to which nothing refers any more: until then Rerun keeps two threads and
    the buffers of each. `rerun.init` does the same, but makes another recording."""
    _binding("flush_and_cleanup_orphaned_recordings")()


def send_chunk(
    recording: Any, entity: str, timelines: Mapping[str, Any], components: Mapping[Any, Any]
) -> None:
    """`RecordingStream.send_columns` without its checks and conversions, which take most of its time where a
    row is sent: `pyarrow` arrays of equal length by timeline and by component descriptor, without timelines a
    static row."""
    _binding("send_arrow_chunk")(
        entity, timelines=dict(timelines), components=dict(components), recording=recording.to_native()
    )


def keep_native(recording: Any, keep: Callable[..., object] = ctypes.pythonapi.Py_IncRef) -> None:
    """In place of a recording's end, which waits for a viewer: its native part, the private `inner`, stays
    until the process ends.

    Args:
        recording: a `rerun.RecordingStream`, as its `__del__` gets it.
        keep: bound here, because the interpreter clears modules before it deletes the last recordings.
    """
    keep(ctypes.py_object(recording.inner))
