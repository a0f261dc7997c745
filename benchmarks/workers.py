"""Do worker processes help? Frames per second of `commons`, with a small policy.

    python benchmarks/workers.py --worlds 64 --workers 2

As many worlds each time: in one `CommonsEnv`, on one thread and on as many as there are workers; in a
`ParallelEnv`, whose workers play while the main process decides; in a `MultiSyncCollector`, whose workers do
both. Batches of 100 turns; the first is not counted, and the median of the others is printed.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.envs import ParallelEnv

from cprl import CommonsEnv, keys, presets

GAME = presets.game("commons")
TURNS = 100


class Policy(nn.Module):
    """Actions of all agents from their windows, uint8 [..., C, X, Y]."""

    def __init__(self) -> None:
        super().__init__()
        inputs = torch.Size(GAME.observation_shape).numel()
        self.layers = nn.Sequential(nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, len(GAME.actions)))

    def forward(self, windows: torch.Tensor) -> torch.Tensor:
        return torch.distributions.Categorical(logits=self.layers(windows.flatten(-3) / 255)).sample()


def frames_per_s(collector: BaseCollector, batches: int) -> float:
    """The median over batches; the first one starts the workers."""
    taken, before = [], None
    for number, batch in enumerate(collector):
        now = time.perf_counter()
        if before is not None:
            taken.append(batch.numel() / (now - before))
        before = now
        if number == batches:
            break
    collector.shutdown()
    return median(taken)


def main(*, worlds: int = 64, workers: int = 2, batches: int = 10) -> None:
    """Prints a line for each way.

    Args:
        worlds: in all.
        workers: processes, and threads of the second line; they divide the worlds.
        batches: to take the median of.
    """
    torch.set_num_threads(1)
    own = worlds // workers
    parts = [partial(CommonsEnv, GAME, own, seed=0, threads=1, first_world=own * i) for i in range(workers)]
    policy = TensorDictModule(Policy(), [keys.OBSERVATION], [keys.ACTION])
    plain = {"frames_per_batch": worlds * TURNS, "total_frames": -1, "auto_register_policy_transforms": False}
    ways: dict[str, Callable[[], BaseCollector]] = {
        "one CommonsEnv, 1 thread": lambda: Collector(CommonsEnv(GAME, worlds, threads=1), policy, **plain),
        f"one CommonsEnv, {workers} threads": lambda: Collector(
            CommonsEnv(GAME, worlds, threads=workers), policy, **plain
        ),
        f"ParallelEnv, {workers} workers": lambda: Collector(ParallelEnv(workers, parts), policy, **plain),
        f"MultiSyncCollector, {workers} workers": lambda: MultiSyncCollector(parts, policy, **plain),
    }
    print(f"{worlds} worlds, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    for name, make in ways.items():
        print(f"{name}: {frames_per_s(make(), batches):,.0f} frames/s", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
