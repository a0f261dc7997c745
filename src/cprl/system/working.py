"""Say on standard error what the process does, if it takes more than a second.

On a terminal and in a notebook this is one line, which is overwritten and vanishes; elsewhere a line every
two seconds. Nothing is printed within the first second, or while another progress bar is shown.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition, Thread, get_ident
from typing import Final

from cprl.system.output import ERR, LINE

FIRST_S: Final = 0.8
"""Seconds before the first line."""
PERIOD_S: Final = 2.0
"""Seconds from one line to the next."""
LINE_PERIOD_S: Final = 0.25
"""Seconds between updates of a line that is overwritten."""


class Work:
    """A piece of work that may take a while.

    Args:
        what: what is done, e.g. "playing an episode".
        before_s: seconds that it took before.
    """

    def __init__(self, what: str, *, before_s: float = 0.0) -> None:
        self.what = what
        self._began = time.monotonic() - before_s
        self.thread = get_ident()
        self.counted: tuple[int, int | None, str] | None = None
        """The count so far, the total if it is known, and the unit."""

    def __str__(self) -> str:
        if self.counted is None:
            return f"{self.what}, {time.monotonic() - self._began:.0f} s so far"
        done, of, unit = self.counted
        return f"{self.what}, {done:,}{'' if of is None else f' of {of:,}'} {unit}"


_works: Final[list[Work]] = []
"""The work in progress, each part of the one before it."""
_spells: Final[list[object]] = []
"""A marker of the current spell of work, from its first piece to its last."""
_silences: Final[list[object]] = []
"""The open blocks that show a progress bar of their own."""
_changed: Final = Condition()


@contextmanager
def working(what: str, *, before_s: float = 0.0) -> Iterator[Work]:
    """Say what the block does once it takes a second; also a decorator. See `Work`."""
    work = Work(what, before_s=before_s)
    try:
        with _changed:
            _works.append(work)
            if not _spells:
                spell = object()
                _spells.append(spell)
                Thread(target=_say_now_and_then, args=(spell,), daemon=True, name="cprl working").start()
        yield work
    finally:
        with _changed:
            if work in _works:
                _works.remove(work)
            if not _works:
                _spells.clear()
                LINE.erase()
                _changed.notify_all()


@contextmanager
def silent() -> Iterator[None]:
    """Say nothing in the block, which shows its own progress."""
    silence = object()
    with _changed:
        _silences.append(silence)
        LINE.erase()
    try:
        yield
    finally:
        with _changed:
            _silences.remove(silence)


def note_progress(done: int, of: int | None, unit: str) -> None:
    """Note the progress of the innermost work of this thread, if there is any: "412 of 1,000 turns"."""
    for work in reversed(_works):
        if work.thread == get_ident():
            work.counted = done, of, unit
            return


def progress_line() -> str:
    """Return the work in progress as one line; "" for none."""
    if not _works:
        return ""
    last = _works[-1]
    if last.counted is None:
        return str(last)
    return ": ".join(str(work) for work in _works if work.counted is not None)


def _say_now_and_then(spell: object) -> None:
    """Say what is in progress, again and again, until nothing is."""
    wait_s = FIRST_S
    with _changed:
        while not _changed.wait_for(lambda: spell not in _spells, wait_s):
            wait_s = LINE_PERIOD_S if LINE.is_over_written else PERIOD_S
            if _silences:
                continue
            if LINE.is_over_written:
                LINE.show(progress_line())
            else:
                ERR.write(f"{progress_line()}\n")
                ERR.flush()
