"""Where a recording goes: to a file and to live viewers. Each stream may fail without harm to the run."""

import atexit
import os
import shutil
import subprocess
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache, partial
from operator import methodcaller
from pathlib import Path
from queue import Full, Queue
from threading import Thread, Timer
from typing import Any, Final, TypeAlias

import rerun as rr
from rerun.chunk import RrdReader

from cprl.system.compat.recordings import StoredLayout, keep_native
from cprl.system.output import legible
from cprl.values import checked
from cprl.viewer.names import HEADER
from cprl.viewer.page import LOCALHOST, Served, WebViewer, free_port, has_display

STALL_S: Final = 2.0
"""Seconds that a training waits for a place in the queue of a viewer that has stopped taking data."""
CLOSE_S: Final = 5.0
"""Seconds within which a viewer must take the last data when a run ends, and when the interpreter exits."""
QUEUED_CALLS: Final = 256
"""The length of the queue of calls to a viewer: the frames of about thirty episodes."""
FLUSH_TIMEOUT_S: Final = 5.0
"""Seconds that a flush of a recording may take."""

RUN_APPLICATION: Final = "cprl"
"""The application id of a training's recordings. A viewer keeps one layout for each id, and all recordings of
a resumed run must have the same id."""
REPLAY_APPLICATION: Final = "cprl replay"
"""The application id of recordings in which a stored policy plays."""
_SERVER_MEMORY: Final = "512MB"
"""The memory limit of the served recording. Beyond it viewers lose the oldest rows; the file keeps them."""
_EXHIBITION_MEMORY: Final = "1MB"
"""The memory limit of the exhibition: viewers need only its newest frame."""
_FILES_MEMORY: Final = "75%"
"""The memory limit of a server that serves recordings from files, as a share of the machine's memory."""
_NEEDED_BYTES: Final = 2_000_000
"""The free disk space needed to start a recording. Its layout and static parts take a tenth of it."""

HISTORY_S: Final = 60.0
"""The age in seconds from which a live recording is so long that browsers take a while to read it."""
LOADING_S: Final = 20.0
"""About how many seconds a browser takes to read the history after it has opened the page."""

_STALLED: Final[list[Any]] = []
"""Recordings whose viewers do not answer, kept alive: freeing one would wait for its viewer."""

BufferedRow: TypeAlias = tuple[int, int, int, list[float] | str]
"""The step, the episode and the frame of a row, and its value: a number for each line, or a Markdown text."""


class Stream:
    """A recording on its way to a file. If it fails, it warns once, and the run continues without it.

    Args:
        name: what warnings call the stream.
        recording: the `rerun.RecordingStream`.
        period_s: the seconds between two sends of buffered rows.
    """

    is_live = False
    """Whether the stream leads to viewers."""

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name = name
        self.recording = recording
        self.period_s = period_s
        self.is_open = True
        self.has_failed = False
        self.buffer: dict[str, list[BufferedRow]] = {}
        """Numbers and texts that have not been sent, by entity."""
        self._last_sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        """Return whether the period since the last send is over."""
        return time.perf_counter() - self._last_sent > self.period_s

    def take_buffer(self) -> dict[str, list[BufferedRow]]:
        """Empty the buffer and return the rows that it held."""
        rows = self.buffer
        self.buffer = {}
        self._last_sent = time.perf_counter()
        return rows

    def call(self, function: Callable[[Any], object]) -> None:
        """Call a function with the recording, unless the stream has failed or is closed."""
        if self.is_open:
            self._try(partial(self._call, function))

    def close(self) -> None:
        """Disconnect; the file gets its footer. A second call does nothing."""
        if self.is_open:
            self._try(self._disconnect)
            self.is_open = False

    def _try(self, action: Callable[[], object]) -> None:
        """Do something with the stream; if it raises, close the stream and warn."""
        try:
            action()
        except Exception as error:
            self.is_open = False
            self.has_failed = True
            if self.is_live:
                _STALLED.append(self.recording)
            warnings.warn(
                f"the Rerun {self.name} failed, the run continues without it: {error}",
                RuntimeWarning,
                stacklevel=5,
            )

    def _call(self, function: Callable[[Any], object]) -> None:
        function(self.recording)

    def _disconnect(self) -> None:
        self.recording.disconnect()


