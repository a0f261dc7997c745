"""What watching costs: training time with the default recording against without, and the size of the file.

Time: the `commons` recipe (4 agents, 8 replicas, compiled) in one process, one thread. Blocks of 50 turns
with the recording and without take turns, in either order; their ratio counts over an episode's length of
each, the median of several, once for episodes whose frames are kept and once for the others, and both by how
many of 5,000 there are.

Size: 5,000 episodes of `commons` with 8 replicas are written. Those whose frames are kept are really played,
by agents that act at random; the numbers of the others are drawn from what was played before, with returns
that rise twelvefold, so that new bests are told as in a training that goes well. Numbers are flushed as often
as in a training on a busy machine, of 1.8 s an episode.

    make bench
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict, TensorDictBase

from cprl import CommonsEnv, presets
from cprl.learners.replay import ReplayLearner
from cprl.measuring import Episode
from cprl.policies.lanes import random_agents
from cprl.process import prepare_process
from cprl.training import Training
from cprl.viewer.callback import ViewerCallback

AGENTS: Final = (0, 1, 2, 3)
REPLICAS: Final = 8
EPISODES: Final = 5000
BLOCK: Final = 50
"""Turns; an episode's end falls on the last of an even number of pairs."""
EPISODE_S: Final = 1.8
FLUSHED_EVERY: Final = round(60 / EPISODE_S)
MOST_TIME, MOST_BYTES = 0.02, 100e6
"""What is allowed."""


def cost(run: Path, repeats: int) -> tuple[float, float, int]:
    """How many times as long an episode takes when it is recorded: with frames, and without; and of how many
    episodes one has its frames kept."""
    prepare_process(0)
    game = presets.game("commons")
    settings = replace(presets.dqn_settings("commons"), buffer_size=20_000)
    learner = ReplayLearner(game.spaces, agents=AGENTS, replicas=REPLICAS, settings=settings)
    env = CommonsEnv(game, REPLICAS, seed=0)
    training = Training(env, {AGENTS: learner}, episodes=10**9)
    steps = game.rules.episode_steps

    def seconds(watch: ViewerCallback | None) -> float:
        training.callbacks = [watch] if watch else []
        started = time.perf_counter()
        for _ in range(BLOCK):
            training.step()
        return time.perf_counter() - started

    def ratio(watch: ViewerCallback) -> float:
        """The last block of an episode is always one that is watched."""
        ratios = []
        for _ in range(repeats):
            spent = {True: 0.0, False: 0.0}
            for pair in range(steps // BLOCK):
                for watched in (False, True) if pair % 2 else (True, False):
                    spent[watched] += seconds(watch if watched else None)
            ratios.append(spent[True] / spent[False])
        return median(ratios)

    for _ in range(steps // BLOCK):
        seconds(None)
    with ViewerCallback(run, env, title="cost", episodes=EPISODES) as watch:
        every, watch.every = watch.every, 1
        shown = ratio(watch)
        watch.every = 10**9
        return shown, ratio(watch), every


class Witness:
    """Keeps the episodes that were played, and lets a watch see the turns."""

    def __init__(self, watch: ViewerCallback) -> None:
        self.watch = watch
        self.played: list[Episode] = []

    def on_step(self, batch: TensorDictBase) -> None:
        """Lets the watch see it."""
        self.watch.on_step(batch)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Keeps it."""
        self.played.append(episode)


def size(run: Path, episodes: int) -> tuple[int, int]:
    """Bytes of a recording of so many episodes, and the frames in it."""
    prepare_process(0)
    game = presets.game("commons")
    env = CommonsEnv(game, REPLICAS, seed=0)
    chance = np.random.default_rng(0)
    at_random = random_agents(game, AGENTS, replicas=REPLICAS, seed=0)
    with ViewerCallback(run, env, title="size", episodes=episodes) as watch:
        witness = Witness(watch)
        training = Training(env, {}, others=at_random, episodes=10**9, callbacks=[witness])
        unseen = TensorDict({}, [REPLICAS])
        for number in range(episodes):
            if watch.is_shown:
                for _ in range(game.rules.episode_steps):
                    training.step()
            else:
                witness.on_step(unseen)
            better = 0.1 + 1.1 * number / episodes
            for replica, nth in enumerate(chance.integers(len(witness.played), size=REPLICAS)):
                episode = witness.played[nth]
                metrics = {
                    **episode.metrics,
                    "collective_return": better * episode.metrics["collective_return"],
                }
                told = replace(episode, world=replica, episode=number, metrics=metrics)
                names = [f"agent_{agent}/{name}" for agent in AGENTS for name in ("loss", "epsilon", "q")]
                watch.on_episode(told, dict(zip(names, chance.random(len(names)).tolist(), strict=True)))
            if number % FLUSHED_EVERY == 0:
                watch.logger.flush()
    return watch.logger.path.stat().st_size, watch.logger.frames


def main(*, repeats: int = 12, episodes: int = EPISODES) -> None:
    """Prints the table; ends with exit code 1 where more is taken than is allowed.

    Args:
        repeats: of as many turns as an episode has with the recording, and as many without, for either kind.
        episodes: that are written.
    """
    with TemporaryDirectory() as folder:
        shown, others, every = cost(Path(folder), repeats)
    with TemporaryDirectory() as folder:
        size_bytes, frames = size(Path(folder), episodes)
    time_share = (shown + (every - 1) * others) / every - 1
    table = Table("watching `commons`, 8 replicas", "measured", "allowed", title="the default recording")
    table.add_row("time, episodes with frames", f"{shown - 1:+.1%}", "")
    table.add_row("time, episodes without", f"{others - 1:+.1%}", "")
    table.add_row(f"time, one in {every} with frames", f"{time_share:+.2%}", f"{MOST_TIME:.0%}")
    table.add_row(
        f"file of {episodes:,} episodes", f"{size_bytes / 1e6:.1f} MB", f"{MOST_BYTES / 1e6:.0f} MB"
    )
    table.add_row("frames in it", f"{frames:,}", "")
    Console().print(table)
    if time_share > MOST_TIME or size_bytes > MOST_BYTES:
        sys.exit("watching takes more than is allowed")


if __name__ == "__main__":
    tyro.cli(main)
