"""CudaThreads: the same rules under numba-cuda, one GPU thread for each world.

With NUMBA_ENABLE_CUDASIM=1 Numba runs all of this without a GPU, slowly, as a check.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, Final

import numba.cuda
import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import compiled
from cprl.commons.game import Game
from cprl.commons.loops import FUNCTIONS, LOOPS, Loop
from cprl.commons.tables import Tables
from cprl.commons.world import Actions, Scratch, StepOutput, Worlds, empty_scratch

cuda: Any = numba.cuda

THREADS_PER_BLOCK: Final = 64

NONE_UNKNOWN: Final = 2**62
"""What the search for unknown actions starts from: larger than any index."""


class CudaThreads:
    """A driver of B worlds whose arrays are Numba's, on the current GPU.

    Arrays of worlds and scratch lie in memory with the axis B innermost, so that threads side by side read
    words side by side. What is told lies as torch wants it.

    Args:
        game: what is played.
        worlds: how many worlds B.

    Raises:
        RuntimeError: where there is no GPU that Numba can use.
    """

    def __init__(self, game: Game, worlds: int) -> None:
        if not cuda.is_available():
            raise RuntimeError(
                "Numba finds no GPU; it wants NVIDIA's driver and the package numba-cuda, "
                "which come with cprl[cuda12] or cprl[cuda13]"
            )
        self.threads = worlds
        self.tables = Tables(*(_constant(entry) for entry in game.tables))
        sheet = empty_scratch(
            agents=game.agents,
            sites=len(game.map.sites),
            cells=game.tables.background.size,
            window=game.tables.window_cells.shape[1],
        )
        self._scratch = Scratch(*(_worlds_innermost((worlds, *each.shape), each.dtype) for each in sheet))
        self._unknown = cuda.to_device(np.full(1, NONE_UNKNOWN, np.int64))

    def place(self, worlds: Worlds) -> Worlds:
        """The same arrays on the GPU."""
        return Worlds(*(cuda.to_device(np.asfortranarray(array)) for array in worlds))

    def wrap(self, memory: Any) -> NDArray[Any]:
        """An array on GPU memory that somebody else holds, a torch tensor say; nothing is copied."""
        array: NDArray[Any] = cuda.as_cuda_array(memory)
        return array

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """A new array, its entries undefined."""
        array: NDArray[Any] = cuda.device_array(shape, dtype)
        return array

    def read(self, array: Any) -> NDArray[Any]:
        """A copy as a numpy array."""
        return np.ascontiguousarray(array.copy_to_host())

    def write(self, array: Any, values: NDArray[Any]) -> None:
        """Copies values of the same shape and type into an array."""
        array.copy_to_device(np.asfortranarray(values))

    def first_unknown(self, actions: Actions, known: int) -> int:
        """The index of the first action outside 0 .. known - 1 among all, or -1."""
        self._unknown.copy_to_device(np.full(1, NONE_UNKNOWN, np.int64))
        kernels()["find_unknown"][_blocks(len(actions)), THREADS_PER_BLOCK](actions, known, self._unknown)
        at = int(self._unknown.copy_to_host()[0])
        return -1 if at == NONE_UNKNOWN else at

    def run(
        self, loop: Loop, worlds: Worlds, what: NDArray[Any], output: StepOutput, *, vouched: bool = False
    ) -> None:
        """Runs a loop on all worlds, on the default stream; returns before it is done."""
        kernel = kernels()[loop][_blocks(len(what)), THREADS_PER_BLOCK]
        kernel(worlds, self.tables, what, output, self._scratch)


@cache
def kernels() -> dict[str, Any]:
    """A kernel for each loop by its name, and `find_unknown`; compiled when first launched."""
    rules = compiled(FUNCTIONS, _jit_for_gpu)
    launched: dict[str, Any] = {loop: _kernel(rules[loop], rules["one_scratch"]) for loop in LOOPS}
    return {**launched, "find_unknown": _find_unknown(rules["first_unknown"])}


def _jit_for_gpu(function: FunctionType) -> Callable[..., Any]:
    return cuda.jit(device=True)(function)


def _kernel(loop: Callable[..., None], one_scratch: Callable[..., Scratch]) -> Callable[..., Any]:
    """Thread b runs the loop on world b alone."""

    @cuda.jit
    def kernel(worlds, tables, what, output, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < what.shape[0]:
            loop(worlds, tables, what, output, one_scratch(scratch, b), b, b + 1)

    launched: Callable[..., Any] = kernel
    return launched


def _find_unknown(first_unknown: Callable[..., int]) -> Callable[..., Any]:
    """Thread b looks at the actions of world b."""

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
    """An array of the tables on the GPU; a number stays what it is."""
    return cuda.to_device(entry) if isinstance(entry, np.ndarray) else entry


def _worlds_innermost(shape: tuple[int, ...], dtype: DTypeLike) -> Any:
    return cuda.to_device(np.zeros(shape, dtype, order="F"))


def _blocks(worlds: int) -> int:
    return -(-worlds // THREADS_PER_BLOCK)
