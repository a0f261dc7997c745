"""The streams of one recording, to a file and live: each may fail without harm to the run."""

import atexit
import os
import shutil
import subprocess
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any, Final, TypeAlias, TypeVar

import rerun as rr

from cprl.system.compat import end_recordings, keep_native
from cprl.system.output import legible, printed
from cprl.values import checked
from cprl.viewer.page import LOCALHOST, Page, free_port, has_display, viewer
from cprl.viewer.watching import Served

T = TypeVar("T")

STALL_S: Final = 2.0
"""Seconds that a training waits for a place in the queue of a viewer that has stopped taking data."""

CLOSE_S: Final = 5.0
"""Seconds within which a viewer must take the last data when a run ends, and when the interpreter exits."""

QUEUED_CALLS: Final = 256
"""Calls that wait for a viewer; the frames of about thirty episodes."""

_ABANDONED: Final[list[object]] = []
"""Recordings whose viewer does not answer; dropping the last reference to one would wait for its viewer."""


def within(seconds: float, what: Callable[[], T]) -> T:
    """The result of a function, called in a thread that nothing waits for after the deadline."""
    results: list[T] = []
    errors: list[Exception] = []

    def call() -> None:
        try:
            results.append(what())
        except Exception as error:
            errors.append(error)

    thread = Thread(target=call, daemon=True)
    thread.start()
    thread.join(seconds)
    if errors:
        raise errors[0]
    if not results:
        raise TimeoutError(f"no answer within {seconds:g} s")
    return results[0]


class Sender:
    """Calls functions, one after the other, in a thread of its own, until one of them fails."""

    def __init__(self) -> None:
        self._queue: Queue[Callable[[], object] | None] = Queue(QUEUED_CALLS)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, daemon=True, name="cprl viewer")
        self._thread.start()

    @property
    def waiting(self) -> int:
        """The number of calls that have not been begun, approximately."""
        return self._queue.qsize()

    def put(self, what: Callable[[], object] | None) -> None:
        """Queues a call; waits at most `STALL_S`."""
        if self._error is not None:
            raise self._error
        try:
            self._queue.put(what, timeout=STALL_S)
        except Full:
            raise TimeoutError(f"it has taken no data for {STALL_S:g} s and the queue is full") from None

    def close(self) -> None:
        """Ends the thread when all calls are done; waits at most `CLOSE_S`."""
        ends = time.monotonic() + CLOSE_S
        self.put(None)
        self._thread.join(max(0.0, ends - time.monotonic()))
        if self._error is not None:
            raise self._error
        if self._thread.is_alive():
            raise TimeoutError(f"it has not taken the last data within {CLOSE_S:g} s")

    def _work(self) -> None:
        while (what := self._queue.get()) is not None:
            try:
                what()
            except Exception as error:
                self._error = error
                return


def release() -> None:
    """Ends the threads of recordings that are closed; a viewer that went away was reported when it did."""
    if _ABANDONED:  # it would wait for their viewers
        return
    with suppress(TimeoutError, RuntimeError):
        within(CLOSE_S, end_recordings)


@cache
def exit_in_time() -> None:
    """Gives Rerun's own last flush, when the interpreter exits, a deadline; it has none of itself."""

    def shutdown() -> None:
        with suppress(TimeoutError):
            within(STALL_S if _ABANDONED else CLOSE_S, rr.rerun_shutdown)
            if not _ABANDONED:
                return
        # A shutdown that waits holds a lock, for which the end of any other recording would wait.
        rr.RecordingStream.__del__ = keep_native  # type: ignore[method-assign]

    rr.unregister_shutdown()
    atexit.register(shutdown)


FLUSH_TIMEOUT_S: Final = 5.0

_KEEPS_UP: Final = 1
"""The number of calls that may wait for viewers that keep up."""


Row: TypeAlias = tuple[int, int, int, list[float] | str]
"""Step, episode, frame, and a number for each line or a Markdown text."""


class Stream:
    """One recording stream. If it fails, it warns once, and the run continues without it."""

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name, self.recording, self.period_s = name, recording, period_s
        self.waiting: dict[str, list[Row]] = {}
        """Numbers and texts that have not been sent, by entity."""
        self._sent = time.perf_counter()

    @property
    def is_behind(self) -> bool:
        """Whether viewers do not keep up, so that what can be left out should be."""
        return False

    @property
    def is_due(self) -> bool:
        return time.perf_counter() - self._sent > self.period_s

    def take(self) -> dict[str, list[Row]]:
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
            stacklevel=5,
        )


class LiveStream(Stream):
    """A stream to viewers. Its calls are made in a thread of its own, because a viewer that stands still, or
    accepts a connection and never reads, makes them wait forever; see `cprl.viewer.streams`.
    """

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        super().__init__(name, recording, period_s=period_s)
        self._sender = Sender()

    @property
    def is_behind(self) -> bool:
        """Whether calls wait that viewers have not taken."""
        return self._sender.waiting > _KEEPS_UP

    def _call(self, what: Callable[[Any], object]) -> None:
        self._sender.put(partial(what, self.recording))

    def _disconnect(self) -> None:
        self._sender.put(self.recording.disconnect)
        self._sender.close()

    def _fail(self, error: Exception) -> None:
        _ABANDONED.append(self.recording)
        super()._fail(error)


