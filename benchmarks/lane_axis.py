"""Is the lane axis worth its code? One update of all lanes, with a lane axis and vmapped, in turns.

DQN, PPO, C51, IPPO and MAPPO on the board of the study, windows 7 x 15 x 3, one thread, compiled where torch
can: for each algorithm and number of lanes (teams of four for IPPO and MAPPO) two engines with the same
weights and batches are timed alternately, and the gain of each is that of the medians. An engine that cannot
run a loss says so.

    python benchmarks/lane_axis.py --lanes 1 4 16 32 --pairs 15
"""

import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from statistics import median
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict

from cprl import presets
from cprl.algorithms import DQN, IPPO, MAPPO, PPO, DistributionalDQN, DQNSettings, RolloutSettings
from cprl.learners.buffer.sampler import lane_buffer
from cprl.learners.engine.base import Engine
from cprl.learners.engine.choice import EngineName, make_engine, trial_batch
from cprl.learners.lanes import WEIGHTS
from cprl.learners.rollouts import trial_rollout
from cprl.learners.teams import lanes_of

REPLAY, ROLLOUTS = DQNSettings(buffer_size=4096), RolloutSettings()
MEMBERS = 4
ALGORITHMS: dict[str, Any] = {
    "DQN": DQN(settings=REPLAY),
    "PPO": PPO(settings=ROLLOUTS),
    "C51": DistributionalDQN(settings=REPLAY),
    "IPPO": IPPO(settings=ROLLOUTS),
    "MAPPO": MAPPO(settings=ROLLOUTS),
}
AXIS: dict[str, EngineName] = dict.fromkeys(ALGORITHMS, "lane_axis") | {"C51": "lane_axis_flat"}


@dataclass(frozen=True)
class Measured:
    """Medians in microseconds; None with the reason where an engine cannot run the loss."""

    lane_axis: float | None
    vmapped: float | None
    reason: str = ""


class Timed:
    """An engine, and an update of it from a batch of the size of its algorithm's."""

    def __init__(self, name: str, engine: EngineName, lanes: int) -> None:
        algorithm = ALGORITHMS[name]
        game = presets.game("commons")
        spaces, is_team = game.spaces, name in ("IPPO", "MAPPO")
        made = lanes_of(
            spaces,
            agents=range(MEMBERS) if is_team else (0,),
            replicas=lanes,
            seed=0,
            first_replica=0,
            make_network=partial(algorithm.make_network, spaces),
            make_team=partial(algorithm.make_team, spaces=spaces) if is_team else None,
            stochastic=False,
        )
        shapes = {"observation_shape": made.observation_shape, "action_shape": made.action_shape}
        trial = trial_batch(lanes, actions=spaces.actions, **shapes)
        settings = algorithm.settings
        if isinstance(settings, RolloutSettings):
            repeats = -(-settings.minibatch_size // trial.shape[1])
            trial = trial_rollout(torch.cat([trial] * repeats, 1)[:, : settings.minibatch_size].contiguous())
        self._batch: TensorDict = trial
        self._buffer = lane_buffer(
            seeds=made.seeds(3), transitions=4096, batch_size=REPLAY.batch_size, **shapes
        )
        transitions = trial_batch(lanes, actions=spaces.actions, **shapes)
        for place in range(64):
            self._buffer.storage.set(place, transitions[:, place % transitions.shape[1]])
        self._samples = isinstance(settings, DQNSettings)
        self.engine: Engine = make_engine(
            engine,
            made.new_networks(WEIGHTS, "cpu"),
            algorithm.make_loss,
            learning_rate=settings.learning_rate,
            compile=True,
            trial=trial,
        )

    def update(self) -> None:
        """One update: from the replay buffer, or on a minibatch of a rollout."""
        if self._samples:
            self.engine.update(self._buffer)
        else:
            self.engine.update_from(self._batch)

    def spent_us(self, updates: int) -> float:
        """Microseconds for one of so many updates."""
        begun = time.perf_counter()
        for _ in range(updates):
            self.update()
        return (time.perf_counter() - begun) / updates * 1e6


def measure(name: str, lanes: int, *, pairs: int, updates: int) -> Measured:
    """Both engines of an algorithm in turns, in a process of their own."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    engines: dict[str, Timed] = {}
    reasons = []
    for engine in (AXIS[name], "vmapped"):
        try:
            timed = Timed(name, engine, lanes)  # type: ignore[arg-type]
            timed.spent_us(3)
        except Exception as error:  # a loss that an engine cannot run
            reasons.append(f"{engine}: {(str(error) or repr(error)).split(' (')[0][:60]}")
            continue
        engines["vmapped" if engine == "vmapped" else "lane_axis"] = timed
    spent: dict[str, list[float]] = {engine: [] for engine in engines}
    for pair in range(pairs):
        for engine in list(engines)[:: 1 if pair % 2 == 0 else -1]:
            spent[engine].append(engines[engine].spent_us(updates))
    medians = {engine: median(times) for engine, times in spent.items() if times}
    return Measured(medians.get("lane_axis"), medians.get("vmapped"), "; ".join(reasons))


def main(
    lanes: tuple[int, ...] = (1, 4, 16, 32),
    algorithms: tuple[str, ...] = tuple(ALGORITHMS),
    pairs: int = 15,
    updates: int = 100,
) -> None:
    """Prints the medians and the gain of the lane axis.

    Args:
        lanes: how many.
        algorithms: which.
        pairs: times that each engine is measured, in turns.
        updates: in each measurement.
    """
    table = Table("algorithm", "lanes", "lane axis, µs", "vmapped, µs", "gain of the lane axis", "")
    for name in algorithms:
        for count in lanes:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found = pool.submit(measure, name, count, pairs=pairs, updates=updates).result()
            gain = (
                ""
                if not (found.lane_axis and found.vmapped)
                else f"{found.vmapped / found.lane_axis - 1:+.0%}"
            )
            shown = ["-" if us is None else f"{us:,.0f}" for us in (found.lane_axis, found.vmapped)]
            table.add_row(name, str(count), *shown, gain, found.reason)
    Console(width=140).print(table)


if __name__ == "__main__":
    tyro.cli(main)
