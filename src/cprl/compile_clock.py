"""CLOCK: whether code is being compiled right now, and how long compiling has taken in this process."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final


class CompileClock:
    """Counts the seconds in which the rules (Numba) and updates (torch) are compiled.

    Compilations run in the training's thread; other threads may read the clock.
    """

    def __init__(self) -> None:
        self._spent_s = 0.0
        self._began: float | None = None

    @contextmanager
    def running(self) -> Iterator[None]:
        """Counts the time that the block takes; a block within a block counts once."""
        if self._began is not None:
            yield
            return
        self._began = time.perf_counter()
        try:
            yield
        finally:
            self._spent_s, self._began = self.total_s, None

    @property
    def is_running(self) -> bool:
        """Whether code is being compiled."""
        return self._began is not None

    @property
    def total_s(self) -> float:
        """Seconds of all compilations so far, the one under way included."""
        began = self._began
        return self._spent_s + (0.0 if began is None else time.perf_counter() - began)


CLOCK: Final = CompileClock()
"""Of this process."""