RUN, REPLAY = "cprl", "cprl replay"
"""The application ids of runs and of replays: a viewer keeps one layout for each. Recordings of a run that is
resumed must have that of its first one."""

SERVER_MEMORY: Final = "512MB"
"""The memory limit of the served recording; beyond it viewers lose the oldest rows, the file does not."""

EXHIBITION_MEMORY: Final = "1MB"
"""The same of the exhibition, of which viewers need the newest frame alone."""

NEEDED_BYTES: Final = 2_000_000
"""The free disk space needed to start a recording; its layout and static parts take a tenth."""


@dataclass(frozen=True)
class Live:
    """What viewers are sent."""

    stream: Stream | None = None
    """The recording; None without a viewer."""
    exhibition: Stream | None = None
    """Where the exhibition is sent, which waits between its frames; a server of its own, since a server that
    has used its memory drops the oldest rows of all. None where nothing is exhibited."""
    addresses: dict[str, str] = field(default_factory=dict)
    """How to watch: "browser" and "native"."""
    page: Page | None = None
    """The page of the web viewer."""

    def close(self) -> None:
        """Closes the exhibition and the page; the recording is closed with the file."""
        if self.exhibition is not None:
            self.exhibition.close()
        if self.page is not None:
            self.page.close()


def open_file(
    recording_id: str, path: Path, blueprint: Any, period_s: float, application: str = RUN
) -> Stream | None:
    """A stream to a new file; None, with a warning, if the disk is almost full.

    Otherwise Rerun may wait forever for the layout to be written.
    """
    free = shutil.disk_usage(path.parent).free
    if free < NEEDED_BYTES:
        _warn_of(f"file {path}", f"{free:,} bytes are free there, {NEEDED_BYTES:,} are needed")
        return None
    recording = _recording(application, recording_id)
    try:
        recording.save(path, default_blueprint=blueprint)
    except UnicodeEncodeError:  # Rerun takes no folder whose name is not in UTF-8
        folder = os.open(path.parent, os.O_RDONLY)
        recording.save(f"/proc/self/fd/{folder}/{path.name}", default_blueprint=blueprint)
        os.close(folder)
    return Stream("file", recording, period_s=period_s)


def open_live(
    live: str,
    recording_id: str,
    blueprint: Any,
    period_s: float,
    application: str = RUN,
    *,
    exhibits: bool = False,
) -> Live:
    """A live stream, one for the exhibition if there is any, and how to watch them.

    Args:
        live: "serve": serves the recording on free ports of 127.0.0.1; viewers can connect at any time and
            get the history. "spawn": the same, and starts Rerun's native viewer.
    """
    checked("live", live, Served)
    recording = _recording(application, recording_id)
    stream, *grpc = _serve("live view", recording, blueprint, period_s, SERVER_MEMORY)
    exhibition = None
    if exhibits:  # with the layout as well: a viewer may hear of the recording here first
        recording = _recording(application, recording_id, send_properties=False)
        exhibition, address = _serve("exhibition", recording, blueprint, period_s, EXHIBITION_MEMORY)
        grpc.append(address)
    if live == "spawn":
        _spawn(grpc)
    page, native = Page(), printed([viewer(), "--connect", *grpc])
    return Live(stream, exhibition, {"browser": page.address(*grpc), "native": native}, page)


def _serve(name: str, recording: Any, blueprint: Any, period_s: float, memory: str) -> tuple[Stream, str]:
    """A stream served on a free port of 127.0.0.1, and its address."""
    exit_in_time()
    port = free_port()
    recording.set_sinks(
        rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=memory), default_blueprint=blueprint
    )
    return LiveStream(name, recording, period_s=period_s), f"rerun+http://{LOCALHOST}:{port}/proxy"


def _spawn(grpc: list[str]) -> None:
    """Starts Rerun's native viewer in its own process; warns if it cannot open."""
    if not has_display():
        _warn_of("viewer cannot open", "there is no display; open one of the addresses from elsewhere")
        return
    try:
        subprocess.Popen(
            [viewer(), "--connect", *grpc],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        _warn_of("viewer cannot be started", error)


def _warn_of(what: str, why: object) -> None:
    warnings.warn(f"the Rerun {what}: {why}; the run continues without it", RuntimeWarning, stacklevel=3)


def _recording(application: str, recording_id: str, *, send_properties: bool = True) -> Any:
    recording = rr.RecordingStream(
        application,
        recording_id=legible(recording_id),
        send_properties=send_properties,
        batcher_config=rr.ChunkBatcherConfig(flush_num_rows=1),  # columns would overtake rows that wait
    )
    recording.set_log_time_enabled(False)
    return recording