class LiveStream(Stream):
    """A recording on its way to viewers, served by Rerun.

    Functions are called with it in a separate thread: a viewer that hangs, or connects and never reads, would
    make the training wait for half a minute.

    Args:
        history_s: the age in seconds from which the header tells browsers that they are loading the history.
    """

    is_live = True

    def __init__(self, name: str, recording: Any, *, period_s: float, history_s: float = HISTORY_S) -> None:
        super().__init__(name, recording, period_s=period_s)
        self._header = ""
        self._loading_browsers = 0
        self._has_history_from = time.perf_counter() + history_s
        self._queue: Queue[Callable[[Any], object] | None] = Queue(QUEUED_CALLS)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, daemon=True, name="cprl viewer")
        self._thread.start()

    @property
    def is_behind(self) -> bool:
        """Return whether a viewer has not yet taken earlier data, so that dispensable frames should be left
        out."""
        return self._queue.qsize() > 1

    def send_header(self, recording: Any, text: str) -> None:
        """Send a header without a time, which replaces the earlier one at every step.

        Call it through `call`. The server sends what has no time before the history, so a viewer that
        connects late never shows an old header as the present.
        """
        self._header = text
        if self._loading_browsers:
            text = text.replace(" ", " History loads · ", 1)
        recording.send_columns(HEADER, [], rr.TextDocument.columns(text=[text]))

    def show_loading(self) -> None:
        """Say in the header that the history loads, for as long as a browser that opens the page needs.

        The browser reads the newest header first, then the history, then what is sent from now on.
        """
        if time.perf_counter() < self._has_history_from:
            return
        self.call(partial(self._count_loading_browsers, change=1))
        loaded = Timer(LOADING_S, self.call, [partial(self._count_loading_browsers, change=-1)])
        loaded.daemon = True
        loaded.start()

    def _count_loading_browsers(self, recording: Any, change: int) -> None:
        self._loading_browsers += change
        if self._header:
            self.send_header(recording, self._header)

    def _call(self, function: Callable[[Any], object] | None) -> None:
        """Put a function into the queue of the thread; None ends the thread."""
        if self._error is not None:
            raise self._error
        try:
            self._queue.put(function, timeout=STALL_S)
        except Full:
            raise TimeoutError(f"it has taken no data for {STALL_S:g} s and the queue is full") from None

    def _disconnect(self) -> None:
        deadline = time.monotonic() + CLOSE_S
        self._call(lambda recording: recording.disconnect())
        self._call(None)
        self._thread.join(max(0.0, deadline - time.monotonic()))
        if self._error is not None:
            raise self._error
        if self._thread.is_alive():
            raise TimeoutError(f"it has not taken the last data within {CLOSE_S:g} s")

    def _work(self) -> None:
        while (function := self._queue.get()) is not None:
            try:
                function(self.recording)
            except Exception as error:
                self._error = error
                return


@cache
def exit_in_time() -> None:
    """Set a deadline for Rerun's last flush when the interpreter exits; by default it has none."""

    def shut_down() -> None:
        deadline_s = STALL_S if _STALLED else CLOSE_S
        flush = Thread(target=rr.rerun_shutdown, daemon=True)
        flush.start()
        flush.join(deadline_s)
        if _STALLED or flush.is_alive():
            # A flush that hangs holds a lock, and freeing any other recording would wait for that lock.
            rr.RecordingStream.__del__ = keep_native  # type: ignore[method-assign]

    rr.unregister_shutdown()
    atexit.register(shut_down)


class Live:
    """The live recording of a run, served on free ports of 127.0.0.1.

    Viewers can connect at any time; they get the history first.

    Args:
        mode: "serve", or "spawn" to start Rerun's native viewer as well.
        exhibits: whether to serve an exhibition too. It has a server of its own, because a server that
            reaches its memory limit drops the oldest rows, whatever they belong to.
    """

    def __init__(
        self,
        mode: str,
        recording_id: str,
        blueprint: Any,
        *,
        period_s: float,
        application: str = RUN_APPLICATION,
        exhibits: bool = False,
    ) -> None:
        checked("live", mode, Served)
        exit_in_time()

        def serve(name: str, memory: str, *, send_properties: bool) -> LiveStream:
            recording = _new_recording(application, recording_id, send_properties=send_properties)
            # Both servers send the layout: a viewer may connect to either first.
            sources.append(_serve(recording, memory, blueprint))
            return LiveStream(name, recording, period_s=period_s)

        sources: list[str] = []
        self.stream = serve("live view", _SERVER_MEMORY, send_properties=True)
        self.exhibition: LiveStream | None = None
        if exhibits:
            self.exhibition = serve("exhibition", _EXHIBITION_MEMORY, send_properties=False)
        self._page = WebViewer(*sources, opened=self.stream.show_loading)
        if mode == "spawn":
            _spawn(self._page.native)
        self.addresses = self._page.addresses

    def close(self) -> None:
        self.stream.close()
        if self.exhibition is not None:
            self.exhibition.close()
        self._page.close()


