"""What a study's executors cost: one study by processes and by Ray, on as many workers.

Each trial says how long it ran and how much of that was compiling, in its status file. The overhead is what
the workers had besides: the wall time times the number of workers, less the sum of the trials' own seconds.
It holds the start of the processes, their imports, and the cores that have nothing left to do at the end.

    python benchmarks/study_executors.py
"""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

import tyro
from rich.console import Console
from rich.table import Table

from cprl import Experiment, Study, presets
from cprl.algorithms import DQN
from cprl.population import Learning
from cprl.studies import Processes, Ray, run_study
from cprl.studies.executors import Executor
from cprl.studies.status import Status

STEPS: Final = 200
"""In an episode."""


class Cost(NamedTuple):
    """Of a study."""

    wall_s: float
    """Until every trial has finished and the workers are gone."""
    trials: int
    running_s: float
    """The sum of the trials' own seconds, compiling included."""
    compiling_s: float


def study(trials: int, episodes: int) -> Study:
    """Four DQN agents on the commons, 2 replicas to a trial; two discounts."""
    game = presets.game("commons", variant="as_run")
    settings = replace(
        presets.dqn_settings("commons", variant="as_run"), buffer_size=2000, learning_starts=200
    )
    experiment = Experiment(
        name="executors",
        game=replace(game, rules=replace(game.rules, episode_steps=STEPS)),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=episodes,
        evaluation_episodes=4,
    )
    discounts = {"agents.*.algorithm.settings.gamma": [0.9, 0.99]}
    return Study(experiment, discounts, replicas=trials, block=2)


def cost(executor: Executor, asked: Study) -> Cost:
    """Of a study in a new directory."""
    with TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = run_study(asked, folder, on=executor)
        wall_s = time.perf_counter() - began
        if result.failed:
            raise RuntimeError(str(result.failed[0]))
        said = [Status(Path(folder) / "status", own.name).read() for own in result.trials]
        sums = [sum(own[name] for own in said) for name in ("running_s", "compiling_s")]
        return Cost(wall_s, len(said), *sums)


def main(trials: int = 12, jobs: int = 2, episodes: int = 12, twice: bool = True) -> None:
    """Prints a row for each executor.

    Args:
        trials: an even number.
        jobs: workers.
        episodes: of each trial.
        twice: whether a study by processes comes first that is not shown, which fills torch's cache.
    """
    asked = study(trials, episodes)
    executors: dict[str, Executor] = {
        f"Processes({jobs})": Processes(jobs),
        f"Ray(jobs={jobs})": Ray(jobs=jobs),
    }
    if twice:
        cost(Processes(jobs), study(2, 2))
    table = Table(title=f"{trials} trials of {episodes} episodes of {STEPS} steps, {jobs} workers; seconds")
    for column in ("executor", "wall", "trials' own", "of it compiling", "overhead per trial"):
        table.add_column(column, justify="left" if column == "executor" else "right")
    for name, executor in executors.items():
        found = cost(executor, asked)
        overhead_s = (found.wall_s * jobs - found.running_s) / found.trials
        numbers = (found.wall_s, found.running_s, found.compiling_s, overhead_s)
        table.add_row(name, *(f"{number:.1f}" for number in numbers))
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
