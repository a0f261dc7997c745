"""One recording stream, to a file or to viewers, that may fail without harm to the run."""

import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Final, TypeAlias

from cprl.viewer.deadline import Sender, abandon

FLUSH_TIMEOUT_S: Final = 5.0

_KEEPS_UP: Final = 8
"""The number of calls that may wait for viewers that keep up."""


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
            stacklevel=4,
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
