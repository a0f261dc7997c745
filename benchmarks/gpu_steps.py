"""How many environment steps a second a GPU plays: the kernel alone and through `CommonsEnv.step`.

The commons board, 4 agents, RGB windows written, random actions drawn beforehand, everything on the GPU.

    make bench-gpu
"""

import sys
import time
from collections.abc import Callable

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, keys, presets

AIM = 50_000_000
"""Environment steps per second that this library aims at on one GPU."""


def seconds(step: Callable[[int], object], turns: int, repeats: int) -> float:
    """Return the seconds of one step of all worlds, best of several repeats."""
    step(0)
    best = float("inf")
    for _ in range(repeats):
        torch.cuda.synchronize()
        started = time.perf_counter()
        for turn in range(turns):
            step(turn)
        torch.cuda.synchronize()
        best = min(best, (time.perf_counter() - started) / turns)
    return best


def rates(size: int, turns: int, repeats: int) -> tuple[float, float]:
    """Return environment steps per second of the kernel alone and of `CommonsEnv.step`, `size` worlds."""
    env = CommonsEnv(presets.game("commons"), size, seed=0, device="cuda")
    actions = torch.randint(8, (turns, size, env.game.agents), device="cuda")
    arrays = [env.worlds.driver.wrap(turn) for turn in actions]  # type: ignore[attr-defined]
    moment = {"now": env.reset()}
    output = env.output

    def step(turn: int) -> None:
        entry = moment["now"]
        entry.get(keys.AGENTS).set("action", actions[turn])
        moment["now"] = env.step(entry).get("next")

    kernel_s = seconds(lambda turn: env.worlds.play(arrays[turn], output), turns, repeats)
    moment["now"] = env.reset()
    return size / kernel_s, size / seconds(step, turns, repeats)


def main(
    *, worlds: tuple[int, ...] = (1024, 4096, 16_384, 65_536, 262_144), turns: int = 50, repeats: int = 5
) -> None:
    """Print the table.

    Args:
        worlds: the batch sizes to measure.
        turns: turns timed at a time.
        repeats: of which the best counts.
    """
    if not torch.cuda.is_available():
        sys.exit("no GPU: torch finds none here, so there is nothing to measure")
    table = Table("worlds", title=f"environment steps per second on {torch.cuda.get_device_name()}")
    for column in ("kernel", "CommonsEnv.step", f"share of the aim, {AIM:,}", "GPU memory in use, GiB"):
        table.add_column(column, justify="right")
    for size in worlds:
        reached = rates(size, turns, repeats)
        free, total = torch.cuda.mem_get_info()
        memory = f"{(total - free) / 2**30:.1f}"
        table.add_row(f"{size:,}", *(f"{rate:,.0f}" for rate in reached), f"{max(reached) / AIM:.0%}", memory)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
