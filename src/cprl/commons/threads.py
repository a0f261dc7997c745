"""CpuThreads: runs the compiled loops on CPU threads, each for its share of the worlds."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import ENTRIES, compiled_entry, rules_for_cpu
from cprl.commons.game import Game
from cprl.commons.loops import Loop, Played
from cprl.commons.tables import Tables
from cprl.commons.world import Actions, empty_scratch
from cprl.values import Range, checked

MOST_THREADS: Final = 1024
"""The largest number of threads; no machine has that many cores."""
WORLDS_PER_THREAD = 512
"""With fewer worlds another thread does not pay: starting its share takes about 0.1 ms."""


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """A pool of threads; the process id in the key gives a forked process its own pool."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cprl-{process}")


class CpuThreads:
    """A driver of B worlds in numpy arrays."""

    def __init__(self, game: Game, worlds: int, *, threads: int | None = None) -> None:
        if threads is not None:
            threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
        limit = threads or os.cpu_count() or 1
        self.threads = min(limit, worlds if threads else -(-worlds // WORLDS_PER_THREAD))
        self.tables: Tables = game.tables
        self._scratch = [empty_scratch(game) for _ in range(self.threads)]

    def place(self, arrays: Any) -> Any:
        return arrays

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        return np.empty(shape, dtype)

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        return array.copy()

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        array[...] = values

    def first_unknown(self, actions: Actions, known: int) -> int:
        return int(rules_for_cpu()["first_unknown"](actions.reshape(-1), known))

    def run(self, loop: Loop, game: tuple[Any, ...], argument: NDArray[Any]) -> None:
        """See `cprl.commons.batch.Driver`; the calling thread takes the last share."""
        size = len(argument)
        entry = ENTRIES[self.tables.further, game[3] is not None].get(loop)
        if entry is None:
            entry = compiled_entry(loop, (Played(*game), argument, self._scratch[0], 0, size))
        if self.threads == 1:
            entry(game, argument, self._scratch[0], 0, size)
            return
        bounds = [size * t // self.threads for t in range(self.threads + 1)]
        run = partial(entry, game, argument)
        *others, last_share = zip(self._scratch, bounds, bounds[1:], strict=False)
        pool = _pool(os.getpid(), self.threads - 1)
        shares = [pool.submit(run, scratch, first, last) for scratch, first, last in others]
        run(*last_share)
        for share in shares:
            share.result()
