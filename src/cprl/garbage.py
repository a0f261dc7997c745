"""Garbage: what Python's collector of reference cycles need not look at, and what a training leaves behind."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

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


@contextmanager
def cleared_up() -> Iterator[None]:
    """Around a training: frees what this one and those before leave in reference cycles, such as replay
    buffers, which a process that goes on would keep.

    A training during which code was compiled has been set aside with everything else. It is freed when the
    next one begins, because looking at all objects takes a second.
    """
    global _is_set_aside
    if _is_set_aside:
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        _is_set_aside = False
    try:
        yield
    finally:
        if not _is_set_aside:
            gc.collect()
