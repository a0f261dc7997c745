"""Recordings of Rerun."""

from importlib import import_module

from cprl.system.libraries import relying_on


def end_recordings() -> None:
    """Flushes and ends recordings to which nothing refers any more: until then Rerun keeps two threads and
    the buffers of each. `rerun.init` does the same, but makes another recording."""
    with relying_on("rerun-sdk", "rerun_bindings.flush_and_cleanup_orphaned_recordings"):
        end = import_module("rerun_bindings").flush_and_cleanup_orphaned_recordings
    end()
