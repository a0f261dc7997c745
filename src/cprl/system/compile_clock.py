"""CLOCK: whether code is being compiled right now, and how long compiling has taken in this process."""

import gc
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


_is_set_aside = False


def set_aside() -> None:
    """Makes the collector skip all that is there now, after a compilation.

    Compilation leaves millions of permanent objects. Python's collector would scan them again and again,
    which takes up to a third of a training.
    """
    global _is_set_aside
    gc.collect()
    gc.freeze()
    _is_set_aside = True


def free_earlier() -> None:
    """Before a training: frees an earlier one of this process during which code was compiled, and which was
    set aside with everything else. It looks at all objects once more, which takes half a second."""
    global _is_set_aside
    if not _is_set_aside:
        return
    with CLOCK.running():  # a late part of compiling
        gc.unfreeze()
        gc.collect()
        gc.freeze()
    _is_set_aside = False


@contextmanager
def cleared_up() -> Iterator[None]:
    """Around a training: frees what it leaves in reference cycles, such as replay buffers, which a process
    that goes on would keep. One during which code was compiled stays until the next, see `free_earlier`."""
    try:
        yield
    finally:
        if not _is_set_aside:
            gc.collect()
