"""Compiles the rules for a GPU where there is none: to PTX by numba-cuda, and to machine code by ptxas.

Proves that the kernels compile, not that they are right (`tests/test_cuda.py`) or fast (`gpu_steps.py`).

    .venv/bin/pip install -c constraints.txt -e ".[cuda12]"
    .venv/bin/python benchmarks/compile_for_gpu.py
"""

import re
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import tyro
from numba import typeof
from numba.cuda import compile_ptx, dispatcher

from cprl import Game, presets
from cprl.commons.batch import output_of
from cprl.commons.cuda import kernels
from cprl.commons.game import output_forms
from cprl.commons.world import Scratch, StepOutput, Worlds, empty_scratch, empty_worlds
from cprl.institutions import Tax
from cprl.institutions.arrays import changed
from cprl.institutions.law import new_law


def arguments(game: Game, worlds: int = 4) -> dict[str, tuple[Any, ...]]:
    """Arguments of each kernel with the types and layouts that `CudaThreads` gives them."""
    tables, sheet = game.tables, empty_scratch(game)
    scratch = Scratch(*(np.zeros((worlds, *each.shape), each.dtype, order="F") for each in sheet))
    told = StepOutput(**{name: np.zeros(*form) for name, form in output_forms(game, worlds).items()})
    actions, marks = np.zeros((worlds, game.agents), np.int64), np.zeros(worlds, np.bool_)
    boards = np.zeros((worlds, game.map.height, game.map.width), np.uint8)
    on_gpu = Worlds(*map(np.asfortranarray, empty_worlds(game, worlds)))
    loops = {"play_worlds": actions, "begin_worlds": marks, "refresh_worlds": marks, "show_worlds": boards}
    ruled = replace(game, institutions=(Tax(),))
    paid = output_of([np.zeros(*form) for form in output_forms(ruled, worlds).values()])
    law = changed(
        new_law(ruled, worlds), lambda array, of_worlds: np.asfortranarray(array) if of_worlds else array
    )._replace(decisions=actions, payments=paid.payments)
    return {
        **{name: (on_gpu, tables, told, what, scratch) for name, what in loops.items()},
        **{
            f"governed {name}": (on_gpu, ruled.tables, paid.turn, law, what, scratch)
            for name, what in loops.items()
            if name != "show_worlds"
        },
        "find_unknown": (actions, len(game.actions), np.zeros(1, np.int64)),
    }


def ptxas() -> Path | None:
    """NVIDIA's assembler, as the extra `cuda12` brings it."""
    with suppress(PackageNotFoundError):
        for path in files("nvidia-cuda-nvcc-cu12") or ():
            if path.name == "ptxas":
                return Path(str(path.locate()))
    return None


def main(*, capability: tuple[int, int] = (9, 0)) -> None:
    """Prints a line for each kernel.

    Args:
        capability: of the GPU to compile for, (9, 0) for an H100 or H200.
    """
    gpu = SimpleNamespace(compute_capability=capability)
    dispatcher.get_current_device = lambda: gpu  # asks the driver otherwise, and there is none
    assembler = ptxas()
    for name, given in arguments(presets.game("commons")).items():
        ptx, _ = compile_ptx(kernels()[name].py_func, tuple(map(typeof, given)), cc=capability)
        line = f"{name}: {len(ptx):,} characters of PTX"
        if assembler:
            with tempfile.TemporaryDirectory() as folder:
                source = Path(folder) / "kernel.ptx"
                source.write_text(ptx)
                command = [assembler, "-c", "-v", f"-arch=sm_{capability[0]}{capability[1]}", source]
                done = subprocess.run([*command, "-o", f"{source}.o"], capture_output=True, text=True)
            if done.returncode:
                sys.exit(f"{name}: {done.stderr}")
            line += ", " + ", ".join(
                re.findall(r"Used \d+ registers|\d+ bytes (?:stack frame|spill \w+)", done.stderr)[-4:]
            )
        print(line)


if __name__ == "__main__":
    tyro.cli(main)
