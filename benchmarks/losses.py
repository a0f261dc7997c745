"""One update of many agents for each of TorchRL's losses: the way that it names, and microseconds.

One thread, batch 8, window 7 x 15 x 3, two hidden layers of 32 and 8 actions. There are four learners in each
replica of `commons`; those of VDN, QMIX, MAPPO, IPPO and MADDPG are a team of four. Each loss runs in a
process of its own, and the best of several repeats counts; what each compiles first takes up to a minute
where torch has no cache.

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
from tensordict import TensorDict

from cprl import presets
from cprl.algorithms.base import Algorithm
from cprl.algorithms.off_policy import CQL, DQN, IQL, PR2, SAC, DistributionalDQN
from cprl.algorithms.on_policy import A2C, PPO, Reinforce
from cprl.algorithms.teams import IPPO, MADDPG, MAPPO, QMIX, VDN
from cprl.learners.base import LearningAgents
from cprl.learners.engine import UpdateRule, make_engine
from cprl.learners.lanes import Lanes
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.learners.trial import trial_batch, trial_rollout
from cprl.policies.rng import WEIGHTS

REPLAY, ROLLOUTS = DQNSettings(), RolloutSettings()
ALGORITHMS = {
    "DQN": DQN(settings=REPLAY),
    "double DQN": DQN(settings=REPLAY, double=True),
    "DQN, Huber": DQN(settings=REPLAY, loss_function="smooth_l1"),
    "distributional DQN (C51)": DistributionalDQN(settings=REPLAY),
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


def lanes_of(algorithm: Algorithm, learners: int) -> Lanes:
    """So many learners, four in each replica of `commons`, as lanes or teams."""
    game = presets.game("commons")
    who = LearningAgents(game.spaces, agents=range(game.agents), replicas=learners // game.agents)
    return Lanes(who, algorithm.method(game.spaces))


def update_us(name: str, learners: int, repeats: int) -> tuple[str, bool, float]:
    """The way, whether it is compiled, and microseconds of one update of so many learners."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    algorithm = ALGORITHMS[name]
    lanes = lanes_of(algorithm, learners)
    form = lanes.form()

    def batch_of(count: int) -> TensorDict:
        batch = trial_batch(count, form, len(presets.game("commons").actions))
        return trial_rollout(batch) if isinstance(algorithm.settings, RolloutSettings) else batch

    assert algorithm.batching is not None
    update = make_engine(
        lanes.new_networks(WEIGHTS),
        algorithm.make_loss,
        UpdateRule(learning_rate=1e-5, adam_eps=1e-5),
        batching=algorithm.batching,
        compile=True,
    )
    batch, best = batch_of(len(lanes)), float("inf")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(10):
            update.update_from(batch.clone())
    for _ in range(repeats):
        turns, started = 0, time.perf_counter()
        while time.perf_counter() - started < 0.3:
            update.update_from(batch.clone())
            turns += 1
        best = min(best, (time.perf_counter() - started) / turns)
    failed = any("torch.compile failed" in str(one.message) for one in told)
    return algorithm.batching, algorithm.batching != "list" and not failed, best * 1e6


def main(*, learners: tuple[int, ...] = (4, 32), repeats: int = 5, only: tuple[str, ...] = ()) -> None:
    """Prints the table.

    Args:
        learners: how many agents learn at once, multiples of four.
        repeats: of which the best counts.
        only: which losses, by name; by default all.
    """
    if unknown := sorted(set(only) - set(ALGORITHMS)):
        raise SystemExit(f"--only names {', '.join(unknown)}; allowed: {', '.join(ALGORITHMS)}")
    table = Table(
        "loss", "way", "compiled", title=f"us an update of so many learners, batch {BATCH}, one thread"
    )
    for count in learners:
        table.add_column(f"{count}", justify="right", no_wrap=True)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for name in only or ALGORITHMS:
            measured = [process.submit(update_us, name, count, repeats).result() for count in learners]
            engine, compiled, _ = measured[0]
            cells = (f"{us:,.0f}" for _, _, us in measured)
            table.add_row(name, engine, "yes" if compiled else "no", *cells)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
