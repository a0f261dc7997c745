"""Courses of trainings whose numbers are known."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cprl.algorithms import PPO, RolloutSettings
from cprl.population import Learning
from cprl.terminal.course import course_of

RISE_AND_FALL = [*[300.0] * 20, *[600.0] * 40, *[200.0] * 40]
LENGTHS = [*[1000.0] * 60, *[450.0] * 40]
LEARNERS = (Learning(PPO(settings=RolloutSettings())),) * 2


def columns(returns, lengths, *, spread, worlds=None):
    """Of replicas whose episodes had these returns, each so much more, and these lengths; two agents."""
    episodes, replicas = len(returns), len(spread)
    apples = np.concatenate([np.array(returns) + more for more in spread])
    steps = np.tile(np.array(lengths), replicas)
    one = {
        "replica": np.repeat(np.arange(replicas), episodes),
        "episode": np.tile(np.arange(episodes), replicas),
        "return": apples / 2,
        "collective_return": apples,
        "survival_steps": steps,
        "steps": steps.astype(int),
        "terminated": steps < 1000,
    }
    if worlds is not None:
        one["world"] = np.tile(worlds, replicas) + one["replica"] * (max(worlds) + 1)
    both = {name: np.repeat(column, 2) for name, column in one.items()}
    return {**both, "agent": np.tile([0, 1], len(steps))}


def told_of(
    run,
    returns,
    survival,
    *,
    random=(280.0, 284.0),
    fresh=((250.0, 254.0), (600.0, 600.0)),
    spread=(-1.0, 1.0),
    agents=LEARNERS,
    lacks="",
    worlds=None,
):
    """The sentences on replicas whose episodes had these returns, and a spread around them."""
    (run / "evaluation").mkdir(parents=True)
    tables = {
        "episodes": columns(returns, survival, spread=spread, worlds=worlds),
        "evaluation/random": columns(random, [1000.0] * len(random), spread=[0.0] * len(spread)),
        "evaluation/trained": columns(*fresh, spread=10 * np.array(spread)),
    }
    tables["episodes"].pop(lacks, None)
    for name, table in tables.items():
        pq.write_table(pa.table(table), run / f"{name}.parquet")
    return course_of(run, agents)


SIXTEEN_WORLDS = (
    *(318, 395, 322, 323, 437, 516, 438, 360, 266, 243, 217, 206),
    *(195, 193, 200, 191, 197, 190),
)
"""Mean apples of each 16 episodes of a tragedy, whose random play gets 280; the last ones about."""
