"""One update of many independent DQN agents, in microseconds: gather, loss, backward, Adam.

One thread, batch 8, window 7 x 15 x 3, two hidden layers of 32 and 8 actions; replay buffers of 4096
transitions for each lane, filled beforehand. All ways in one run, each in a process of its own, as a
training is, the best of several repeats; each way compiles first, a quarter of a minute where nothing is in
torch's cache.

    make bench
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import torch
import tyro
from rich.console import Console
from rich.table import Table

from cprl.algorithms import DQN, DQNSettings
from cprl.learners.networks import LaneNetworks
from cprl.learners.optimizers import UpdateRule
from cprl.learners.ring import Ring
from cprl.learners.transitions import TransitionForm
from cprl.networks.mlp import MLPNetwork

SHAPE = (3, 7, 15)
ACTIONS = 8
BATCH = 8
TRANSITIONS = 4096

WAYS: dict[str, Callable[..., LaneNetworks]] = {
    "a list": partial(LaneNetworks, update="list"),
    "vmapped, compiled": partial(LaneNetworks, update="vmapped", compile=True),
    "stacked, not compiled": partial(LaneNetworks, update="stacked"),
    "stacked, compiled": partial(LaneNetworks, update="stacked", compile=True),
}
MEASURED_BEFORE = {  # on such a machine, before this library was begun
    "a list": (1388, 5292, 21_811, 89_852),
    "vmapped, compiled": (113, 285, 1008, 3361),
    "stacked, compiled": (86, 166, 459, 1471),
    "a C++ kernel for this network alone": (21, 67, 316, 1246),
}
LANES = (1, 4, 16, 64)


def filled(lanes: int) -> Ring:
    """Return a full buffer of noise."""
    form = TransitionForm(observation_shape=SHAPE)
    seeds = [(0, lane) for lane in range(lanes)]
    ring = Ring(form, seeds=seeds, transitions=TRANSITIONS, batch_size=BATCH)
    kept = ring.state_dict()
    state = kept["storage"]
    state["observation"] = torch.randint(256, (lanes, TRANSITIONS + 1, *SHAPE), dtype=torch.uint8)
    state["action"] = torch.randint(ACTIONS, (TRANSITIONS, lanes))
    state["reward"] = torch.rand(TRANSITIONS, lanes)
    state["done"] = state["terminated"] = torch.rand(TRANSITIONS, lanes) < 0.001
    state["row"] = torch.arange(TRANSITIONS)[:, None].repeat(1, lanes)
    state["next_row"] = torch.full((lanes,), TRANSITIONS)
    state["written"] = TRANSITIONS
    ring.load_state_dict(kept)
    return ring


def update_us(way: str, lanes: int, repeats: int) -> float:
    """Return the microseconds of one update of all lanes, the best of several repeats."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    networks = [MLPNetwork(SHAPE, ACTIONS) for _ in range(lanes)]
    together = WAYS[way](
        networks, DQN(settings=DQNSettings(gamma=0.995)).make_loss, UpdateRule(learning_rate=1e-5)
    )
    buffer = filled(lanes)
    best = float("inf")
    for _ in range(20):
        together.learn(buffer.draw())
    for _ in range(repeats):
        turns = 0
        started = time.perf_counter()
        while time.perf_counter() - started < 0.3:
            together.learn(buffer.draw())
            turns += 1
        best = min(best, (time.perf_counter() - started) / turns)
    return best * 1e6


def add_rows(table: Table, rows: dict[str, Sequence[float]]) -> None:
    """Add a row for each way: microseconds and, in brackets, how many times as fast as the list."""
    reference = rows["a list"]
    for name, row in rows.items():
        cells = (f"{us:,.0f} ({base / us:.0f}x)" for us, base in zip(row, reference, strict=True))
        table.add_row(name, *cells)


def main(*, lanes: tuple[int, ...] = LANES, repeats: int = 5) -> None:
    """Print the table.

    Args:
        lanes: how many agents learn at once.
        repeats: of which the best counts.
    """
    rows: dict[str, list[float]] = {name: [] for name in WAYS}
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as process:
        for count in lanes:
            for name, row in rows.items():
                row.append(process.submit(update_us, name, count, repeats).result())
    table = Table("microseconds an update", title="one update of so many lanes, one thread")
    for count in lanes:
        table.add_column(f"{count}", justify="right", no_wrap=True)
    add_rows(table, rows)
    if lanes == LANES:
        table.add_section()
        table.add_row("measured before this library:")
        add_rows(table, MEASURED_BEFORE)
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
