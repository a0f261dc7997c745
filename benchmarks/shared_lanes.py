"""Is it worth it to train conditions that differ in numbers only as lanes of one training?

Two conditions of 8 replicas each, one after the other, take as long as two trainings of 8 replicas; sharing a
process as lanes, as long as one training of 16, if whatever differs (learning rate, discount, exploration,
target period) costs nothing. So the gain is at most the time of an environment step and replica in a training
of 8 replicas over that in one of 16. Both train 4 DQN agents on `commons`, 32 and 64 lanes, compiled, one
thread, in one process and in turns: of each pair of blocks the ratio is taken, and the median counts.

    python benchmarks/shared_lanes.py
    python benchmarks/shared_lanes.py --clock cpu --replicas 1       other numbers of replicas of a condition
"""

import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median, quantiles
from typing import Final, Literal

import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, presets
from cprl.learners.replay import ReplayLearner
from cprl.process import prepare_process
from cprl.training import Training

AGENTS: Final = (0, 1, 2, 3)
WORTH: Final = 1.3
"""The gain from which on sharing is worth its code, of issue 19."""


def training_of(replicas: int) -> Training:
    """A training that has begun to learn."""
    game = presets.game("commons")
    settings = replace(presets.dqn_settings("commons"), buffer_size=20_000)
    learner = ReplayLearner(game.spaces, agents=AGENTS, replicas=replicas, settings=settings)
    training = Training(CommonsEnv(game, replicas, seed=0), {AGENTS: learner}, episodes=10**9)
    while training.steps < 500:
        training.step()
    return training


def seconds(training: Training, steps: int, now: Callable[[], float]) -> float:
    """Of so many steps."""
    began = now()
    for _ in range(steps):
        training.step()
    return now() - began


def main(
    *,
    replicas: int = 8,
    conditions: int = 2,
    pairs: int = 25,
    steps: int = 200,
    clock: Literal["wall", "cpu"] = "wall",
) -> None:
    """Prints the times of a step and the gain.

    Args:
        replicas: of each condition.
        conditions: that share a training.
        pairs: of blocks, which alternate.
        steps: of a block.
        clock: wall time, or the CPU time of this process.
    """
    prepare_process(0)
    now = time.process_time if clock == "cpu" else time.perf_counter
    sizes = replicas, replicas * conditions
    trainings = {size: training_of(size) for size in sizes}
    spent: dict[int, list[float]] = {size: [] for size in sizes}
    for pair in range(pairs):
        for size in sizes[:: 1 if pair % 2 == 0 else -1]:
            spent[size].append(seconds(trainings[size], steps, now) / steps / size * 1e6)
    gains = [apart / shared for apart, shared in zip(*spent.values(), strict=True)]
    low, _, high = quantiles(gains, n=4)
    table = Table("training", title=f"microseconds of a step, one thread, {clock}, medians of {pairs} blocks")
    for column in ("lanes", "whole step", "for each replica"):
        table.add_column(column, justify="right")
    for size, times in spent.items():
        name = "one condition" if size == replicas else f"{conditions} conditions as lanes"
        each = median(times)
        table.add_row(name, str(size * len(AGENTS)), f"{each * size:,.0f}", f"{each:,.1f}")
    console = Console(width=100)
    console.print(table)
    verdict = "worth building" if median(gains) >= WORTH else f"under {WORTH}: leave it"
    console.print(f"gain of sharing: {median(gains):.2f} (quartiles {low:.2f} to {high:.2f}); {verdict}")


if __name__ == "__main__":
    tyro.cli(main)
