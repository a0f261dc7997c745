"""What a small trial costs beside its training, in a worker that is kept for one trial after the other.

Trials of one shape, 4 DQN agents on `commons` by the rules as run with 4 replicas of 2 episodes of 250 steps,
run one after the other in this process, as a study's worker does. Of each: its wall time; the seconds in
which it acts, stores and updates, and those in which code is compiled or read from caches, both from its
`report.json`; and the rest, which is everything else: making learners, measuring, evaluation, tables,
weights, the figure, the summary. The first trial starts a worker and is told apart. With `--vary` trials
differ in learning rate and discount, which are no constants of compiled code.

    python benchmarks/kept_workers.py                        20 trials
    python benchmarks/kept_workers.py --trials 200 --vary
    python benchmarks/kept_workers.py --clock cpu            where others use the machine

It fails if the rest of the later trials is above half a second on average.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, median
from types import SimpleNamespace
from typing import Final, Literal
from unittest.mock import patch

BEGAN: Final = time.perf_counter(), time.process_time()

import psutil  # noqa: E402  (imports are part of a worker's start)
import tyro  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

import cprl  # noqa: E402
from cprl import compile_clock, presets, times, training  # noqa: E402
from cprl.algorithms import DQN  # noqa: E402
from cprl.population import Learning  # noqa: E402

MOST_REST_S: Final = 0.5
"""Seconds a trial, of issue 19."""
RATES: Final = (1e-4, 3e-4, 1e-3)
GAMMAS: Final = (0.95, 0.99)


@dataclass(frozen=True)
class Trial:
    """Where the time of a trial went, in seconds, and the memory of its process afterwards, in MB."""

    wall_s: float
    busy_s: float
    compiling_s: float
    memory_mb: float

    @property
    def rest_s(self) -> float:
        """Of everything but acting, storing, updating and compiling."""
        return self.wall_s - self.busy_s - self.compiling_s


def trial_of(run: Path, wall_s: float) -> Trial:
    """Of a run that has finished."""
    report = json.loads((run / "report.json").read_text())
    return Trial(
        wall_s,
        report["acting_storing_updating_s"],
        report["compiling_s"],
        psutil.Process().memory_info().rss / 1e6,
    )


def rest_per_trial_s(runs: Sequence[Path], wall_s: float, *, workers: int = 1) -> tuple[float, float]:
    """Of many trials, run by workers side by side: seconds a trial of compiling, and of the rest.

    Args:
        runs: their directories.
        wall_s: from the start of the first to the end of the last.
        workers: how many there were, each with a core of its own.
    """
    trials = [trial_of(run, 0.0) for run in runs]
    compiling_s = sum(trial.compiling_s for trial in trials)
    rest_s = wall_s * workers - sum(trial.busy_s for trial in trials) - compiling_s
    return compiling_s / len(runs), rest_s / len(runs)


def small(number: int, *, vary: bool, episodes: int, episode_steps: int) -> cprl.Experiment:
    """The trial of a number, which is its seed."""
    game = presets.game("commons", variant="as_run")
    settings = replace(
        presets.dqn_settings("commons", variant="as_run"),
        learning_rate=RATES[number % len(RATES)] if vary else RATES[0],
        gamma=GAMMAS[number % len(GAMMAS)] if vary else GAMMAS[0],
        epsilon_decay_steps=500,
        buffer_size=10_000,
    )
    return cprl.Experiment(
        name="small",
        game=replace(game, rules=replace(game.rules, episode_steps=episode_steps)),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=episodes,
        replicas=4,
        evaluation_episodes=1,
        seed=number,
    )


@contextmanager
def quiet() -> Iterator[None]:
    """While it is open, what trials print goes nowhere, as in a study's worker."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def by_cpu() -> ExitStack:
    """While it is open, every clock of a training counts the CPU seconds of this process."""
    clock = SimpleNamespace(perf_counter=time.process_time, monotonic=time.process_time)
    stack = ExitStack()
    for module in (compile_clock, times, training):
        stack.enter_context(patch.object(module, "time", clock))
    return stack


def main(
    *,
    trials: int = 20,
    vary: bool = False,
    episodes: int = 2,
    episode_steps: int = 250,
    clock: Literal["wall", "cpu"] = "wall",
) -> None:
    """Prints the table.

    Args:
        trials: how many, at least 2.
        vary: whether they differ in learning rate and discount.
        episodes: of each.
        episode_steps: turns of an episode.
        clock: wall time, or the CPU time of this process.
    """
    now = time.process_time if clock == "cpu" else time.perf_counter
    start_s = now() - BEGAN[clock == "cpu"]
    done: list[Trial] = []
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if clock == "cpu":
            stack.enter_context(by_cpu())
        stack.enter_context(quiet())
        for number in range(trials):
            experiment = small(number, vary=vary, episodes=episodes, episode_steps=episode_steps)
            began = now()
            run = cprl.run(
                experiment, folder / str(number), watch="off", keep_checkpoint=False, figures=False
            )
            done.append(trial_of(run, now() - began))
    later = done[1:]
    shown = Table(f"seconds ({clock})", title=f"{trials} trials in one process")
    for column in ("first", "later, mean", "later, median", "later, longest"):
        shown.add_column(column, justify="right")
    for name in ("wall_s", "busy_s", "compiling_s", "rest_s"):
        values = [getattr(trial, name) for trial in later]
        cells = getattr(done[0], name), fmean(values), median(values), max(values)
        title = {"busy_s": "acting, storing, updating"}.get(name, name.removesuffix("_s"))
        shown.add_row(title, *(f"{seconds:.3f}" for seconds in cells))
    console = Console(width=110)
    console.print(shown)
    console.print(f"start of the process, imports: {start_s:.2f} s")
    at = sorted({0, min(9, trials - 1), trials // 2, trials - 1})
    memory = ", ".join(f"{done[place].memory_mb:,.0f} after {place + 1}" for place in at)
    console.print(f"memory in MB: {memory}")
    rest_s = fmean(trial.rest_s for trial in later)
    if rest_s > MOST_REST_S:
        sys.exit(f"the rest of a later trial is {rest_s:.3f} s; allowed: {MOST_REST_S}")


if __name__ == "__main__":
    tyro.cli(main)
