"""CudaThreads: runs the rules with numba-cuda, one GPU thread per world.

With NUMBA_ENABLE_CUDASIM=1 Numba simulates all of this without a GPU: slowly, as a check.
"""

from collections.abc import Callable
from functools import cache
from math import isfinite
from typing import Any, Final

import numba.cuda
import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import compiled
from cprl.commons.game import Game, check_worlds_fit
from cprl.commons.loops import ENTRIES, LOOPS, Loop, Played, one_scratch
from cprl.commons.tables import Tables
from cprl.commons.world import Actions, Scratch, empty_scratch
from cprl.institutions.arrays import changed

cuda: Any = numba.cuda

THREADS_PER_BLOCK: Final = 64

NONE_UNKNOWN: Final = 2**62
"""The initial result of the search for unknown actions: larger than any index."""


class CudaThreads:
    """A driver of B worlds in Numba arrays on the current GPU.

    Worlds and scratch memory are stored with the axis B innermost, so that neighbouring threads read
    neighbouring words. Step outputs are stored row-major, as in torch.
    """

    def __init__(self, game: Game, worlds: int) -> None:
        if not cuda.is_available():
            raise ValueError(
                "Numba finds no GPU; it needs NVIDIA's driver and the package numba-cuda "
                "(install cprl[cuda12] or cprl[cuda13])"
            )
        check_worlds_fit(game, worlds, free=_free_bytes())
        self.threads = worlds
        self.tables: Tables = self.place(game.tables)
        self._scratch = Scratch(
            *(
                cuda.to_device(np.zeros((worlds, *array.shape), array.dtype, order="F"))
                for array in empty_scratch(game)
            )
        )
        self._unknown = cuda.to_device(np.full(1, NONE_UNKNOWN, np.int64))

    def place(self, arrays: Any) -> Any:
        return changed(arrays, _placed)

    def wrap(self, memory: Any) -> NDArray[Any]:
        """A Numba array on GPU memory of another owner, such as a torch tensor; shares the memory."""
        array: NDArray[Any] = cuda.as_cuda_array(memory)
        return array

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        array: NDArray[Any] = cuda.device_array(shape, dtype)
        return array

    def read(self, array: Any) -> NDArray[Any]:
        return np.ascontiguousarray(array.copy_to_host())

    def write(self, array: Any, values: NDArray[Any]) -> None:
        array.copy_to_device(np.asfortranarray(values))

    def first_unknown(self, actions: Actions, known: int) -> int:
        self._unknown.copy_to_device(np.full(1, NONE_UNKNOWN, np.int64))
        kernels()["find_unknown"][_blocks(len(actions)), THREADS_PER_BLOCK](actions, known, self._unknown)
        at = int(self._unknown.copy_to_host()[0])
        return -1 if at == NONE_UNKNOWN else at

    def run(self, loop: Loop, game: tuple[Any, ...], argument: NDArray[Any]) -> None:
        """See `cprl.commons.batch.Driver`; the loop starts on the default stream, and this returns before it
        has finished."""
        launch = _blocks(len(argument)), THREADS_PER_BLOCK
        worlds, tables, output, law, decisions, payments = game
        if law is None:
            kernels()[loop][launch](worlds, tables, output, argument, self._scratch)
        else:
            law = law._replace(decisions=decisions, payments=payments)
            kernels()[f"governed {loop}"][launch](worlds, tables, output, law, argument, self._scratch)


@cache
def kernels() -> dict[str, Any]:
    """The kernels by name: for each loop one without institutions and one with them, and `find_unknown`;
    compiled at their first launch."""
    rules = compiled((*ENTRIES, one_scratch), cuda.jit(device=True))
    cut = rules[one_scratch.__name__]
    plain: dict[str, Any] = {loop: _kernel(rules[loop], cut) for loop in LOOPS}
    governed = {f"governed {loop}": _governed_kernel(rules[loop], cut) for loop in LOOPS}
    return {**plain, **governed, "find_unknown": _find_unknown(rules["first_unknown"])}


def _kernel(loop: Callable[..., None], cut: Callable[..., Scratch]) -> Any:
    """Thread b runs the loop on world b alone, without institutions: a kernel takes no None, a loop does."""

    @cuda.jit
    def kernel(worlds, tables, output, argument, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < argument.shape[0]:
            loop(Played(worlds, tables, output, None, None, None), argument, cut(scratch, b), b, b + 1)

    return kernel


def _governed_kernel(loop: Callable[..., None], cut: Callable[..., Scratch]) -> Any:
    """Thread b runs the loop on world b alone, with institutions."""

    @cuda.jit
    def kernel(worlds, tables, output, law, argument, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < argument.shape[0]:
            game = Played(worlds, tables, output, law, law.decisions, law.payments)
            loop(game, argument, cut(scratch, b), b, b + 1)

    return kernel


def _find_unknown(first_unknown: Callable[..., int]) -> Any:
    """Thread b checks the actions of world b."""

    @cuda.jit
    def kernel(actions, known, lowest):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < actions.shape[0]:
            at = first_unknown(actions[b], known)
            if at >= 0:
                cuda.atomic.min(lowest, 0, b * actions.shape[1] + at)

    return kernel


def _placed(array: NDArray[Any], is_of_worlds: bool) -> Any:
    return cuda.to_device(np.asfortranarray(array) if is_of_worlds else array)


def _free_bytes() -> int | None:
    """The free memory of the current GPU; None in Numba's simulator, which has the main memory."""
    free = cuda.current_context().get_memory_info()[0]
    return int(free) if isfinite(free) else None


def _blocks(worlds: int) -> int:
    return -(-worlds // THREADS_PER_BLOCK)
