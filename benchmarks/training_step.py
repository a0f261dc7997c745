"""One whole training step of many independent DQN agents, in microseconds, and what each part takes of it.

Lanes are 1 (one agent, one replica), 8 (one agent, 8 replicas, `single_complex`) and 32 (four agents, 8
replicas, `commons`), with the published hyper-parameters, compiled, one thread, replay buffers of 20,000.
Whole steps and updates alone take turns within one process; the best of several repeats counts of each, and
of their ratio, turn by turn, the median, since whatever else the machine does falls on both:
inside a training an update finds its numbers, and everything its code, pushed out of the fast caches.

Last comes the time of a turn with a governor that learns by PPO, as a multiple of one with a vote: four
agents in 16 worlds of 8 replicas, an update of the governor in every 200 turns.

    make bench
"""

import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from multiprocessing import get_context
from operator import itemgetter
from statistics import median
from typing import Any, Final
from unittest.mock import patch

import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, Experiment, presets
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.algorithms.base import TrainingEngine
from cprl.institutions import Governor, Institution, Tax, Vote
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.measuring.tracker import EpisodeTracker
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Learning
from cprl.system.process import prepare_process
from cprl.training import Schedule, Training
from cprl.training.evaluating import make_agents

CASES: Final[tuple[tuple[presets.Board, int, int], ...]] = (
    ("single_complex", 1, 1),
    ("single_complex", 1, 8),
    ("commons", 4, 8),
)
"""Board, agents, replicas."""
PARTS: Final[dict[str, tuple[type, str]]] = {
    "policy": (JointPolicy, "forward"),
    "environment": (CommonsEnv, "_step_and_maybe_reset"),
    "replay write": (Learner, "store"),
    "update": (Learner, "update"),
    "tracking": (EpisodeTracker, "add"),
}
STEPS: Final = 200
WORLDS: Final = 16
"""The worlds of each replica in trainings with a governor or a vote."""
DEAR: Final = 1.1
"""The multiple of a turn with a vote above which a turn with a governor costs more than is allowed."""
BY_PPO: Final = Learning(PPO(settings=RolloutSettings(rollout_steps=4, minibatch_size=64)))


def timed(part: str, spent: Counter[str]) -> AbstractContextManager[Any]:
    """Return a context in which the time that a part takes is added up, in seconds."""
    owner, name = PARTS[part]
    plain: Callable[..., Any] = getattr(owner, name)

    def with_clock(*arguments: Any, **options: Any) -> Any:
        started = time.perf_counter()
        result = plain(*arguments, **options)
        spent[part] += time.perf_counter() - started  # type: ignore[assignment]
        return result

    return patch.object(owner, name, with_clock)


def seconds(step: Callable[[], object]) -> float:
    """Return the seconds of `STEPS` steps."""
    started = time.perf_counter()
    for _ in range(STEPS):
        step()
    return time.perf_counter() - started


def measure(
    board: presets.Board, agents: int, replicas: int, repeats: int, engine: TrainingEngine
) -> dict[str, float]:
    """Return the microseconds of each part, of a whole step, and of an update alone, and the ratio of the
    last two."""
    prepare_process(0)
    game = presets.game(board)
    settings = replace(presets.dqn_settings(board), buffer_size=20_000)
    agents = tuple(range(agents))
    lanes = Lanes(game.spaces, agents=agents, replicas=replicas)
    learner = DQN(settings=settings).make_learner(lanes, engine)
    training = Training(CommonsEnv(game, replicas, seed=0), {agents: learner}, Schedule(episodes=10**9))
    while training.steps < 500:
        training.step()
    best: dict[str, float] = {}

    def keep(name: str, spent: float) -> None:
        best[name] = min(best.get(name, float("inf")), spent / STEPS * 1e6)

    ratios = []
    for _ in range(repeats):
        whole = seconds(training.step)
        alone = seconds(learner.update)
        keep("whole step", whole)
        keep("update alone", alone)
        ratios.append(whole / alone)
    best["ratio"] = median(ratios)
    for _ in range(repeats):
        for part in PARTS:
            spent: Counter[str] = Counter()
            with timed(part, spent):
                seconds(training.step)
            keep(part, spent[part])
    return best


def ruled(institutions: tuple[Institution, ...], engine: TrainingEngine, **governor: Any) -> Training:
    """Return a training of a game with some institutions, after its first turns."""
    settings = DQNSettings(buffer_size=20_000, batch_size=64, steps_per_update=WORLDS)
    experiment = Experiment(
        name="step",
        game=replace(presets.game("commons"), institutions=institutions),
        agents=(Learning(DQN(settings=settings)),) * 4,
        steps=10**9,
        replicas=8,
        worlds=WORLDS,
        engine=engine,
        **governor,
    )
    env, population = make_agents(experiment)
    training = Training(
        env,
        population.learners,
        experiment.schedule,
        decisions=population.decisions,
        governor=population.governor,
    )
    while training.steps < 500 * WORLDS:
        training.step()
    return training


def measure_governor(repeats: int, engine: TrainingEngine) -> float:
    """Return the time of a turn with a governor, as a multiple of one with a vote."""
    prepare_process(0)
    voting = ruled((Vote(on=Tax()),), engine)
    governed = ruled((Tax(), Governor(sets="tax.rate")), engine, governor=BY_PPO)
    return median(seconds(governed.step) / seconds(voting.step) for _ in range(repeats))


def main(*, repeats: int = 15, engine: TrainingEngine = "compiled") -> None:
    """Print the table; end with exit code 1 where a governor costs more than is allowed.

    Args:
        repeats: of which the best counts.
        engine: "compiled" or "eager".
    """
    table = Table("microseconds a step", title=f"one whole training step, one thread, {engine}")
    columns = []
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for board, agents, replicas in CASES:
            columns.append(process.submit(measure, board, agents, replicas, repeats, engine).result())
            table.add_column(f"{agents * replicas} lanes", justify="right")
        governor = process.submit(measure_governor, repeats, engine).result()
    for part in PARTS:
        table.add_row(
            part, *(f"{best[part]:,.0f} ({best[part] / best['whole step']:.0%})" for best in columns)
        )
    rest = [best["whole step"] - sum(itemgetter(*PARTS)(best)) for best in columns]
    table.add_row("the rest", *(f"{us:,.0f}" for us in rest))
    table.add_section()
    table.add_row("whole step", *(f"{best['whole step']:,.0f}" for best in columns))
    table.add_row("update alone", *(f"{best['update alone']:,.0f}" for best in columns))
    table.add_row("whole step / update alone, median", *(f"{best['ratio']:.2f}" for best in columns))
    Console().print(table)
    Console().print(f"a turn with a governor / with a vote, median: {governor:.2f}")
    if governor > DEAR:
        sys.exit(f"more than {DEAR} of a turn with a vote")


if __name__ == "__main__":
    tyro.cli(main)
