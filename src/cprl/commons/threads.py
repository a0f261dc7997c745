"""CpuThreads: runs the compiled loops on CPU threads, each for its share of the worlds."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from math import prod
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import compiled_for_cpu, machine_code, runs_plain
from cprl.commons.game import Game, output_forms
from cprl.commons.loops import Played, first_unknown, run_worlds, show_worlds
from cprl.commons.rules import Groups
from cprl.commons.tables import Tables
from cprl.commons.world import empty_scratch, empty_worlds
from cprl.institutions.arrays import lasting
from cprl.institutions.law import new_law
from cprl.system.memory import check_memory
from cprl.values import Range, checked
from cprl.values.arrays import Int64

MOST_THREADS: Final = 1024
"""The largest number of threads; no machine has that many cores."""
Kind = tuple[bool, ...]
"""Whether a game lacks each group of rules, and institutions, and whether rules run as plain Python: what the
code of rules depends on. All other types are the same in every game: the fields of `Worlds`, `Tables`,
`StepOutput` and `Scratch` have fixed types."""
RUN: Final[dict[Kind, Callable[..., None]]] = {}
SHOW: Final[dict[Kind, Callable[..., None]]] = {}
"""The machine code of `run_worlds` and `show_worlds`, as far as it was asked for.

It is called directly: Numba's dispatcher inspects the types of about sixty arrays on every call, which takes
seven of the eight microseconds that one world needs. A direct call inspects nothing."""
WORLDS_PER_THREAD = 512
"""With fewer worlds another thread does not pay: starting its share takes about 0.1 ms."""


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Return a pool of threads; the process id in the key gives a forked process its own pool."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cprl-{process}")


def check_worlds_fit(game: Game, worlds: int) -> None:
    """Raise a TooLargeError if B worlds do not fit into memory: their state, and the outputs of two turns.

    Systems grant memory that they do not have, and kill the process without a word once it is written.
    """
    remembered = empty_worlds(game, 1), *((new_law(game, 1),) if game.institutions else ())
    state = sum(array.nbytes for arrays in remembered for _, array, _ in lasting(arrays, derived=True))
    forms = output_forms(game, 1).values()
    output = sum(prod(shape) * np.dtype(dtype).itemsize for shape, dtype in forms)
    what = f"worlds is {worlds:,}: the arrays of so many worlds"
    instead = "fewer worlds or episodes at once, or a smaller map, window or number of agents"
    check_memory(what, worlds * (state + 2 * output), instead)


class CpuThreads:
    """A driver of B worlds in numpy arrays.

    Raises:
        TooLargeError: if the worlds do not fit into memory; raised before anything is allocated.
    """

    def __init__(self, game: Game, worlds: int, *, threads: int | None = None) -> None:
        if threads is not None:
            threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
        check_worlds_fit(game, worlds)
        limit = threads or os.cpu_count() or 1
        self.threads = min(limit, worlds if threads else -(-worlds // WORLDS_PER_THREAD))
        self.tables: Tables = game.tables
        self._worlds = worlds
        groups = (getattr(game.rules, name) is None for name in Groups._fields)
        self._kind: Kind = (*groups, not game.institutions, runs_plain())
        self._scratch = [empty_scratch(game) for _ in range(self.threads)]

    def place(self, arrays: Any) -> Any:
        return arrays

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        return np.empty(shape, dtype)

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        return array.copy()

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        array[...] = values

    def first_unknown(self, actions: Int64, known: int) -> int:
        return int(compiled_for_cpu(first_unknown, inline=False)(actions.reshape(-1), known))

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """See `cprl.commons.batch.Driver`."""
        entry = RUN.get(self._kind)
        if entry is None:
            entry = RUN[self._kind] = machine_code(
                run_worlds, Played(*game), task, self._scratch[0], 0, self._worlds
            )
        if self.threads == 1:  # without a partial function, which takes a tenth of a turn of one world
            entry(game, task, self._scratch[0], 0, self._worlds)
        else:
            self._share(partial(entry, game, task))

    def show(self, game: tuple[Any, ...]) -> None:
        """See `cprl.commons.batch.Driver`."""
        entry = SHOW.get(self._kind)
        if entry is None:
            entry = SHOW[self._kind] = machine_code(show_worlds, game, self._scratch[0], 0, self._worlds)
        self._share(partial(entry, game))

    def _share(self, run: Callable[..., None]) -> None:
        """Run a loop in all threads, each on its share of the worlds; the calling thread takes the last
        one."""
        bounds = [self._worlds * t // self.threads for t in range(self.threads + 1)]
        *others, last_share = zip(self._scratch, bounds, bounds[1:], strict=False)
        shares = [_pool(os.getpid(), len(others)).submit(run, *share) for share in others]
        run(*last_share)
        for share in shares:
            share.result()
