"""Compiles the rules for a GPU where there is none: to PTX by numba-cuda, and to machine code by ptxas.

Proves that the kernels compile, not that they are right (`tests/commons/test_cuda.py`) or fast
(`gpu_steps.py`).

    .venv/bin/pip install -c constraints.txt -e ".[cuda12]"
    .venv/bin/python benchmarks/compile_for_gpu.py
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import tyro
from numba import typeof
from numba.cuda import compile_ptx, dispatcher

from cprl import Game, presets
from cprl.commons.cuda import kernels, to_run, to_show
from cprl.commons.game import output_forms
from cprl.commons.world import PLAY, Scratch, StepOutput, empty_scratch, empty_worlds
from cprl.institutions import Tax
from cprl.institutions.arrays import map_arrays
from cprl.institutions.law import new_law

COMMONS: Final = presets.game("commons")
GAMES: Final = {
    "commons, published": COMMONS,
    "commons, as run": presets.game("commons", variant="as_run"),
    "cleanup, with a river": presets.game("ssd/cleanup-v1"),
    "commons, with a tax": replace(COMMONS, institutions=(Tax(),)),
}
"""Games whose groups of rules differ, each with kernels of its own."""
WORLDS: Final = 4


def column_major(array: np.ndarray, is_of_worlds: bool) -> np.ndarray:
    """Return an array in the layout that `CudaThreads.place` gives it."""
    return np.asfortranarray(array) if is_of_worlds else array


def launches(game: Game) -> Iterator[tuple[str, Any, tuple[Any, ...]]]:
    """Yield each loop's name, its kernel, and arguments with the types and layouts that `CudaThreads` gives
    them."""
    worlds = map_arrays(empty_worlds(game, WORLDS), column_major)
    law = map_arrays(new_law(game, WORLDS), column_major) if game.institutions else None
    output = StepOutput(*(np.zeros(*form) for form in output_forms(game, WORLDS).values()))
    arrays = empty_scratch(game)
    scratch = Scratch(*(np.zeros((WORLDS, *array.shape), array.dtype, order="F") for array in arrays))
    actions = np.zeros((WORLDS, game.agents), np.int64)
    which = np.ones(WORLDS, np.bool_)
    run, run_arguments = to_run((worlds, game.tables, output, law, actions, actions, which))
    yield "run", run, (*run_arguments, PLAY, scratch)
    boards = np.zeros((WORLDS, game.map.height, game.map.width), np.uint8)
    show, show_arguments = to_show((worlds, game.tables, boards))
    yield "show", show, (*show_arguments, scratch)


def ptxas() -> Path | None:
    """Return NVIDIA's assembler, as the extra `cuda12` brings it."""
    with suppress(PackageNotFoundError):
        for path in files("nvidia-cuda-nvcc-cu12") or ():
            if path.name == "ptxas":
                return Path(str(path.locate()))
    return None


def assembled(name: str, ptx: str, assembler: Path, capability: tuple[int, int]) -> str:
    """Return what a kernel uses of a GPU, as the assembler says."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernel.ptx"
        source.write_text(ptx)
        command = [assembler, "-c", "-v", f"-arch=sm_{capability[0]}{capability[1]}", source]
        done = subprocess.run([*command, "-o", f"{source}.o"], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{name}: {done.stderr}")
    return ", ".join(re.findall(r"Used \d+ registers|\d+ bytes (?:stack frame|spill \w+)", done.stderr)[-4:])


def main(*, capability: tuple[int, int] = (9, 0)) -> None:
    """Print a line for each kernel.

    Args:
        capability: of the GPU to compile for, (9, 0) for an H100 or H200.
    """
    gpu = SimpleNamespace(compute_capability=capability)
    dispatcher.get_current_device = lambda: gpu  # asks the driver otherwise, and there is none
    assembler = ptxas()
    asked = np.zeros((WORLDS, COMMONS.agents), np.int64), len(COMMONS.actions), np.zeros(1, np.int64)
    every = [("find_invalid", kernels(()).find_invalid, asked)]
    for game_name, game in GAMES.items():
        every += [(f"{game_name}: {loop}", *launch) for loop, *launch in launches(game)]
    for name, kernel, arguments in every:
        ptx, _ = compile_ptx(kernel.py_func, tuple(map(typeof, arguments)), cc=capability)
        line = f"{name}: {len(ptx):,} characters of PTX"
        if assembler:
            line += f", {assembled(name, ptx, assembler, capability)}"
        print(line, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
