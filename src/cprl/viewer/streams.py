"""The streams of one recording: to a file and, on request, live on 127.0.0.1."""

import os
import shutil
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias
from urllib.parse import quote, urlsplit

from cprl.checks import SWITCH, Check, checked, shown
from cprl.viewer import deadline
from cprl.viewer.deadline import Sender, abandon, exit_in_time, within

LOCALHOST: Final = "127.0.0.1"
SERVER_MEMORY: Final = "512MB"
"""The memory limit of the served recording; beyond it viewers lose the oldest rows, the file does not."""

NEEDED_BYTES: Final = 2_000_000
"""The free disk space needed to start a recording; its layout and static parts take a tenth."""

FLUSH_TIMEOUT_S: Final = 5.0


Waiting: TypeAlias = dict[str, list[tuple[int, int, int, list[float] | str]]]
"""Numbers and texts by entity: (step, episode, frame, a number for each line or a Markdown text)."""


class Stream:
    """One recording stream. If it fails, it warns once, and the run continues without it.

    Args:
        name: the name in warnings.
        recording: a `rerun.RecordingStream`.
        period_s: seconds between two batches of buffered numbers.
    """

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name, self.recording, self.period_s = name, recording, period_s
        self.waiting: Waiting = {}
        """Numbers that have not been sent."""
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Whether the buffered numbers should be sent now."""
        return time.perf_counter() - self._sent > self.period_s

    def take(self) -> Waiting:
        """The buffered numbers; the buffer is empty afterwards."""
        taken, self.waiting = self.waiting, {}
        self._sent = time.perf_counter()
        return taken

    def do(self, what: Callable[[Any], object]) -> None:
        """Calls a function with the stream, unless the stream has failed."""
        if self.recording is None:
            return
        try:
            self._call(what)
        except Exception as error:
            self._fail(error)

    def close(self) -> None:
        """Disconnects; the file gets its footer. A second call does nothing."""
        if self.recording is None:
            return
        try:
            self._disconnect()
        except Exception as error:
            self._fail(error)
        self.recording = None

    def _call(self, what: Callable[[Any], object]) -> None:
        what(self.recording)

    def _disconnect(self) -> None:
        self.recording.disconnect()

    def _fail(self, error: Exception) -> None:
        self.recording = None
        warnings.warn(
            f"the Rerun {self.name} failed, the run continues without it: {error}",
            RuntimeWarning,
            stacklevel=4,
        )


class LiveStream(Stream):
    """A stream to viewers. Its calls are made in a thread of its own, because a viewer that stands still, or
    accepts a connection and never reads, makes them wait forever; see `cprl.viewer.deadline`.
    """

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        super().__init__(name, recording, period_s=period_s)
        self._sender = Sender()

    def _call(self, what: Callable[[Any], object]) -> None:
        self._sender.put(partial(what, self.recording))

    def _disconnect(self) -> None:
        self._sender.put(self.recording.disconnect)
        self._sender.close()

    def _fail(self, error: Exception) -> None:
        abandon(self.recording)
        super()._fail(error)


_LIVE: Final = '"serve", "spawn" or "connect rerun+http://HOST:PORT/proxy"'


def check_watch(watch: str, *, can_be_off: bool = True) -> None:
    """Checks a recipe's `watch` before the run starts.

    Args:
        watch: "file", or live as well, see `open_live`; "off" for no recording.
        can_be_off: whether "off" is allowed.

    Raises:
        ValueError: if the value is not allowed; names it and the allowed values.
    """
    checked("watch", watch, Check(lambda value: isinstance(value, str), f'"file", "off", {_LIVE}'))
    checked("can_be_off", can_be_off, SWITCH)
    if watch != "file" and not (can_be_off and watch == "off"):
        offs = '"off", ' if can_be_off else ""
        _check(watch, f'"file", {offs}{_LIVE}', name="watch")


def _check(live: str, allowed: str, *, name: str = "live") -> None:
    how, _, address = live.partition(" ")
    where = urlsplit(address.removeprefix("rerun+"))
    try:
        connects = how == "connect" and address.startswith("rerun+http") and bool(where.hostname)
        connects = connects and where.port != 0
    except ValueError:  # the port is not a number
        connects = False
    if not connects and live not in ("serve", "spawn"):
        raise ValueError(f"{name} is {shown(live)}; allowed: {allowed}")


def open_file(recording_id: str, path: Path, blueprint: Any, *, period_s: float) -> Stream | None:
    """A stream to a new file; None, with a warning, if the disk is almost full.

    Otherwise Rerun may wait forever for the layout to be written.
    """
    free = shutil.disk_usage(path.parent).free
    if free < NEEDED_BYTES:
        _warn_of(f"file {path}", f"{free:,} bytes are free there, {NEEDED_BYTES:,} are needed")
        return None
    recording = _recording(recording_id)
    recording.save(path, default_blueprint=blueprint)
    return Stream("file", recording, period_s=period_s)


def open_live(
    live: str, recording_id: str, blueprint: Any, *, period_s: float
) -> tuple[Stream | None, dict[str, str]]:
    """A live stream, and how to watch it: "browser" and "native".

    Args:
        live: "serve": serves the recording on free ports of 127.0.0.1; viewers can connect at any time and
            get the history. "spawn": the same, and starts Rerun's native viewer. "connect ADDRESS": sends to
            a listening viewer, such as rerun+http://127.0.0.1:9876/proxy.
        recording_id: the id of the recording.
        blueprint: its layout.
        period_s: seconds between two batches of buffered numbers.

    Raises:
        ValueError: if `live` is anything else.
    """
    _check(live, _LIVE)
    if live.startswith("connect "):
        return _connect(live.partition(" ")[2], recording_id, blueprint, period_s), {}
    stream, grpc = _serve(recording_id, blueprint, period_s)
    if live == "spawn":
        _spawn(grpc)
    return stream, _addresses(grpc)


def _serve(recording_id: str, blueprint: Any, period_s: float) -> tuple[Stream, str]:
    """A stream served on a free port of 127.0.0.1, and its address."""
    import rerun as rr

    exit_in_time()
    recording, port = _recording(recording_id), _free_port()
    recording.set_sinks(
        rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=SERVER_MEMORY), default_blueprint=blueprint
    )
    return LiveStream("live view", recording, period_s=period_s), f"rerun+http://{LOCALHOST}:{port}/proxy"


def _connect(address: str, recording_id: str, blueprint: Any, period_s: float) -> Stream | None:
    """A stream to a listening viewer; None, with a warning, if there is none.

    Without this check Rerun would wait for the viewer and eventually block the training.
    """
    where = urlsplit(address.removeprefix("rerun+"))

    def connect() -> Any:
        socket.create_connection((where.hostname or LOCALHOST, where.port or 9876), timeout=2).close()
        recording = _recording(recording_id)
        recording.connect_grpc(address, default_blueprint=blueprint)
        return recording

    exit_in_time()
    try:
        recording = within(deadline.CONNECT_S, connect)
    except OSError as error:
        abandon(error)
        _warn_of(f"viewer at {address}", error)
        return None
    return LiveStream(f"viewer at {address}", recording, period_s=period_s)


def _spawn(grpc: str) -> None:
    """Starts Rerun's native viewer in its own process; warns if it cannot open."""
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
    warnings.warn(f"the Rerun {what}: {why}; the run continues without it", RuntimeWarning, stacklevel=3)


def _recording(recording_id: str) -> Any:
    import rerun as rr

    recording = rr.RecordingStream("cprl", recording_id=recording_id)
    recording.set_log_time_enabled(False)
    return recording


def _free_port() -> int:
    """A free port of 127.0.0.1."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def viewer() -> str:
    """The command of Rerun's native viewer: the one next to this Python, if there is one."""
    beside = Path(sys.executable).with_name("rerun")
    return str(beside) if beside.exists() else "rerun"


def _addresses(grpc: str) -> dict[str, str]:
    """Starts the web viewer's pages; returns the addresses."""
    import rerun as rr

    web = _free_port()
    rr.serve_web_viewer(web_port=web, open_browser=False)
    query = f"url={quote(grpc, safe='')}&renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
    return {"browser": f"http://{LOCALHOST}:{web}/?{query}", "native": f"{viewer()} --connect {grpc}"}
