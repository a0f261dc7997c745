"""Choose where the worlds of an environment run, and draw a seed for an environment that is given none."""

import multiprocessing
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cprl.commons.batch import Driver
from cprl.commons.game import Game
from cprl.commons.threads import CpuThreads
from cprl.system.jit.compiled import PLAIN_RULES, RULES_VARIABLE, runs_plain
from cprl.values import refusal


def drawn_seed() -> int:
    """Draw a seed from torch's generator, a different one in each worker process.

    Forked workers start with equal generators. So the seed of a worker also depends on the name of its
    process, which `multiprocessing` makes unique among the children of a process.
    """
    drawn = int(torch.empty((), dtype=torch.int64).random_().item())
    if multiprocessing.parent_process() is None:
        return drawn
    worker = multiprocessing.current_process().name.encode()
    return int(np.random.SeedSequence((drawn, *worker)).generate_state(1, np.uint64)[0])


def device_of(device: Any) -> torch.device:
    """Return a device, e.g. of "cuda"; raise a ValueError for a name that torch does not know."""
    try:
        return torch.device(device)
    except (RuntimeError, TypeError, ValueError):
        raise refusal("device", device, '"cpu" and "cuda"') from None


def driver_for(
    game: Game, worlds: int, device: torch.device, threads: int | None
) -> tuple[Driver, Callable[[Tensor], Any]]:
    """Return the driver that runs the worlds on a device, and a function that views a tensor there as an
    array of the driver, without a copy.

    Raises:
        ValueError: for a device that the game cannot use, or `threads` with a GPU.
    """
    if device.type == "cpu":
        return CpuThreads(game, worlds, threads=threads), Tensor.numpy
    if device.type != "cuda":
        raise ValueError(f'device is "{device}"; allowed: "cpu" and "cuda"')
    if threads is not None:
        raise refusal("threads", threads, "None on a GPU, where each world has its own thread")
    if runs_plain():
        raise ValueError(
            f'device is "{device}" and {RULES_VARIABLE} is "{PLAIN_RULES}", or NUMBA_DISABLE_JIT is 1; '
            'allowed: rules that run as plain Python on "cpu" alone'
        )
    if not torch.cuda.is_available():
        raise ValueError(f'device is "{device}"; allowed: "cpu", because torch finds no GPU')
    from cprl.commons.cuda import CudaThreads

    driver = CudaThreads(game, worlds)
    return driver, driver.wrap
