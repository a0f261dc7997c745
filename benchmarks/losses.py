"""One update of many agents for each of TorchRL's losses: the way that is found, and microseconds.

One thread, batch 8, window 7 x 15 x 3, two hidden layers of 32 and 8 actions; each loss in a process of its
own, the best of several repeats; what each compiles first takes up to a minute where torch has no cache.

    make bench
"""

import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl import presets
from cprl.learning import (
    A2C,
    CQL,
    DQN,
    IQL,
    PPO,
    SAC,
    DistributionalDQN,
    DQNSettings,
    Reinforce,
    RolloutSettings,
)
from cprl.learning.rollouts import trial_rollout
from cprl.learning.ways import fitting_way, make_update, trial_batch

REPLAY, ROLLOUTS = DQNSettings(), RolloutSettings()
ALGORITHMS = {
    "DQN": DQN(settings=REPLAY),
    "double DQN": DQN(settings=REPLAY, double=True),
    "DQN, Huber": DQN(settings=REPLAY, loss_function="smooth_l1"),
    "distributional DQN (C51)": DistributionalDQN(settings=REPLAY),
    "CQL": CQL(settings=REPLAY),
    "SAC": SAC(settings=REPLAY),
    "IQL": IQL(settings=REPLAY),
    "PPO": PPO(settings=ROLLOUTS),
    "A2C": A2C(settings=ROLLOUTS),
    "REINFORCE": Reinforce(settings=ROLLOUTS),
}
BATCH = 8


def update_us(name: str, lanes: int, repeats: int) -> tuple[str, bool, float]:
    """The way, whether it is compiled, and microseconds of one update of all lanes."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    game, algorithm = presets.game("commons"), ALGORITHMS[name]

    def batch_of(count: int) -> object:
        batch = trial_batch(count, game.observation_shape, len(game.actions))
        return trial_rollout(batch) if isinstance(algorithm.settings, RolloutSettings) else batch

    networks = [algorithm.network(game) for _ in range(lanes)]
    way = fitting_way(networks[:2], algorithm.loss, batch_of(2))
    update = make_update(
        way, networks, algorithm.loss, compile=True, trial=batch_of(2), learning_rate=1e-5, adam_eps=1e-5
    )
    batch, best = batch_of(lanes), float("inf")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(10):
            update.learn_from(batch.clone())
    for _ in range(repeats):
        turns, started = 0, time.perf_counter()
        while time.perf_counter() - started < 0.3:
            update.learn_from(batch.clone())
            turns += 1
        best = min(best, (time.perf_counter() - started) / turns)
    failed = any("torch.compile failed" in str(one.message) for one in told)
    return way, way != "list" and not failed, best * 1e6


def main(*, lanes: tuple[int, ...] = (4, 32), repeats: int = 5, only: tuple[str, ...] = ()) -> None:
    """Prints the table.

    Args:
        lanes: how many agents learn at once.
        repeats: of which the best counts.
        only: which losses, by name; by default all.
    """
    table = Table(
        "loss", "way", "compiled", title=f"us an update of so many lanes, batch {BATCH}, one thread"
    )
    for count in lanes:
        table.add_column(f"{count}", justify="right", no_wrap=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for name in only or ALGORITHMS:
            measured = [process.submit(update_us, name, count, repeats).result() for count in lanes]
            way, compiled, _ = measured[0]
            cells = (f"{us:,.0f}" for _, _, us in measured)
            table.add_row(name, way, "yes" if compiled else "no", *cells)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
