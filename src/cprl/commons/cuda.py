"""CudaThreads: runs the rules with numba-cuda, one GPU thread per world.

With NUMBA_ENABLE_CUDASIM=1 Numba simulates all of this without a GPU: slowly, as a check.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple, cast

import numba.cuda
import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.compiled import compiled
from cprl.commons.game import Game
from cprl.commons.loops import ENTRIES, Played, one_scratch
from cprl.commons.rules import Groups
from cprl.commons.tables import Tables
from cprl.commons.world import Scratch, Worlds, empty_scratch
from cprl.institutions.arrays import changed
from cprl.values.arrays import Int64

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
        self.threads = worlds
        self._launch = _blocks(worlds), THREADS_PER_BLOCK
        self.tables: Tables = self.place(game.tables)
        self._scratch = Scratch(
            *(
                cuda.to_device(np.asfortranarray(np.broadcast_to(array, (worlds, *array.shape))))
                for array in empty_scratch(game)
            )
        )
        self._unknown = cuda.to_device(np.full(1, NONE_UNKNOWN, np.int64))

    def place(self, arrays: Any) -> Any:
        return changed(arrays, _placed)

    def wrap(self, memory: Any) -> NDArray[Any]:
        """Return a Numba array on GPU memory of another owner, such as a torch tensor; shares the memory."""
        array: NDArray[Any] = cuda.as_cuda_array(memory)
        return array

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        array: NDArray[Any] = cuda.device_array(shape, dtype)
        return array

    def read(self, array: Any) -> NDArray[Any]:
        return np.ascontiguousarray(array.copy_to_host())

    def write(self, array: Any, values: NDArray[Any]) -> None:
        array.copy_to_device(np.asfortranarray(values))

    def first_unknown(self, actions: Int64, known: int) -> int:
        self._unknown.copy_to_device(np.full(1, NONE_UNKNOWN, np.int64))
        kernels(()).find_unknown[_blocks(len(actions)), THREADS_PER_BLOCK](actions, known, self._unknown)
        at = int(self._unknown.copy_to_host()[0])
        return -1 if at == NONE_UNKNOWN else at

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """See `cprl.commons.batch.Driver`; the loop starts on the default stream, and this returns before it
        has finished."""
        kernel, arguments = to_run(game)
        kernel[self._launch](*arguments, task, self._scratch)

    def show(self, game: tuple[Any, ...]) -> None:
        """See `cprl.commons.batch.Driver`."""
        kernel, arguments = to_show(game)
        kernel[self._launch](*arguments, self._scratch)


def to_run(game: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """Return the kernel that runs a game, see `Driver.run`, and its arguments before the task."""
    worlds, tables, output, law, *decided = game
    arguments = _without_none(worlds), tables, output, law or (), *decided
    return kernels(_absent(worlds, law)).run, arguments


def to_show(game: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """Return the kernel that draws the boards of a game, see `Driver.show`, and its first arguments."""
    worlds, tables, boards = game
    return kernels(_absent(worlds, None)).show, (_without_none(worlds), tables, boards)


def _absent(worlds: Worlds, law: Any) -> tuple[str, ...]:
    """Return the names of the groups of rules that a game lacks, and "law" without institutions."""
    groups = (name for name, group in worlds.groups._asdict().items() if group is None)
    return *groups, *(("law",) if law is None else ())


def _without_none(worlds: Worlds) -> Any:
    """Return worlds with empty tuples in place of the groups that the game lacks: a kernel takes no None."""
    return worlds._replace(groups=cast(Any, Groups)(*(group or () for group in worlds.groups)))


def _nothing(arrays: Any, b: int) -> None:
    """Take the place of the function that takes world b out of the arrays of a group that a game lacks."""
    return


class Kernels(NamedTuple):
    """The kernels of games that lack the same groups; compiled at their first launch."""

    run: Any
    show: Any
    find_unknown: Any


@cache
def kernels(absent: tuple[str, ...]) -> Kernels:
    """Return the kernels of games without these groups: thread b runs a loop on world b alone."""
    others = {f"one_{name}": _nothing for name in absent}
    rules = compiled((*ENTRIES, one_scratch), cuda.jit(device=True), **others)
    run_worlds, show_worlds, cut = (rules[name] for name in ("run_worlds", "show_worlds", "one_scratch"))

    @cuda.jit
    def run(worlds, tables, output, law, actions, decisions, which, task, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < which.shape[0]:
            played = Played(worlds, tables, output, law, actions, decisions, which)
            run_worlds(played, task, cut(scratch, b), b, b + 1)

    @cuda.jit
    def show(worlds, tables, boards, scratch):  # type: ignore[no-untyped-def]
        b = cuda.grid(1)
        if b < boards.shape[0]:
            show_worlds((worlds, tables, boards), cut(scratch, b), b, b + 1)

    return Kernels(run, show, _find_unknown(rules["first_unknown"]))


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


def _blocks(worlds: int) -> int:
    return -(-worlds // THREADS_PER_BLOCK)
