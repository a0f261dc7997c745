"""The streams of one recording, to a file and to viewers: each may fail without harm to the run."""

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

from cprl.system.compat import StoredLayout, keep_native
from cprl.system.output import legible
from cprl.values import checked
from cprl.viewer.names import HEADER
from cprl.viewer.page import LOCALHOST, Served, WebViewer, free_port, has_display, viewer

STALL_S: Final = 2.0
"""Seconds that a training waits for a place in the queue of a viewer that has stopped taking data."""
CLOSE_S: Final = 5.0
"""Seconds within which a viewer must take the last data when a run ends, and when the interpreter exits."""
QUEUED_CALLS: Final = 256
"""Calls that wait for a viewer; the frames of about thirty episodes."""
FLUSH_TIMEOUT_S: Final = 5.0

RUN, REPLAY = "cprl", "cprl replay"
"""The application ids of runs and of replays: a viewer keeps one layout for each. Recordings of a run that is
resumed must have that of its first one."""
SERVER_MEMORY: Final = "512MB"
"""The memory limit of the served recording; beyond it viewers lose the oldest rows, the file does not."""
EXHIBITION_MEMORY: Final = "1MB"
"""The same of the exhibition, of which viewers need the newest frame alone."""
FILES_MEMORY: Final = "75%"
"""The same of recordings that are served from their files: all of them, while memory lasts."""
NEEDED_BYTES: Final = 2_000_000
"""The free disk space needed to start a recording; its layout and static parts take a tenth."""

HISTORY_S: Final = 60.0
"""The age of a live recording from which browsers may take a while to read it."""
LOADING_S: Final = 20.0
"""Seconds from when a browser opens the page until it reads the recording, about."""

_STALLED: Final[list[Any]] = []
"""Recordings whose viewers do not answer: the end of the last reference to one would wait for them."""

Row: TypeAlias = tuple[int, int, int, list[float] | str]
"""Step, episode, frame, and a number for each line or a Markdown text."""


class Stream:
    """One recording stream. If it fails, it warns once, and the run continues without it."""

    is_live = False
    """Whether it is sent to viewers."""

    def __init__(self, name: str, recording: Any, *, period_s: float) -> None:
        self.name = name
        self.recording = recording
        self.period_s = period_s
        self.is_open = True
        self.has_failed = False
        self.waiting: dict[str, list[Row]] = {}
        """Numbers and texts that have not been sent, by entity."""
        self._sent = time.perf_counter()

    @property
    def is_due(self) -> bool:
        return time.perf_counter() - self._sent > self.period_s

    def take(self) -> dict[str, list[Row]]:
        """Return the buffered numbers; the buffer is empty afterwards."""
        taken = self.waiting
        self.waiting = {}
        self._sent = time.perf_counter()
        return taken

    def do(self, what: Callable[[Any], object]) -> None:
        """Call a function with the recording, unless the stream has failed or is closed."""
        if self.is_open:
            self._try(partial(self._call, what))

    def close(self) -> None:
        """Disconnects; the file gets its footer. A second call does nothing."""
        if self.is_open:
            self._try(self._disconnect)
            self.is_open = False

    def _try(self, what: Callable[[], object]) -> None:
        try:
            what()
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

    def _call(self, what: Callable[[Any], object]) -> None:
        what(self.recording)

    def _disconnect(self) -> None:
        self.recording.disconnect()


class LiveStream(Stream):
    """A stream to viewers. Its calls are made in a thread of its own, because a viewer that stands still, or
    accepts a connection and never reads, makes them wait for half a minute.

    Args:
        history_s: the age from which browsers that open it read in its header that history loads.
    """

    is_live = True

    def __init__(self, name: str, recording: Any, *, period_s: float, history_s: float = HISTORY_S) -> None:
        super().__init__(name, recording, period_s=period_s)
        self._header = ""
        self._loading = 0
        self._has_history_from = time.perf_counter() + history_s
        self._queue: Queue[Callable[[Any], object] | None] = Queue(QUEUED_CALLS)
        self._error: Exception | None = None
        self._thread = Thread(target=self._work, daemon=True, name="cprl viewer")
        self._thread.start()

    @property
    def is_behind(self) -> bool:
        """Whether calls wait that viewers have not taken, so that what can be left out should be."""
        return self._queue.qsize() > 1

    def say(self, recording: Any, name: str, text: str) -> None:
        """Send a Markdown text without a time, which takes the place of the one before at all times; to be
        called with `do`.

        A server sends it before the history, so who connects late never reads an old one as the present.
        """
        if name == HEADER:
            self._header = text
            mark, _, words = text.partition(" ")
            text = f"{mark} History loads · {words}" if self._loading else text
        recording.send_columns(name, [], rr.TextDocument.columns(text=[text]))

    def opened(self) -> None:
        """Note that a browser has opened the page. It reads the newest header first, then the history, then
        what is sent from now on: the header says that history loads until it is sent again."""
        if time.perf_counter() < self._has_history_from:
            return

        def load(recording: Any, change: int) -> None:
            self._loading += change
            if self._header:
                self.say(recording, HEADER, self._header)

        self.do(partial(load, change=1))
        loaded = Timer(LOADING_S, self.do, [partial(load, change=-1)])
        loaded.daemon = True
        loaded.start()

    def _call(self, what: Callable[[Any], object] | None) -> None:
        if self._error is not None:
            raise self._error
        try:
            self._queue.put(what, timeout=STALL_S)
        except Full:
            raise TimeoutError(f"it has taken no data for {STALL_S:g} s and the queue is full") from None

    def _disconnect(self) -> None:
        ends = time.monotonic() + CLOSE_S
        self._call(lambda recording: recording.disconnect())
        self._call(None)
        self._thread.join(max(0.0, ends - time.monotonic()))
        if self._error is not None:
            raise self._error
        if self._thread.is_alive():
            raise TimeoutError(f"it has not taken the last data within {CLOSE_S:g} s")

    def _work(self) -> None:
        while (what := self._queue.get()) is not None:
            try:
                what(self.recording)
            except Exception as error:
                self._error = error
                return


