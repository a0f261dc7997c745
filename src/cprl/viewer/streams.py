"""Streams of one recording: to a file and, on request, served live on 127.0.0.1."""

import os
import shutil
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeAlias
from urllib.parse import quote, urlsplit

LOCALHOST: Final = "127.0.0.1"
SERVER_MEMORY: Final = "512MB"
"""What the served recording may hold; beyond it the oldest rows are dropped, for viewers alone."""

ROOM_BYTES: Final = 2_000_000
"""Free on a disk, so that a recording is begun there; its layout and static parts take a tenth."""

FLUSH_TIMEOUT_S: Final = 5.0


Waiting: TypeAlias = dict[str, list[tuple[int, int, int, list[float]]]]
"""Numbers by entity: (step, episode, frame, a number for each line)."""


class Stream:
    """One recording stream that may fail: then a warning says so once, and the run goes on without it.

    Args:
        name: what a person calls it.
        recording: a `rerun.RecordingStream`.
        period_s: seconds between two sendings of waiting numbers.
    """

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name, self.recording, self.period_s = name, recording, period_s
        self.waiting: Waiting = {}
        """What has not been sent."""
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether what waits has waited long enough."""
        return time.perf_counter() - self._sent > self.period_s

    def take(self) -> Waiting:
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


_WAYS: Final = '"serve", "spawn" or "connect rerun+http://HOST:PORT/proxy"'


def check_watch(watch: str, *, can_be_off: bool = True) -> None:
    """Refuses a recipe's `watch` that is no way to watch, before a run is begun for it.

    Args:
        watch: "file", or live as well, see `open_live`; "off" for no recording.
        can_be_off: whether the recipe can do without.

    Raises:
        ValueError: for anything else; says what came and what fits.
    """
    if watch != "file" and not (can_be_off and watch == "off"):
        offs = '"off", ' if can_be_off else ""
        _check(watch, f'"file", {offs}{_WAYS}', name="watch")


def _check(live: str, wanted: str, *, name: str = "live") -> None:
    how, _, address = live.partition(" ")
    where = urlsplit(address.removeprefix("rerun+"))
    try:
        connects = how == "connect" and address.startswith("rerun+http") and bool(where.hostname)
        connects = connects and where.port != 0
    except ValueError:  # of a port that is no number
        connects = False
    if not connects and live not in ("serve", "spawn"):
        raise ValueError(f"{name} is {live!r}; wanted: {wanted}")


def open_file(recording_id: str, path: Path, blueprint: Any, *, period_s: float) -> Stream | None:
    """A stream into a new file; None, with a warning, where the disk is as good as full.

    Rerun would wait for ever, now and then, for a layout that finds no room.
    """
    free = shutil.disk_usage(path.parent).free
    if free < ROOM_BYTES:
        _warn_of(f"file {path}", f"{free:,} bytes are free there, {ROOM_BYTES:,} are wanted")
        return None
    recording = _recording(recording_id)
    recording.save(path, default_blueprint=blueprint)
    return Stream("file", recording, period_s=period_s)


def open_live(
    live: str, recording_id: str, blueprint: Any, *, period_s: float
) -> tuple[Stream | None, dict[str, str]]:
    """A stream that can be watched while it is written, and where: "browser" and "native".

    Args:
        live: "serve": served on free ports of 127.0.0.1, where viewers come and go and get the history;
            "spawn": that, and Rerun's own viewer is started; "connect ADDRESS": sent to a viewer that
            listens, such as rerun+http://127.0.0.1:9876/proxy.
        recording_id: of the recording.
        blueprint: its layout.
        period_s: seconds between two sendings of waiting numbers.

    Raises:
        ValueError: for anything else.
    """
    _check(live, _WAYS)
    if live.startswith("connect "):
        return _connect(live.partition(" ")[2], recording_id, blueprint, period_s), {}
    stream, grpc = _serve(recording_id, blueprint, period_s)
    if live == "spawn":
        _spawn(grpc)
    return stream, _addresses(grpc)


def _serve(recording_id: str, blueprint: Any, period_s: float) -> tuple[Stream, str]:
    """A stream served on a free port of 127.0.0.1, and its address."""
    import rerun as rr

    recording, port = _recording(recording_id), _free_port()
    recording.set_sinks(
        rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=SERVER_MEMORY), default_blueprint=blueprint
    )
    return Stream("live view", recording, period_s=period_s), f"rerun+http://{LOCALHOST}:{port}/proxy"


def _connect(address: str, recording_id: str, blueprint: Any, period_s: float) -> Stream | None:
    """A stream to a viewer that listens there; None, with a warning, where nobody does.

    Without this look Rerun would wait for the viewer, and at last hold up the training.
    """
    where = urlsplit(address.removeprefix("rerun+"))
    try:
        socket.create_connection((where.hostname or LOCALHOST, where.port or 9876), timeout=2).close()
    except OSError as error:
        _warn_of(f"viewer at {address}", error)
        return None
    recording = _recording(recording_id)
    recording.connect_grpc(address, default_blueprint=blueprint)
    return Stream(f"viewer at {address}", recording, period_s=period_s)


def _spawn(grpc: str) -> None:
    """Starts Rerun's own viewer beside the training; where it cannot open, a warning says so."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        _warn_of("viewer cannot open", "there is no display; open one of the addresses from elsewhere")
        return
    try:
        subprocess.Popen(
            [viewer(), "--connect", grpc],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        _warn_of("viewer cannot be started", error)


def _warn_of(what: str, why: object) -> None:
    warnings.warn(f"the Rerun {what}: {why}; the run goes on without it", RuntimeWarning, stacklevel=3)


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
