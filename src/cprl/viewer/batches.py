"""Rows as columns: numbers and texts that wait for their batch, and the timelines of each row."""

from collections.abc import Iterable, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.compat import send_chunk
from cprl.viewer.sending import FLUSH_TIMEOUT_S, LiveStream, Stream

TIMELINES: Final = ("step", "episode", "frame")
"""The timelines of every row: environment steps of the run, episodes, and frames recorded so far."""

Numbers: TypeAlias = "Sequence[int] | NDArray[np.integer[Any]]"


def times(steps: Numbers, episodes: Numbers, frames: Numbers) -> list[Any]:
    """The timelines of each row."""
    import rerun as rr

    return [
        rr.TimeColumn(name, sequence=np.asarray(numbers, np.int64))
        for name, numbers in zip(TIMELINES, (steps, episodes, frames), strict=True)
    ]


def components(columns: Iterable[Any]) -> dict[Any, Any]:
    """Columns of an archetype as `cprl.compat.send_chunk` takes them."""
    return {own.component_descriptor(): own.as_arrow_array() for own in columns}


def timelines(at: Iterable[Any]) -> dict[str, Any]:
    """`times` as `cprl.compat.send_chunk` takes them."""
    return {own.timeline_name(): own.as_arrow_array() for own in at}


def log_now(recording: Any, name: str, what: Any, now: tuple[int, int, int]) -> None:
    """Logs one row that has no columns, such as a tensor, at a (step, episode, frame)."""
    for timeline, number in zip(TIMELINES, now, strict=True):
        recording.set_time(timeline, sequence=number)
    recording.log(name, what)
    recording.reset_time()


def send_waiting(stream: Stream) -> None:
    """Sends the buffered numbers and texts of one stream, one chunk per entity.

    Of texts viewers get the newest alone, by `send_text`. Files keep each with its time: of static texts in
    several files of one recording a viewer shows the one that it loads last.
    """
    waiting = stream.take()

    def send(recording: Any) -> None:
        known: dict[Any, dict[str, Any]] = {}  # most names have the same times
        for name, rows in waiting.items():
            *at, values = zip(*rows, strict=True)
            if isinstance(stream, LiveStream) and isinstance(values[-1], str):
                send_text(recording, name, values[-1])
                continue
            if tuple(at) not in known:
                known[tuple(at)] = timelines(times(*at))
            send_chunk(recording, name, known[tuple(at)], components(_columns(values)))
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)

    stream.do(send)


def send_text(recording: Any, name: str, text: str) -> None:
    """Sends a Markdown text without a time, which takes the place of the one before at all times.

    A server sends it before the history, so who connects late never reads an old one as the present.
    """
    import rerun as rr

    send_chunk(recording, name, {}, components(rr.TextDocument.columns(text=[text])))


def _columns(values: Sequence[Any]) -> Any:
    """Markdown texts, or equally many numbers in each row."""
    import rerun as rr

    if isinstance(values[0], str):
        return rr.TextDocument.columns(text=list(values))
    return rr.Scalars.columns(scalars=np.concatenate(values)).partition([len(own) for own in values])