@cache
def exit_in_time() -> None:
    """Give Rerun's own last flush, when the interpreter exits, a deadline; it has none of itself."""

    def shut_down() -> None:
        flush = Thread(target=rr.rerun_shutdown, daemon=True)
        flush.start()
        flush.join(STALL_S if _STALLED else CLOSE_S)
        if _STALLED or flush.is_alive():
            # A flush that waits holds a lock, for which the end of any other recording would wait.
            rr.RecordingStream.__del__ = keep_native  # type: ignore[method-assign]

    rr.unregister_shutdown()
    atexit.register(shut_down)


class Live:
    """What viewers of a run are sent, served on free ports of 127.0.0.1; they can connect at any time and get
    the history.

    Args:
        mode: "serve", or "spawn" to start Rerun's native viewer as well.
        exhibits: whether there is an exhibition, which has a server of its own, since a server that has used
            its memory drops the oldest rows of all.
    """

    def __init__(
        self,
        mode: str,
        recording_id: str,
        blueprint: Any,
        *,
        period_s: float,
        application: str = RUN,
        exhibits: bool = False,
    ) -> None:
        checked("live", mode, Served)
        exit_in_time()

        def serve(name: str, memory: str, *, send_properties: bool) -> LiveStream:
            recording = _recording(application, recording_id, send_properties=send_properties)
            # The layout is in both: a viewer may hear of the recording from either first.
            sources.append(_serve(recording, memory, blueprint))
            return LiveStream(name, recording, period_s=period_s)

        sources: list[str] = []
        self.stream = serve("live view", SERVER_MEMORY, send_properties=True)
        self.exhibition: LiveStream | None = None
        if exhibits:
            self.exhibition = serve("exhibition", EXHIBITION_MEMORY, send_properties=False)
        if mode == "spawn":
            _spawn(sources)
        self._page = WebViewer(*sources, opened=self.stream.opened)
        self.addresses = self._page.addresses

    def close(self) -> None:
        self.stream.close()
        if self.exhibition is not None:
            self.exhibition.close()
        self._page.close()


def open_file(
    recording_id: str, path: Path, blueprint: Any, *, period_s: float, application: str = RUN
) -> Stream | None:
    """Return a stream to a new file; None, with a warning, if the disk is almost full.

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


def _serve(recording: Any, memory: str, blueprint: Any = None) -> str:
    """Serve a recording on a free port of this machine alone; return its address."""
    port = free_port()
    sink = rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=memory)
    recording.set_sinks(sink, default_blueprint=blueprint)
    return f"rerun+http://{LOCALHOST}:{port}/proxy"


@contextmanager
def served(files: Sequence[Path]) -> Iterator[WebViewer]:
    """Serve recordings within the block. (Rerun's own command keeps a core busy as long as it serves a file.)

    Viewers get the layout first, else they make one of their own; then the newest header as static data:
    while they load the history they would show old ones as the present.
    """
    exit_in_time()
    recordings = []
    readers = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the recording of a run that was killed has no footer
        for path in files:
            with suppress(RuntimeError):
                reader = RrdReader(path)  # fails where it is none
                recordings.append(path)
                reader.recordings()  # fails where it is cut; viewers get what is before that
                readers.append(reader)
        if not recordings:
            raise ValueError(f"no recording can be read of {', '.join(map(str, files))}")
        # Without one that is whole: a name of its own leaves viewers of "cprl" the layout in the file.
        application = "cut"
        recording_id = "cut"
        header = None
        layout = None
        if readers:
            reader, header = _newest_header(readers)
            store = reader.recordings()[0]
            application = store.application_id
            recording_id = store.recording_id
            layout = next((StoredLayout(reader.stream(store=stored)) for stored in reader.blueprints()), None)
    recording = _recording(application, recording_id, send_properties=False)
    source = _serve(recording, FILES_MEMORY, layout)
    stream = LiveStream("recording", recording, period_s=0.0, history_s=0.0)
    page = WebViewer(source, opened=stream.opened)
    try:
        if header is not None:
            stream.do(partial(stream.say, name=HEADER, text=header))
        for path in recordings:
            stream.do(methodcaller("log_file_from_path", path))
        yield page
    finally:
        page.close()
        stream.close()


def _newest_header(readers: Sequence[RrdReader]) -> tuple[RrdReader, str | None]:
    """Return the recording that has the newest header, and the header; None if none has one."""
    step = -1
    header = None
    newest = readers[0]
    for reader in readers:
        for chunk in reader.stream().filter(content=f"/{HEADER}"):
            batch = chunk.to_record_batch()
            if "step" in batch.schema.names and batch["step"][-1].as_py() >= step:
                step = batch["step"][-1].as_py()
                header = batch["TextDocument:text"][-1].as_py()[0]
                newest = reader
    return newest, header


def _spawn(sources: list[str]) -> None:
    """Start Rerun's native viewer in its own process; warn if it cannot open."""
    if not has_display():
        _warn_of("viewer cannot open", "there is no display; open one of the addresses from elsewhere")
        return
    try:
        subprocess.Popen(
            [viewer(), "--connect", *sources],
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
