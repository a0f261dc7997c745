"""Calls of the Rerun SDK that may wait for a viewer, with deadlines."""

import atexit
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from queue import Full, Queue
from threading import Thread
from typing import Final, TypeVar

from cprl.compat import end_recordings, keep_native

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
    """The result of a function, called in a thread that nothing waits for after the deadline.

    Raises:
        TimeoutError: if there is none after so many seconds; the thread goes on by itself.
        Exception: what the function raises.
    """
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
        """Queues a call; waits at most `STALL_S`.

        Raises:
            TimeoutError: if the queue is full.
            Exception: what an earlier call raised; the thread has then ended.
        """
        if self._error is not None:
            raise self._error
        try:
            self._queue.put(what, timeout=STALL_S)
        except Full:
            raise TimeoutError(f"it has taken no data for {STALL_S:g} s and the queue is full") from None

    def close(self) -> None:
        """Ends the thread when all calls are done; waits at most `CLOSE_S`.

        Raises:
            TimeoutError: if they are not done by then.
            Exception: what a call raised.
        """
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


def abandon(recording: object) -> None:
    """Keeps a recording whose viewer does not answer, so that nothing disconnects it and waits."""
    _ABANDONED.append(recording)


@cache
def exit_in_time() -> None:
    """Gives Rerun's own last flush, when the interpreter exits, a deadline; it has none of itself."""
    import rerun as rr

    def shutdown() -> None:
        with suppress(TimeoutError):
            within(STALL_S if _ABANDONED else CLOSE_S, rr.rerun_shutdown)
            if not _ABANDONED:
                return
        # A shutdown that waits holds a lock, for which the end of any other recording would wait.
        rr.RecordingStream.__del__ = keep_native  # type: ignore[method-assign]

    rr.unregister_shutdown()
    atexit.register(shutdown)
