"""Recordings of Rerun."""

import ctypes
from collections.abc import Callable
from importlib import import_module
from typing import Any, Self

from cprl.system.libraries import relying_on, require


def end_recordings() -> None:
    """Flush and end recordings to which nothing refers any more: until then Rerun keeps two threads and the
    buffers of each. `rerun.init` does the same, but makes another recording."""
    with relying_on("rerun-sdk", "rerun_bindings.flush_and_cleanup_orphaned_recordings"):
        end = import_module("rerun_bindings").flush_and_cleanup_orphaned_recordings
    end()


def keep_native(recording: Any, keep: Callable[..., object] = ctypes.pythonapi.Py_IncRef) -> None:
    """Keep the native part of a recording, the private `inner`, until the process ends: without it, the end
    of the recording waits for a viewer.

    Args:
        recording: a `rerun.RecordingStream`, as its `__del__` gets it.
        keep: bound here, because the interpreter clears modules before it deletes the last recordings.
    """
    keep(ctypes.py_object(recording.inner))


class StoredLayout:
    """The layout of a recording that is read, for another one that takes it over: Rerun has layouts log
    themselves, by the private `_log_to_stream`.
    """

    def __init__(self, chunks: Any) -> None:
        require("rerun-sdk", import_module("rerun.blueprint").Blueprint, "_log_to_stream")
        self._chunks = chunks

    def to_blueprint(self) -> Self:
        return self

    def _log_to_stream(self, stream: Any) -> None:
        stream.send_chunks(self._chunks)
