"""CpuThreads: runs the rules on CPU threads, each of which plays its share of the worlds."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from math import prod
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.game import Game, output_forms
from cprl.commons.loops import Played, first_invalid, run_worlds, show_worlds
from cprl.commons.rules import RuleGroups
from cprl.commons.tables import Tables
from cprl.commons.world import empty_scratch, empty_worlds
from cprl.institutions.arrays import state_arrays
from cprl.institutions.law import new_law
from cprl.system.jit.compiled import compiled_for_cpu, machine_code, runs_plain
from cprl.system.memory import check_memory
from cprl.values import Range, checked
from cprl.values.array_types import Int64

MOST_THREADS: Final = 1024
"""The largest number of threads; no machine has so many cores."""
_CodeVariant = tuple[bool, ...]
"""What the machine code of rules depends on in a game: whether it lacks each group of rules, whether it lacks
institutions, and whether rules run as plain Python. All other types are the same in every game."""
RUN_CODE: Final[dict[_CodeVariant, Callable[..., None]]] = {}
SHOW_CODE: Final[dict[_CodeVariant, Callable[..., None]]] = {}
"""The machine code of `run_worlds` and of `show_worlds` for the games played so far, by variant.

It is called directly, without Numba's dispatcher. That inspects the types of about sixty arrays on every
call, which takes seven of the eight microseconds that a turn of one world needs."""
WORLDS_PER_THREAD = 512
"""The number of worlds that makes a further thread worthwhile: to start its share takes about 0.1 ms."""


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Return a pool of threads; a forked process gets a new one, since its process id is another."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cprl-{process}")


def check_worlds_fit(game: Game, worlds: int) -> None:
    """Raise a TooLargeError if the state of B worlds and the outputs of two turns do not fit into memory.

    Without this check, operating systems grant memory that they do not have, and kill the process without a
    message once it is written.
    """
    arrays = [*state_arrays(empty_worlds(game, 1), derived=True)]
    if game.institutions:
        arrays += state_arrays(new_law(game, 1), derived=True)
    state = sum(array.nbytes for _, array, _ in arrays)
    forms = output_forms(game, 1).values()
    output = sum(prod(shape) * np.dtype(dtype).itemsize for shape, dtype in forms)
    subject = f"worlds is {worlds:,}: the arrays of so many worlds"
    allowed = "fewer worlds or episodes at once, or a smaller map, window or number of agents"
    check_memory(subject, worlds * (state + 2 * output), allowed)


class CpuThreads:
    """A `Driver` that plays B worlds in numpy arrays, on CPU threads.

    Args:
        game: the game to play.
        worlds: the number of worlds B.
        threads: the number of threads; None for one per core, where there are enough worlds for each.

    Raises:
        TooLargeError: if the worlds do not fit into memory; raised before anything is allocated.
    """

    def __init__(self, game: Game, worlds: int, *, threads: int | None = None) -> None:
        if threads is not None:
            threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
        check_worlds_fit(game, worlds)
        most_useful = worlds if threads else -(-worlds // WORLDS_PER_THREAD)
        self.threads = min(threads or os.cpu_count() or 1, most_useful)
        self.tables: Tables = game.tables
        self._worlds = worlds
        lacks_group = (not getattr(game.rules, name) for name in RuleGroups._fields)
        self._variant: _CodeVariant = (*lacks_group, not game.institutions, runs_plain())
        self._scratch = [empty_scratch(game) for _ in range(self.threads)]

    def place(self, arrays: Any) -> Any:
        return arrays

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        return np.empty(shape, dtype)

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        return array.copy()

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        array[...] = values

    def first_invalid(self, actions: Int64, known: int) -> int:
        return int(compiled_for_cpu(first_invalid, inline=False)(actions.reshape(-1), known))

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """Do a task with all selected worlds; see `Driver.run`."""
        entry = RUN_CODE.get(self._variant)
        if entry is None:
            entry = RUN_CODE[self._variant] = machine_code(
                run_worlds, Played(*game), task, self._scratch[0], 0, self._worlds
            )
        if self.threads == 1:  # no partial function, which would take a tenth of a turn of one world
            entry(game, task, self._scratch[0], 0, self._worlds)
        else:
            self._share(partial(entry, game, task))

    def show(self, game: tuple[Any, ...]) -> None:
        """Draw the boards of the worlds; see `Driver.show`."""
        entry = SHOW_CODE.get(self._variant)
        if entry is None:
            entry = machine_code(show_worlds, game, self._scratch[0], 0, self._worlds)
            SHOW_CODE[self._variant] = entry
        self._share(partial(entry, game))

    def _share(self, run: Callable[..., None]) -> None:
        """Run a loop in all threads, each on its share of the worlds.

        The calling thread works on the last share. `run`: called with working memory and a range of worlds.
        """
        bounds = [self._worlds * thread // self.threads for thread in range(self.threads + 1)]
        *others, last_share = zip(self._scratch, bounds, bounds[1:], strict=False)
        shares = [_pool(os.getpid(), len(others)).submit(run, *share) for share in others]
        run(*last_share)
        for share in shares:
            share.result()
