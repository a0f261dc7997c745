"""Garbage: what Python's collector of cycles need not look at, and what a training leaves behind."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

from cprl.compile_clock import CLOCK

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
