"""The streams of one recording, to a file or to viewers, each of which may fail without harm to the run."""

import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, TypeAlias

from cprl.viewer.deadline import Sender, abandon

FLUSH_TIMEOUT_S: Final = 5.0

_KEEPS_UP: Final = 1
"""The number of calls that may wait for viewers that keep up."""


Row: TypeAlias = tuple[int, int, int, list[float] | str]
"""Step, episode, frame, and a number for each line or a Markdown text."""

Waiting: TypeAlias = dict[str, list[Row]]
"""Numbers and texts by entity."""


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
    def is_behind(self) -> bool:
        """Whether viewers do not keep up, so that what can be left out should be."""
        return False

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
            stacklevel=5,
        )


class LiveStream(Stream):
    """A stream to viewers. Its calls are made in a thread of its own, because a viewer that stands still, or
    accepts a connection and never reads, makes them wait forever; see `cprl.viewer.deadline`.
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
        abandon(self.recording)
        super()._fail(error)


class Streams:
    """Those of one recording: to its file, and to viewers."""

    def __init__(self) -> None:
        self._each: list[Stream] = []

    def add(self, stream: Stream | None) -> None:
        """Adds a stream; None adds nothing."""
        self._each += [] if stream is None else [stream]

    def __iter__(self) -> Iterator[Stream]:
        return iter(self._each)

    @property
    def recordings(self) -> list[Any]:
        """The `rerun.RecordingStream` of each."""
        return [each.recording for each in self._each]

    @property
    def is_live(self) -> bool:
        """Whether there is a stream to viewers."""
        return any(isinstance(each, LiveStream) for each in self._each)

    @property
    def is_open_live(self) -> bool:
        """Whether a stream to viewers is neither closed nor failed."""
        return any(isinstance(each, LiveStream) and each.recording is not None for each in self._each)

    def do(self, what: Callable[[Any], object], *, live_only: bool = False) -> None:
        """Calls a function with each recording, or with that to viewers alone, in the thread that sends."""
        for each in self._each:
            if isinstance(each, LiveStream) or not live_only:
                each.do(what)

    def hold(self, name: str, row: Row) -> list[Stream]:
        """Buffers a row of an entity; returns the streams whose buffers are to be sent now."""
        for each in self._each:
            each.waiting.setdefault(name, []).append(row)
        return [each for each in self._each if each.is_due]

    def close(self, *, live: bool = True) -> None:
        """Closes all, or all but those to viewers."""
        for each in self._each:
            if live or not isinstance(each, LiveStream):
                each.close()
