"""Streams of one recording: to a file and, on request, served live on 127.0.0.1."""

import socket
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

LOCALHOST: Final = "127.0.0.1"
SERVER_MEMORY: Final = "512MB"
"""What the served recording may hold; beyond it the oldest rows are dropped, for viewers alone."""

FLUSH_TIMEOUT_S: Final = 5.0


class Stream:
    """One recording stream that may fail: then a warning says so once, and the run goes on without it.

    Args:
        name: what a person calls it.
        recording: a `rerun.RecordingStream`.
        period_s: seconds between two sendings of waiting numbers.
    """

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name, self.recording, self.period_s = name, recording, period_s
        self.waiting: dict[str, list[tuple[int, int, int, float]]] = {}
        """Numbers by entity that have not been sent: (step, episode, frame, value)."""
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether what waits has waited long enough."""
        return time.perf_counter() - self._sent > self.period_s

    def take(self) -> dict[str, list[tuple[int, int, int, float]]]:
        """What waits, to be sent now."""
        taken, self.waiting = self.waiting, {}
        self._sent = time.perf_counter()
        return taken

    def do(self, what: Callable[[Any], object]) -> None:
        """Does something with the stream, if it is still there."""
        if self.recording is None:
            return
        try:
            what(self.recording)
        except Exception as error:
            self.recording = None
            warnings.warn(
                f"the Rerun {self.name} is dropped, the run goes on without it: {error}",
                RuntimeWarning,
                stacklevel=2,
            )

    def close(self) -> None:
        """Disconnects; the file gets its footer. A second call does nothing."""
        self.do(lambda recording: recording.disconnect())
        self.recording = None


def open_file(recording_id: str, path: Path, blueprint: Any, *, period_s: float) -> Stream:
    """A stream into a new file."""
    recording = _recording(recording_id)
    recording.save(path, default_blueprint=blueprint)
    return Stream("file", recording, period_s=period_s)


def serve_live(recording_id: str, blueprint: Any, *, period_s: float) -> tuple[Stream, dict[str, str]]:
    """A stream served on a free port of 127.0.0.1, and where to watch it: "browser" and "native"."""
    import rerun as rr

    recording = _recording(recording_id)
    port = _free_port()
    recording.set_sinks(
        rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=SERVER_MEMORY), default_blueprint=blueprint
    )
    return Stream("live view", recording, period_s=period_s), _addresses(
        f"rerun+http://{LOCALHOST}:{port}/proxy"
    )


def _recording(recording_id: str) -> Any:
    import rerun as rr

    recording = rr.RecordingStream("cprl", recording_id=recording_id)
    recording.set_log_time_enabled(False)
    return recording


def _free_port() -> int:
    """A port of 127.0.0.1 that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def viewer() -> str:
    """How to start Rerun's own viewer: the one beside this Python, if there is one."""
    beside = Path(sys.executable).with_name("rerun")
    return str(beside) if beside.exists() else "rerun"


def _addresses(grpc: str) -> dict[str, str]:
    """Starts the web viewer's pages, and tells where to look."""
    import rerun as rr

    web = _free_port()
    rr.serve_web_viewer(web_port=web, open_browser=False)
    query = f"url={quote(grpc, safe='')}&renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
    return {"browser": f"http://{LOCALHOST}:{web}/?{query}", "native": f"{viewer()} --connect {grpc}"}