def open_file(
    recording_id: str, path: Path, blueprint: Any, *, period_s: float, application: str
) -> Stream | None:
    """Return a stream to a new file; warn and return None if the disk is almost full.

    On a full disk Rerun may wait forever for the layout to be written.
    """
    free = shutil.disk_usage(path.parent).free
    if free < _NEEDED_BYTES:
        _warn_that_run_continues(
            f"file {path}", f"{free:,} bytes are free there, {_NEEDED_BYTES:,} are needed"
        )
        return None
    recording = _new_recording(application, recording_id)
    try:
        recording.save(path, default_blueprint=blueprint)
    except UnicodeEncodeError:  # Rerun refuses folders whose name is not UTF-8; a descriptor's path is
        folder = os.open(path.parent, os.O_RDONLY)
        recording.save(f"/proc/self/fd/{folder}/{path.name}", default_blueprint=blueprint)
        os.close(folder)
    return Stream("file", recording, period_s=period_s)


def _serve(recording: Any, memory: str, blueprint: Any = None) -> str:
    """Serve a recording on a free port of this machine alone; return its address."""
    port = free_port()
    sink = rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=memory)
    recording.set_sinks(sink, default_blueprint=blueprint)
    return f"rerun+http://{LOCALHOST}:{port}/proxy"


@contextmanager
def served(files: Sequence[Path]) -> Iterator[WebViewer]:
    """Serve recordings from their files within the block.

    Rerun's own command would keep a core busy for as long as it serves a file. Viewers get the layout first,
    else they would make one of their own; then the newest header without a time, else they would show old
    headers as the present while they load the history.
    """
    exit_in_time()
    readable, complete = _readers_of(files)
    application = "cut"  # not that of runs, so that the layout which a viewer keeps for runs stays as it is
    recording_id = "cut"
    header = None
    layout = None
    if complete:
        newest, header = _newest_header(complete)
        store = newest.recordings()[0]
        application = store.application_id
        recording_id = store.recording_id
        for blueprint in newest.blueprints()[:1]:
            layout = StoredLayout(newest.stream(store=blueprint))
    recording = _new_recording(application, recording_id, send_properties=False)
    source = _serve(recording, _FILES_MEMORY, layout)
    stream = LiveStream("recording", recording, period_s=0.0, history_s=0.0)
    page = WebViewer(source, opened=stream.show_loading)
    try:
        if header is not None:
            stream.call(partial(stream.send_header, text=header))
        for path in readable:
            stream.call(methodcaller("log_file_from_path", path))
        yield page
    finally:
        page.close()
        stream.close()


def _readers_of(files: Sequence[Path]) -> tuple[list[Path], list[RrdReader]]:
    """Return the files that are recordings, and the readers of those that do not break off.

    Raises:
        ValueError: if no file is a recording.
    """
    readable = []
    complete = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the recording of a run that was killed has no footer
        for path in files:
            with suppress(RuntimeError):
                reader = RrdReader(path)  # raises if the file is no recording
                readable.append(path)
                reader.recordings()  # raises if the file breaks off; viewers get the part before the break
                complete.append(reader)
    if not readable:
        raise ValueError(f"no recording can be read of {', '.join(map(str, files))}")
    return readable, complete


def _newest_header(readers: Sequence[RrdReader]) -> tuple[RrdReader, str | None]:
    """Return the recording that has the newest header, and this header; None if no recording has one."""
    newest_step = -1
    newest_header = None
    newest_reader = readers[0]
    for reader in readers:
        for chunk in reader.stream().filter(content=f"/{HEADER}"):
            batch = chunk.to_record_batch()
            if "step" in batch.schema.names and batch["step"][-1].as_py() >= newest_step:
                newest_step = batch["step"][-1].as_py()
                newest_header = batch["TextDocument:text"][-1].as_py()[0]
                newest_reader = reader
    return newest_reader, newest_header


def _spawn(command: Sequence[str]) -> None:
    """Start Rerun's native viewer in its own process; warn if it cannot open."""
    if not has_display():
        _warn_that_run_continues(
            "viewer cannot open", "there is no display; open one of the addresses from elsewhere"
        )
        return
    try:
        subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        _warn_that_run_continues("viewer cannot be started", error)


def _warn_that_run_continues(failure: str, reason: object) -> None:
    warnings.warn(
        f"the Rerun {failure}: {reason}; the run continues without it", RuntimeWarning, stacklevel=3
    )


def _new_recording(application: str, recording_id: str, *, send_properties: bool = True) -> Any:
    recording = rr.RecordingStream(
        application,
        recording_id=legible(recording_id),
        send_properties=send_properties,
        batcher_config=rr.ChunkBatcherConfig(flush_num_rows=1),  # else columns overtake rows in Rerun's batch
    )
    recording.set_log_time_enabled(False)
    return recording
