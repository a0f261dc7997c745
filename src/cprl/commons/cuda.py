"""CudaThreads: runs the rules with numba-cuda, one GPU thread per world.

With NUMBA_ENABLE_CUDASIM=1 Numba simulates all of this without a GPU: slowly, as a check.
"""

from collections.abc import Callable
from functools import cache
from math import isfinite
from types import FunctionType
from typing import Any, Final

import numba.cuda
import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import compiled
from cprl.commons.game import Game, check_worlds_fit
from cprl.commons.loops import ENTRIES, LOOPS, Loop, one_scratch
from cprl.commons.tables import GovernedTables, Tables
from cprl.commons.world import (
    Actions,
    Arrays,
    Governed,
    GovernedOutput,
    Scratch,
    StepOutput,
    Worlds,
    empty_scratch,
)
from cprl.institutions.memory import InstitutionTables

cuda: Any = numba.cuda

THREADS_PER_BLOCK: Final = 64

NONE_UNKNOWN: Final = 2**62
"""The initial result of the search for unknown actions: larger than any index."""


class CudaThreads:
    """A driver of B worlds in Numba arrays on the current GPU.

    Worlds and scratch memory are stored with the axis B innermost, so that neighbouring threads read
    neighbouring words. Step outputs are stored row-major, as in torch.

    Args:
        game: The game.
        worlds: The number of worlds B.

    Raises:
        ValueError: If Numba finds no GPU.
        MemoryError: If the worlds do not fit into its memory.
    """

    def __init__(self, game: Game, worlds: int) -> None:
        if not cuda.is_available():
            raise ValueError(
                "Numba finds no GPU; it needs NVIDIA's driver and the package numba-cuda "
                "(install cprl[cuda12] or cprl[cuda13])"
            )
        check_worlds_fit(game, worlds, free=_free_bytes())
        self.threads = worlds
        self.tables = Tables(*(_constant(entry) for entry in game.tables))
        self.governed_tables: GovernedTables | None = None
        if game.institutions:
            own = game.governed_tables.institutions
            self.governed_tables = GovernedTables(
                self.tables, InstitutionTables(*(_constant(entry) for entry in own))
            )
        scratch = empty_scratch(
            agents=game.agents,
            sites=len(game.map.sites),
            cells=game.tables.background.size,
            window=game.tables.window_cells.shape[1],
        )
        self._scratch = Scratch(*(_worlds_innermost((worlds, *each.shape), each.dtype) for each in scratch))
        self._unknown = cuda.to_device(np.full(1, NONE_UNKNOWN, np.int64))

    def place(self, arrays: Arrays) -> Arrays:
        """Copies the arrays of `Worlds` or `Memory` to the GPU."""
        return type(arrays)(*(cuda.to_device(np.asfortranarray(array)) for array in arrays))

    def wrap(self, memory: Any) -> NDArray[Any]:
        """A Numba array on GPU memory of another owner, such as a torch tensor; shares the memory."""
        array: NDArray[Any] = cuda.as_cuda_array(memory)
        return array

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """A new array with undefined entries."""
        array: NDArray[Any] = cuda.device_array(shape, dtype)
        return array

    def read(self, array: Any) -> NDArray[Any]:
        """A copy as a numpy array."""
        return np.ascontiguousarray(array.copy_to_host())

    def write(self, array: Any, values: NDArray[Any]) -> None:
        """Copies values of the same shape and dtype into an array."""
        array.copy_to_device(np.asfortranarray(values))

    def first_unknown(self, actions: Actions, known: int) -> int:
        """The index, in row-major order, of the first action outside 0 .. known - 1; -1 if there is none."""
        self._unknown.copy_to_device(np.full(1, NONE_UNKNOWN, np.int64))
        kernels()["find_unknown"][_blocks(len(actions)), THREADS_PER_BLOCK](actions, known, self._unknown)
        at = int(self._unknown.copy_to_host()[0])
        return -1 if at == NONE_UNKNOWN else at

    def run(
        self,
        loop: Loop,
        worlds: Worlds | Governed,
        argument: NDArray[Any],
        output: StepOutput | GovernedOutput,
        *,
        checked: bool = False,
    ) -> None:
        """Starts a loop over all worlds on the default stream and returns before it has finished.

        Args:
            loop: The loop.
            worlds: The state of the worlds; `Governed` for the loops of games with institutions.
            argument: The loop's own argument.
            output: The arrays that the loop writes.
            checked: Ignored; see `CpuThreads.run`.
        """
        kernel = kernels()[loop][_blocks(len(argument)), THREADS_PER_BLOCK]
        tables = self.governed_tables if isinstance(worlds, Governed) else self.tables
        kernel(worlds, tables, argument, output, self._scratch)


@cache
def kernels() -> dict[str, Any]:
    """The kernels by name: one for each loop, and `find_unknown`; compiled at their first launch."""
    rules = compiled((*ENTRIES, one_scratch), _jit_for_gpu)
    launched: dict[str, Any] = {loop: _kernel(rules[loop], rules["one_scratch"]) for loop in LOOPS}
    return {**launched, "find_unknown": _find_unknown(rules["first_unknown"])}


def _jit_for_gpu(function: FunctionType) -> Callable[..., Any]:
    return cuda.jit(device=True)(function)


def _kernel(loop: Callable[..., None], one_scratch: Callable[..., Scratch]) -> Callable[..., Any]:
    """Thread b runs the loop on world b alone."""

    @cuda.jit
    def kernel(worlds, tables, argument, output, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < argument.shape[0]:
            loop(worlds, tables, argument, output, one_scratch(scratch, b), b, b + 1)

    launched: Callable[..., Any] = kernel
    return launched


def _find_unknown(first_unknown: Callable[..., int]) -> Callable[..., Any]:
    """Thread b checks the actions of world b."""

    @cuda.jit
    def kernel(actions, known, found):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < actions.shape[0]:
            at = first_unknown(actions[b], known)
            if at >= 0:
                cuda.atomic.min(found, 0, b * actions.shape[1] + at)

    launched: Callable[..., Any] = kernel
    return launched


def _constant(entry: Any) -> Any:
    """Copies an array of the tables to the GPU; returns a number unchanged."""
    return cuda.to_device(entry) if isinstance(entry, np.ndarray) else entry


def _worlds_innermost(shape: tuple[int, ...], dtype: DTypeLike) -> Any:
    return cuda.to_device(np.zeros(shape, dtype, order="F"))


def _free_bytes() -> int | None:
    """The free memory of the current GPU; None in Numba's simulator, which has the main memory."""
    free = cuda.current_context().get_memory_info()[0]
    return int(free) if isfinite(free) else None


def _blocks(worlds: int) -> int:
    return -(-worlds // THREADS_PER_BLOCK)
