"""What it costs to keep a run safe: checksums, syncing and the search for NaN, beside the training itself.

`commons` with 4 DQN agents and 8 replicas, 32 lanes, compiled, one thread, with full replay buffers of
100,000 transitions (1 GB). Each part is timed with and without what keeps it safe, in turns within one
process, and counts by its median difference:

- the journal of episodes, with a CRC-32 for each episode, against the same rows without;
- the syncing of the journal before a checkpoint, against none; a checkpoint itself, of more than a second and
  as long as before, varies by more than that;
- the search for NaN and infinity in all weights, at every episode's end and before every checkpoint, against
  none.

The sum is given as a share of the time in which they fall due: checkpoints every five minutes, and an episode
of all replicas every so many seconds as the training itself takes. The checkpoint at the end of a run, from
which it can be extended, is one more of them in the whole run; it is told apart.

    python benchmarks/keeping.py
"""

import shutil
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final
from unittest.mock import patch

import tyro
from rich.console import Console
from rich.table import Table

from cprl import CommonsEnv, presets
from cprl.learners.replay import ReplayLearner
from cprl.measuring.episodes import Episode
from cprl.process import prepare_process
from cprl.runs import journal
from cprl.runs.checkpoints import EVERY_S, Checkpointer
from cprl.runs.episodes import EpisodeTable
from cprl.training import Training

AGENTS: Final = (0, 1, 2, 3)
REPLICAS: Final = 8


class _Collecting:
    """Keeps the episodes, and the latest step."""

    def __init__(self) -> None:
        self.episodes: list[Episode] = []
        self.batch: Any = None

    def on_step(self, batch: Any) -> None:
        self.batch = batch

    def on_episode(self, episode: Episode, learning: Any) -> None:
        self.episodes.append(episode)


def seconds(do: Callable[[], object]) -> float:
    started = time.perf_counter()
    do()
    return time.perf_counter() - started


def in_turns(
    do: Callable[[], object], without: Callable[[], AbstractContextManager[Any]], repeats: int
) -> tuple[float, float]:
    """The median time of something, and of what it takes longer than without, in seconds."""
    times, differences = [], []
    for _ in range(repeats):
        with without():
            plain = seconds(do)
        times.append(seconds(do))
        differences.append(times[-1] - plain)
    return median(times), median(differences)


def without_crc() -> AbstractContextManager[Any]:
    """The journal as it was: a batch alone."""
    return patch.object(journal, "_message", lambda batch, header: memoryview(batch.serialize()))


def main(*, repeats: int = 9, steps: int = 1000) -> None:
    """Prints the table.

    Args:
        repeats: of which the median counts.
        steps: of the training, timed for the length of an episode.
    """
    prepare_process(0)
    game = presets.game("commons")
    learner = ReplayLearner(
        game.spaces, agents=AGENTS, replicas=REPLICAS, settings=presets.dqn_settings("commons")
    )
    seen = _Collecting()
    training = Training(
        CommonsEnv(game, REPLICAS, seed=0), {AGENTS: learner}, episodes=10**9, callbacks=[seen]
    )
    while not seen.episodes:
        training.step()
    capacity = learner.settings.buffer_size
    while learner.steps < capacity:
        learner.store(seen.batch)
    episode_s = seconds(lambda: [training.step() for _ in range(steps)]) * game.rules.episode_steps / steps
    with TemporaryDirectory() as folder:
        rows = _measure(Path(folder), training, seen.episodes[:REPLICAS], repeats)
    _print(rows, episode_s)


def _measure(
    folder: Path, training: Training, episodes: list[Episode], repeats: int
) -> dict[str, tuple[float, float]]:
    """The time of each part, and what safety adds to it, in seconds."""
    checkpointer = Checkpointer(folder, console=Console(quiet=True))
    rows = {}
    with EpisodeTable(folder / "episodes.parquet", resumable=True) as table:
        training.callbacks.append(table)

        def add() -> None:
            for episode in episodes:
                table.add(episode)

        def count() -> None:
            add()
            table.state_dict()

        def unsynced() -> AbstractContextManager[Any]:
            return patch.object(EpisodeTable, "state_dict", lambda table: {"rows": table._rows})

        rows["journal, an episode of all replicas"] = in_turns(add, without_crc, 20 * repeats)
        rows["syncing it, before a checkpoint"] = in_turns(count, unsynced, 20 * repeats)
        rows["checkpoint"] = seconds(lambda: checkpointer.save(training)), 0.0
        rows["search for NaN"] = seconds_of_search(training, repeats)
        size = max(path.stat().st_size for path in (folder / "checkpoints").iterdir())
        print(f"a checkpoint has {size / 1e9:.2f} GB; free: {shutil.disk_usage(folder).free / 1e9:.0f} GB")
    return rows


def seconds_of_search(training: Training, repeats: int) -> tuple[float, float]:
    """Of one search through the weights of all lanes; without it there is none."""
    taken, _ = in_turns(lambda: training.finite.check_weights(training.steps), nullcontext, 20 * repeats)
    return taken, taken


def _print(rows: dict[str, tuple[float, float]], episode_s: float) -> None:
    due_s = dict.fromkeys(("checkpoint", "syncing it, before a checkpoint"), EVERY_S)
    table = Table("part", title="32 lanes, full replay: what safety costs")
    for column in ("time, ms", "of it safety, ms", "due every, s", "share of the training"):
        table.add_column(column, justify="right")
    total = 0.0
    for name, (taken, added) in rows.items():
        every = due_s.get(name, episode_s)
        total += added / every
        table.add_row(
            name, f"{taken * 1e3:,.2f}", f"{added * 1e3:,.2f}", f"{every:,.1f}", f"{added / every:.4%}"
        )
    table.add_section()
    table.add_row("together", "", "", "", f"{total:.4%}")
    once = rows["checkpoint"][0] / (4800 * episode_s)
    table.add_row("the checkpoint at the end, once in 4,800 episodes", "", "", "", f"{once:.4%}")
    Console(width=120).print(table)


if __name__ == "__main__":
    tyro.cli(main)
