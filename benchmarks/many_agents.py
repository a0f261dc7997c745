"""What twelve DQN agents with windows of 20 x 21 cost, the game of recipes/perolat: time, memory, checkpoint.

Lanes are 12 (one replica) and 48 (four), compiled, one thread. Times are of the processor, since they are for
an estimate in core hours, and the best of several repeats; what else runs on the machine makes them longer
all the same, as it shares caches and memory. Memory is the peak of a process with full replay buffers of
20,000 that has written a checkpoint; filling those of 48 lanes takes minutes.

    python benchmarks/many_agents.py
    python benchmarks/many_agents.py --no-fill         times alone
"""

import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import tyro
from rich.console import Console
from rich.table import Table
from training_step import PARTS, STEPS

from cprl.envs.make_env import make_env
from cprl.learners.replay import ReplayLearner
from cprl.process import prepare_process
from cprl.runs.checkpoints import Checkpointer
from cprl.training import Training

WARM: Final = 500
"""Steps before the clock starts, compiling included."""


@contextmanager
def timed(part: str, spent: Counter[str]) -> Iterator[None]:
    """While it is open the processor's time that a part takes is added up, in nanoseconds."""
    owner, name = PARTS[part]
    plain: Callable[..., Any] = getattr(owner, name)

    def with_clock(*arguments: Any, **named: Any) -> Any:
        started = time.process_time_ns()
        result = plain(*arguments, **named)
        spent[part] += time.process_time_ns() - started
        return result

    with patch.object(owner, name, with_clock):
        yield


def nanoseconds(step: Callable[[], object]) -> int:
    """Of STEPS steps, of the processor."""
    started = time.process_time_ns()
    for _ in range(STEPS):
        step()
    return time.process_time_ns() - started


def measure(replicas: int, repeats: int, fill: bool) -> dict[str, float]:
    """Microseconds of each part and of a whole step; megabytes of memory and of a checkpoint.

    Args:
        replicas: side by side.
        repeats: of which the best counts.
        fill: whether buffers are filled, and memory and checkpoint measured.
    """
    sys.path.insert(0, str(Path(__file__).parents[1] / "recipes" / "perolat"))
    from perolat_base import EXPERIMENT, SETTINGS

    prepare_process(0)
    game, agents = EXPERIMENT.game, tuple(range(EXPERIMENT.game.agents))
    learner = ReplayLearner(game.spaces, agents=agents, replicas=replicas, settings=SETTINGS)
    training = Training(make_env(game, worlds=replicas, seed=0), {agents: learner}, episodes=10**9)
    while training.steps < WARM:
        training.step()
    best: dict[str, float] = {}

    def keep(name: str, spent: float) -> None:
        best[name] = min(best.get(name, float("inf")), spent / STEPS / 1e3)

    for _ in range(repeats):
        keep("whole step", nanoseconds(training.step))
        for part in PARTS:
            spent: Counter[str] = Counter()
            with timed(part, spent):
                nanoseconds(training.step)
            keep(part, spent[part])
    return best | (filled(training, SETTINGS.buffer_size) if fill else {})


def filled(training: Training, transitions: int) -> dict[str, float]:
    """Megabytes of memory and of a checkpoint once so many transitions are stored, without updates."""
    found = {}
    with patch.object(ReplayLearner, "update", lambda self: None):
        while training.steps < transitions:
            training.step()
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpointer(Path(folder))
        started = time.perf_counter()
        path = checkpoints.save(training)
        found["checkpoint, s"] = time.perf_counter() - started
        found["checkpoint, MB"] = path.stat().st_size / 1e6
    found["memory, MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return found


def main(*, repeats: int = 5, replicas: tuple[int, ...] = (1, 4), fill: bool = True) -> None:
    """Prints the table.

    Args:
        repeats: of which the best counts.
        replicas: side by side, a column each.
        fill: whether buffers are filled, and memory and checkpoint measured.
    """
    table = Table("", title="12 agents, window 20 x 21: microseconds a step, one thread, compiled")
    columns = []
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for number in replicas:
            columns.append(process.submit(measure, number, repeats, fill).result())
            table.add_column(f"{12 * number} lanes", justify="right")
    for part in PARTS:
        table.add_row(
            part, *(f"{best[part]:,.0f} ({best[part] / best['whole step']:.0%})" for best in columns)
        )
    rest = [best["whole step"] - sum(best[part] for part in PARTS) for best in columns]
    table.add_row("the rest", *(f"{us:,.0f}" for us in rest))
    table.add_section()
    for name in ("whole step", "memory, MB", "checkpoint, MB", "checkpoint, s"):
        if name in columns[0]:
            table.add_row(name, *(f"{best[name]:,.0f}" for best in columns))
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
