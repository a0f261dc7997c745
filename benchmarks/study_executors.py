"""What a study's executors cost: one study by processes and by Ray, on as many workers.

Of the wall time, times the number of workers: the trials' own seconds of acting, storing and updating, and
of compiling, both from their `report.json`; the rest of the trials, which is everything else that a run does
(networks, measuring, evaluation, tables, weights, its figure); and what no trial says: the start of workers
with their imports, the way from a trial to the next one, and cores that have nothing left to do at the end.
It fails if the rest is above half a second per trial.

    python benchmarks/study_executors.py                              12 trials by either
    python benchmarks/study_executors.py --trials 200 --episodes 2    200 small ones
"""

import json
import sys
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


MOST_REST_S: Final = 0.5
"""Seconds a trial, of issue 19."""


class Cost(NamedTuple):
    """Of a study, in seconds of all its trials together but for `wall_s`."""

    wall_s: float
    """Until every trial has finished and the workers are gone."""
    trials: int
    busy_s: float
    """Of acting, storing and updating."""
    compiling_s: float
    rest_s: float
    """Of everything else that the trials did."""

    def between_s(self, workers: int) -> float:
        """What no trial says."""
        return self.wall_s * workers - self.busy_s - self.compiling_s - self.rest_s


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
        result = run_study(asked, folder, on=executor, results=False)
        wall_s = time.perf_counter() - began
        if result.failed:
            raise RuntimeError(str(result.failed[0]))
        running_s = sum(
            Status(Path(folder) / "status", own.name).read()["running_s"] for own in result.trials
        )
        reports = [json.loads((result.runs / own.name / "report.json").read_text()) for own in result.trials]
        busy_s, compiling_s = (
            sum(own[name] for own in reports) for name in ("acting_storing_updating_s", "compiling_s")
        )
        return Cost(wall_s, len(reports), busy_s, compiling_s, running_s - busy_s - compiling_s)


def main(trials: int = 12, jobs: int = 2, episodes: int = 12, warm: bool = True) -> None:
    """Prints a row for each executor; ends with exit code 1 where the rest is more than is allowed.

    Args:
        trials: an even number.
        jobs: workers.
        episodes: of each trial.
        warm: whether a study by processes comes first that is not shown, which fills torch's cache.
    """
    asked = study(trials, episodes)
    executors: dict[str, Executor] = {
        f"Processes({jobs})": Processes(jobs),
        f"Ray(jobs={jobs})": Ray(jobs=jobs),
    }
    if warm:
        cost(Processes(jobs), study(2, 2))
    table = Table(
        title=f"{trials} trials of 2 replicas, {episodes} episodes of {STEPS} steps; {jobs} workers"
    )
    columns = ("executor", "wall s", "acting, storing, updating", "compiling", "rest", "start and between")
    for column in columns:
        table.add_column(column, justify="left" if column == "executor" else "right")
    found = {name: cost(executor, asked) for name, executor in executors.items()}
    for name, own in found.items():
        parts = (own.busy_s, own.compiling_s, own.rest_s, own.between_s(jobs))
        table.add_row(name, f"{own.wall_s:.1f}", *(f"{part / own.trials:.2f}" for part in parts))
    Console(width=110).print(table, "All but the wall time in seconds per trial.")
    if max(own.rest_s / own.trials for own in found.values()) > MOST_REST_S:
        sys.exit(f"the rest is above {MOST_REST_S} s per trial")


if __name__ == "__main__":
    tyro.cli(main)
