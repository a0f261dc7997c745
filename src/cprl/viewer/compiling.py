"""CompilingNotice: while code is compiled, the header of the live view says so, and for how long."""

from collections.abc import Callable
from threading import Event, Thread
from typing import Final

from cprl.compile_clock import CLOCK

_PERIOD_S: Final = 1.0


class CompilingNotice:
    """Calls a function once a second while code is compiled, in a thread of its own, until it is stopped.

    Args:
        show: called with "compiling, 12 s so far", and with "begins" once nothing is compiled any more; from
            another thread.
    """

    def __init__(self, show: Callable[[str], object]) -> None:
        self._show, self._over = show, Event()
        self._before_s = CLOCK.total_s
        Thread(target=self._watch, daemon=True, name="cprl compiling").start()

    def stop(self) -> None:
        """Ends the thread; a second call does nothing."""
        self._over.set()

    def _watch(self) -> None:
        was_running = False
        while not self._over.wait(_PERIOD_S):
            if CLOCK.is_running:
                self._show(f"compiling, {CLOCK.total_s - self._before_s:.0f} s so far")
            elif was_running:
                self._show("begins")
            was_running = CLOCK.is_running
