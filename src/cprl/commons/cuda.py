"""CudaThreads: runs the rules on a GPU with numba-cuda, one GPU thread per world.

With NUMBA_ENABLE_CUDASIM=1 Numba simulates the GPU on the CPU, which is slow and serves tests.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple, cast

import numba.cuda
import numpy as np
from numpy.typing import DTypeLike, NDArray

from cprl.commons.game import Game
from cprl.commons.loops import ENTRIES, Played, one_scratch
from cprl.commons.rules import RuleGroups
from cprl.commons.tables import Tables
from cprl.commons.world import Scratch, Worlds, empty_scratch
from cprl.institutions.arrays import map_arrays
from cprl.system.jit.compiled import compiled
from cprl.values.array_types import Int64

cuda: Any = numba.cuda

THREADS_PER_BLOCK: Final = 64

NONE_INVALID: Final = 2**62
"""The result of a search for unknown actions that finds none: larger than any index."""


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
        self._lowest_invalid = cuda.to_device(np.full(1, NONE_INVALID, np.int64))
        """The result of the search for unknown actions, in GPU memory: int64 [1]."""

    def place(self, arrays: Any) -> Any:
        return map_arrays(arrays, _copy_to_gpu)

    def wrap(self, memory: Any) -> NDArray[Any]:
        """Return a Numba array that shares the GPU memory of e.g. a torch tensor."""
        array: NDArray[Any] = cuda.as_cuda_array(memory)
        return array

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        array: NDArray[Any] = cuda.device_array(shape, dtype)
        return array

    def read(self, array: Any) -> NDArray[Any]:
        return np.ascontiguousarray(array.copy_to_host())

    def write(self, array: Any, values: NDArray[Any]) -> None:
        array.copy_to_device(np.asfortranarray(values))

    def first_invalid(self, actions: Int64, known: int) -> int:
        self._lowest_invalid.copy_to_device(np.full(1, NONE_INVALID, np.int64))
        find_invalid = kernels(()).find_invalid[_blocks(len(actions)), THREADS_PER_BLOCK]
        find_invalid(actions, known, self._lowest_invalid)
        index = int(self._lowest_invalid.copy_to_host()[0])
        return -1 if index == NONE_INVALID else index

    def run(self, task: int, game: tuple[Any, ...]) -> None:
        """Start a task on the default stream, and return before it has finished; see `Driver.run`."""
        kernel, arguments = to_run(game)
        kernel[self._launch](*arguments, task, self._scratch)

    def show(self, game: tuple[Any, ...]) -> None:
        """Draw the boards of the worlds; see `Driver.show`."""
        kernel, arguments = to_show(game)
        kernel[self._launch](*arguments, self._scratch)


def to_run(game: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """Return the kernel that does tasks with a game, see `Driver.run`, and its arguments before the task."""
    worlds, tables, output, law, *choices = game
    arguments = _without_none(worlds), tables, output, law or (), *choices
    return kernels(_absent(worlds, law)).run, arguments


def to_show(game: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
    """Return the kernel that draws the boards of a game, see `Driver.show`, and its first arguments."""
    worlds, tables, boards = game
    return kernels(_absent(worlds, None)).show, (_without_none(worlds), tables, boards)


def _absent(worlds: Worlds, law: Any) -> tuple[str, ...]:
    """Return the names of the groups of rules that a game lacks; "law" stands for institutions."""
    groups = (name for name, group in worlds.groups._asdict().items() if group is None)
    return *groups, *(("law",) if law is None else ())


def _without_none(worlds: Worlds) -> Any:
    """Return worlds with empty tuples in place of the groups that the game lacks; kernels take no None."""
    return worlds._replace(groups=cast(Any, RuleGroups)(*(group or () for group in worlds.groups)))


def _no_arrays(arrays: Any, index: int) -> None:
    """Return None for a world, of a group that a game lacks, in place of the function made by `slicer`."""
    return


class Kernels(NamedTuple):
    """The kernels of games that lack the same groups of rules. Each is compiled at its first launch."""

    run: Any
    show: Any
    find_invalid: Any


@cache
def kernels(absent: tuple[str, ...]) -> Kernels:
    """Return the kernels of games that lack these groups; a thread works on the world of its index alone."""
    replacements = {f"one_{name}": _no_arrays for name in absent}
    rules = compiled((*ENTRIES, one_scratch), cuda.jit(device=True), **replacements)
    run_worlds = rules["run_worlds"]
    show_worlds = rules["show_worlds"]
    scratch_of = rules["one_scratch"]

    @cuda.jit
    def run(worlds, tables, output, law, actions, decisions, selected, task, scratch):  # type: ignore[no-untyped-def]
        index = cuda.grid(1)
        if index < selected.shape[0]:
            game = Played(worlds, tables, output, law, actions, decisions, selected)
            run_worlds(game, task, scratch_of(scratch, index), index, index + 1)

    @cuda.jit
    def show(worlds, tables, boards, scratch):  # type: ignore[no-untyped-def]
        index = cuda.grid(1)
        if index < boards.shape[0]:
            show_worlds((worlds, tables, boards), scratch_of(scratch, index), index, index + 1)

    return Kernels(run, show, _find_invalid(rules["first_invalid"]))


def _find_invalid(first_invalid: Callable[..., int]) -> Any:
    """Return the kernel that writes the lowest row-major index of an unknown action; each thread checks
    the world of its index."""

    @cuda.jit
    def kernel(actions, known, lowest):  # type: ignore[no-untyped-def]
        index = cuda.grid(1)
        if index < actions.shape[0]:
            agent = first_invalid(actions[index], known)
            if agent >= 0:
                cuda.atomic.min(lowest, 0, index * actions.shape[1] + agent)

    return kernel


def _copy_to_gpu(array: NDArray[Any], has_worlds: bool) -> Any:
    """Return a copy on the GPU, with the axis B innermost if the array has one."""
    ordered = np.asfortranarray(array) if has_worlds else array
    return cuda.to_device(ordered)


def _blocks(worlds: int) -> int:
    """Return the number of blocks of threads that a kernel for B worlds needs."""
    return -(-worlds // THREADS_PER_BLOCK)
