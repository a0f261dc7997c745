"""How much longer best responses take that are trained side by side, of `cprl exploit`.

One training of each algorithm against each replica of stored results, and three side by side, take turns
within one process; the best of several repeats counts of each, in milliseconds of a step in which every
replica acts, and of their ratio the median. Three runs one after the other would have the ratio 3.

    .venv/bin/python benchmarks/responses.py docs/results/commons_targets_10
"""

import time
from pathlib import Path
from statistics import median
from typing import Final

import tyro
from rich.console import Console
from rich.table import Table

from cprl.agents import Population
from cprl.envs.make_env import make_env
from cprl.exploiting import plan_responses
from cprl.process import prepare_process
from cprl.studies.trials import trials_of
from cprl.training import Training

STEPS: Final = 1000


def trainings(run: Path, seeds: int) -> dict[str, Training]:
    """The trainings of responses by algorithm, each past what is compiled."""
    found = {}
    for trial in trials_of(plan_responses(run, seeds=seeds, training_episodes=1000).study):
        own = trial.experiment
        env = make_env(own.game, worlds=own.replicas, seed=own.seed)
        agents = Population(env, own.agents, seed=own.seed, engine=own.engine)
        training = Training(
            env,
            agents.learners,
            others=agents.others,
            episodes=10**9,
            update_every=own.update_every,
        )
        milliseconds(training)
        found[trial.condition.name] = training
    return found


def milliseconds(training: Training) -> float:
    """Of a step, the mean of STEPS."""
    started = time.perf_counter()
    for _ in range(STEPS):
        training.step()
    return 1e3 * (time.perf_counter() - started) / STEPS


def main(run: Path, /, *, repeats: int = 5) -> None:
    """Prints a row for each algorithm.

    Args:
        run: stored results of a game of several agents.
        repeats: of STEPS steps each.
    """
    prepare_process(0)
    table = Table(title=f"{run.name}: milliseconds of a step")
    for heading in ("", "1 training", "3 side by side", "ratio"):
        table.add_column(heading, justify="left" if not heading else "right")
    alone, beside = trainings(run, 1), trainings(run, 3)
    for name in alone:
        pairs = [(milliseconds(alone[name]), milliseconds(beside[name])) for _ in range(repeats)]
        one, three = (min(column) for column in zip(*pairs, strict=True))
        ratio = median(three / one for one, three in pairs)
        table.add_row(name, f"{one:.2f}", f"{three:.2f}", f"{ratio:.1f}")
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
