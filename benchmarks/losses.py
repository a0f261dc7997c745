"""One update of many agents for each of TorchRL's losses: the `update` that it says, and microseconds.

One thread, batch 8, window 7 x 15 x 3, two hidden layers of 32 and 8 actions. There are four learners in each
replica of `commons`; those of VDN, QMIX, MAPPO, IPPO and MADDPG are a team of four. Each loss runs in a
process of its own, and the best of several repeats counts; what each compiles first takes up to a minute
where torch has no cache.

    make bench
"""

import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import presets
from cprl.algorithms import (
    A2C,
    DQN,
    IPPO,
    MADDPG,
    MAPPO,
    PPO,
    PR2,
    QMIX,
    SAC,
    VDN,
    DQNSettings,
    Reinforce,
    RolloutSettings,
)
from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "own_algorithm"))
from c51 import C51
from cql import CQL
from iql import IQL

REPLAY = DQNSettings(buffer_size=1000)
ROLLOUTS = RolloutSettings()
ALGORITHMS = {
    "DQN": DQN(settings=REPLAY),
    "double DQN": DQN(settings=REPLAY, double=True),
    "DQN, Huber": DQN(settings=REPLAY, loss_function="smooth_l1"),
    "distributional DQN (C51)": C51(settings=REPLAY),
    "CQL": CQL(settings=REPLAY),
    "SAC": SAC(settings=REPLAY),
    "IQL": IQL(settings=REPLAY),
    "PR2": PR2(settings=REPLAY),
    "PPO": PPO(settings=ROLLOUTS),
    "A2C": A2C(settings=ROLLOUTS),
    "REINFORCE": Reinforce(settings=ROLLOUTS),
    "VDN": VDN(settings=REPLAY),
    "QMIX": QMIX(settings=REPLAY),
    "MAPPO": MAPPO(settings=ROLLOUTS),
    "IPPO": IPPO(settings=ROLLOUTS),
    "MADDPG": MADDPG(settings=REPLAY),
}
BATCH = 8


def learner_of(algorithm: Algorithm, learners: int) -> Learner:
    """Return so many learners, four in each replica of `commons`, as lanes or teams."""
    game = presets.game("commons")
    reward = "team" if isinstance(algorithm, TeamAlgorithm) else "individual"
    lanes = Lanes(game.spaces, agents=range(game.agents), replicas=learners // game.agents, reward=reward)
    learner = algorithm.make_learner(lanes, "compiled")
    assert isinstance(learner, Learner)
    return learner


def update_us(name: str, learners: int, repeats: int) -> tuple[str, bool, float]:
    """Return the `update`, whether it is compiled, and microseconds of one of so many learners."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    learner = learner_of(ALGORITHMS[name], learners)
    best = float("inf")
    networks = learner.lane_networks
    draw = Draw.of(learner.memory.example(len(learner.lanes))[:, :BATCH].contiguous())
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        for _ in range(10):
            networks.learn(draw)
    for _ in range(repeats):
        turns = 0
        started = time.perf_counter()
        while time.perf_counter() - started < 0.3:
            networks.learn(draw)
            turns += 1
        best = min(best, (time.perf_counter() - started) / turns)
    failed = any("torch.compile failed" in str(one.message) for one in raised)
    return networks.update, networks.update != "list" and not failed, best * 1e6


def main(*, learners: tuple[int, ...] = (4, 32), repeats: int = 5, only: tuple[str, ...] = ()) -> None:
    """Print the table.

    Args:
        learners: how many agents learn at once, multiples of four.
        repeats: of which the best counts.
        only: which losses, by name; by default all.
    """
    if unknown := sorted(set(only) - set(ALGORITHMS)):
        raise SystemExit(f"--only names {', '.join(unknown)}; allowed: {', '.join(ALGORITHMS)}")
    table = Table(
        "loss", "update", "compiled", title=f"us an update of so many learners, batch {BATCH}, one thread"
    )
    for count in learners:
        table.add_column(f"{count}", justify="right", no_wrap=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for name in only or ALGORITHMS:
            measured = [process.submit(update_us, name, count, repeats).result() for count in learners]
            update, compiled, _ = measured[0]
            is_compiled = "yes" if compiled else "no"
            table.add_row(name, update, is_compiled, *(f"{us:,.0f}" for _, _, us in measured))
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
