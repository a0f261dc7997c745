"""How many environment steps a CPU-second gives: the kernel alone and through `CommonsEnv.step`.

The commons board, 4 agents, RGB windows written, random actions drawn beforehand, every world inside its
episode. The best of several repeats is printed, since whatever else the machine does only adds time.

    make bench
"""

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, Game, keys, presets
from cprl.commons.batch import Batch

OTHERS = (  # measured on such a machine for this project, steps per second of one core where not said
    ("the published program, 4 agents", "1,160"),
    ("sequential_social_dilemma_games, 4 agents", "3,400"),
    ("Melting Pot, 7 agents (as two processes 3,750)", "2,060"),
    ("SocialJax, 7 agents, its best batch, both cores", "5,300"),
    ("a C program with the same rules and output", "3,900,000"),
    ("a straightforward Numba prototype", "900,000"),
    ("batched torch", "90,000"),
)
STEPS_PER_EPISODE = 400
"""Turns timed before all worlds begin anew, so that none has ended."""


@dataclass
class Rate:
    """How fast one way was."""

    worlds: int
    threads: int
    step_us: float

    @property
    def steps_per_cpu_s(self) -> float:
        """Return environment steps per second of each core used."""
        return self.worlds / self.step_us * 1e6 / self.threads


def best_us(step: Callable[[int], object], begin: Callable[[], object], turns: int, repeats: int) -> float:
    """Return the microseconds of one step of all worlds, best of several repeats."""
    times = []
    for _ in range(repeats):
        begin()
        step(0)
        started = time.perf_counter()
        for turn in range(turns):
            step(turn)
        times.append((time.perf_counter() - started) / turns)
    return min(times) * 1e6


def actions_for(game: Game, worlds: int, turns: int) -> np.ndarray:
    """Return actions, int64 [turns, B, N], every one equally likely."""
    return np.random.default_rng(0).integers(0, len(game.actions), (turns, worlds, game.agents))


def kernel(game: Game, worlds: int, threads: int, turns: int, repeats: int) -> Rate:
    """Measure the compiled rules alone, into the same arrays again and again."""
    batch = Batch(game, worlds, threads=threads)
    output = batch.new_output()
    actions = actions_for(game, worlds, turns)
    us = best_us(lambda turn: batch.play(actions[turn], output), lambda: batch.begin(output), turns, repeats)
    return Rate(worlds, batch.driver.threads, us)


def through_step(game: Game, worlds: int, threads: int, turns: int, repeats: int) -> Rate:
    """Measure `CommonsEnv.step`: fresh tensors and TensorDicts every turn."""
    env = CommonsEnv(game, worlds, seed=0, threads=threads)
    actions = torch.as_tensor(actions_for(game, worlds, turns))
    moment = {"now": env.reset()}

    def begin() -> None:
        moment["now"] = env.reset()

    def step(turn: int) -> None:
        entry = moment["now"]
        entry.get(keys.AGENTS).set("action", actions[turn])
        moment["now"] = env.step(entry).get("next")

    return Rate(worlds, env.worlds.driver.threads, best_us(step, begin, turns, repeats))


def main(*, worlds: tuple[int, ...] = (1, 16, 256, 1024, 4096), repeats: int = 7) -> None:
    """Print the table.

    Args:
        worlds: the batch sizes to measure.
        repeats: of which the best counts.
    """
    game = presets.game("commons")
    cores = os.cpu_count() or 1
    table = Table("threads", "what", title="one step of all worlds, in microseconds; environment steps")
    for column in ("worlds", "us", "per s", "per CPU-s"):
        table.add_column(column, justify="right", no_wrap=True)
    for size in worlds:
        turns = max(20, min(STEPS_PER_EPISODE, 200_000 // size))
        for threads in sorted({1, min(cores, size)}):
            for name, measure in (("kernel", kernel), ("CommonsEnv.step", through_step)):
                rate = measure(game, size, threads, turns, repeats)
                total = rate.steps_per_cpu_s * threads
                row = f"{rate.threads}", name, f"{size:,}", f"{rate.step_us:,.1f}"
                table.add_row(*row, f"{total:,.0f}", f"{rate.steps_per_cpu_s:,.0f}")
    others = Table("measured on such a machine for comparison", "per s")
    for name, steps in OTHERS:
        others.add_row(name, steps)
    console = Console()
    console.print(
        f"commons, 4 agents, {cores} cores, Python {platform.python_version()}, torch {torch.__version__}"
    )
    console.print(table, others)


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(main)
