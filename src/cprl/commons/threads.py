"""CpuThreads: runs the compiled loops on CPU threads, each on its share of the worlds."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import entry_for_cpu, rules_for_cpu
from cprl.commons.game import Game, output_shapes
from cprl.commons.loops import Loop
from cprl.commons.tables import Tables
from cprl.commons.world import Actions, StepOutput, Worlds, empty_scratch

WORLDS_PER_THREAD = 512
"""Fewer are not worth handing to another thread, which takes a tenth of a millisecond."""


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this very process; a fork makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"cprl-{process}")


class CpuThreads:
    """A driver of B worlds whose arrays are numpy arrays.

    Args:
        game: what is played.
        worlds: how many worlds B.
        threads: how many threads share them; None for all cores where it pays.
    """

    def __init__(self, game: Game, worlds: int, *, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"threads is {threads}; at least 1 is wanted, or None for all cores")
        most = threads or os.cpu_count() or 1
        self.threads = min(most, worlds if threads else -(-worlds // WORLDS_PER_THREAD))
        self.tables: Tables = game.tables
        self._wanted = tuple(output_shapes(game, worlds).values())
        self._output: StepOutput | None = None
        self._sheets = [
            empty_scratch(
                agents=game.agents,
                sites=len(game.map.sites),
                cells=self.tables.background.size,
                window=self.tables.window_cells.shape[1],
            )
            for _ in range(self.threads)
        ]

    def place(self, worlds: Worlds) -> Worlds:
        """The same arrays where this driver plays them."""
        return worlds

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """A new array, its entries undefined."""
        return np.empty(shape, dtype)

    def read(self, array: NDArray[Any]) -> NDArray[Any]:
        """A copy as a numpy array."""
        return array.copy()

    def write(self, array: NDArray[Any], values: NDArray[Any]) -> None:
        """Copies values of the same shape and type into an array."""
        array[...] = values

    def first_unknown(self, actions: Actions, known: int) -> int:
        """The index of the first action outside 0 .. known - 1 among all, or -1."""
        return int(rules_for_cpu()["first_unknown"](actions.reshape(-1), known))

    def run(
        self, loop: Loop, worlds: Worlds, what: NDArray[Any], output: StepOutput, *, vouched: bool = False
    ) -> None:
        """Runs a loop on all worlds; this thread takes the last share.

        Args:
            loop: which.
            worlds: how they stand.
            what: the loop's own argument.
            output: what it writes into.
            vouched: whether the caller knows that both are of the right form; otherwise they are checked.
        """
        if not vouched:
            self._check(what, output)
        size = worlds.step.shape[0]
        arguments = worlds, self.tables, what, output
        entry = entry_for_cpu(loop, *arguments, self._sheets[0], 0, size)
        if self.threads == 1:
            entry(*arguments, self._sheets[0], 0, size)
            return
        bounds = [size * t // self.threads for t in range(self.threads + 1)]
        *others, own = zip(self._sheets, bounds, bounds[1:], strict=False)
        pool = _pool(os.getpid(), self.threads - 1)
        shares = [pool.submit(entry, *arguments, *share) for share in others]
        entry(*arguments, *own)
        for share in shares:
            share.result()

    def _check(self, what: NDArray[Any], output: StepOutput) -> None:
        """The compiled loops do not look at what they are given, so this does; see `entry_for_cpu`."""
        if not what.flags.c_contiguous:
            raise ValueError(f"an array {what.dtype} {what.shape} is not contiguous; one that is is wanted")
        if output is self._output:
            return
        arrays: dict[str, NDArray[Any]] = output._asdict()
        for (name, array), (shape, dtype) in zip(arrays.items(), self._wanted, strict=True):
            if array.shape != shape or array.dtype != dtype or not array.flags.carray:
                raise ValueError(
                    f"told.{name} is {array.dtype} {array.shape}; "
                    f"wanted: {np.dtype(dtype)} {shape}, contiguous and writeable"
                )
        self._output = output
