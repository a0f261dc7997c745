"""What watching costs: training time with the default recording against without, and the size of the file.

Time: the `commons` recipe (4 agents, 8 replicas, compiled) in one process, one thread. Blocks of 50 turns
with the recording and without take turns, in either order; their ratio counts over an episode's length of
each, the median of several, once for episodes whose frames are kept, once for the others, and both by how
many of 5,000 there are; and once for the others while the recording is served, with the exhibition, whose
clock stands still in blocks without.

Size: 5,000 episodes of `commons` with 8 replicas are written. Those whose frames are kept are really played,
by agents that act at random; the numbers of the others are drawn from what was played before, with returns
that rise twelvefold, so that new bests are told as in a training that goes well. Numbers are flushed as often
as in a training on a busy machine, of 1.8 s an episode.

    make bench
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
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
from cprl.algorithms import DQN
from cprl.experimental.current_policy import CurrentPolicy
from cprl.experimental.exhibition import EXHIBITED_WORLD, Exhibition
from cprl.measuring import Episode
from cprl.measuring.series import Observer
from cprl.population import Learning, Scripted
from cprl.system.process import prepare_process
from cprl.training import Schedule, Training
from cprl.training.agents import Population
from cprl.viewer.callback import ViewerCallback

AGENTS: Final = (0, 1, 2, 3)
REPLICAS: Final = 8
EPISODES: Final = 5000
BLOCK: Final = 50
"""Turns; the tenth and the twentieth pair of blocks end with an episode."""
EPISODE_S: Final = 1.8
FLUSHED_EVERY: Final = round(60 / EPISODE_S)
MOST_TIME: Final = 0.02
MOST_BYTES: Final = 100e6
"""The share of time and the size of a file that are allowed."""


@dataclass
class Cost:
    """The time of an episode that is watched, as a multiple of one that is not."""

    drawn: float
    """With frames in the file."""
    others: float
    """Without."""
    live: float
    """Without, but served, with the exhibition."""
    every: int
    """The number of episodes of which one has its frames kept."""
    steps_per_s: float
    """The steps of the exhibition in a second of the time that was watched."""

    def share(self, others: float) -> float:
        """Return what is added to the time of a training."""
        return (self.drawn + (self.every - 1) * others) / self.every - 1


class Watched:
    """A clock of the time that is watched, seconds."""

    def __init__(self) -> None:
        self.spent = 0.0
        self.began = None

    def __call__(self) -> float:
        since = 0.0 if self.began is None else time.perf_counter() - self.began
        return self.spent + since


def cost(run: Path, repeats: int) -> Cost:
    """Measure an episode's time, watched and not."""
    prepare_process(0)
    game = presets.game("commons")
    settings = replace(presets.dqn_settings("commons"), buffer_size=20_000)
    env = CommonsEnv(game, REPLICAS, seed=0)
    population = Population(env, [Learning(DQN(settings=settings))] * game.agents)
    training = Training(env, population.learners, Schedule(episodes=10**9))
    steps = game.rules.episode_steps

    clock = Watched()

    def seconds(watch: ViewerCallback | None) -> float:
        callbacks = [watch] if watch else []
        training.observer = Observer(callbacks, env)
        started = time.perf_counter()
        clock.began = started if watch else None
        for _ in range(BLOCK):
            training.step()
        spent = time.perf_counter() - started
        if watch:
            clock.spent += spent
            clock.began = None
        return spent

    def ratio(watch: ViewerCallback) -> float:
        """Return how many times as long blocks take that are watched.

        Episodes end in blocks that are watched and in others in turn: their end takes time anyway.
        """
        ratios = []
        for _ in range(repeats):
            spent = {True: 0.0, False: 0.0}
            for ends_watched in (True, False):
                for pair in range(steps // BLOCK):
                    for watched in (False, True) if pair % 2 == ends_watched else (True, False):
                        watching = watch if watched else None
                        spent[watched] += seconds(watching)
            ratios.append(spent[True] / spent[False])
        return median(ratios)

    for _ in range(steps // BLOCK):
        seconds(None)
    with ViewerCallback(run, env, title="cost", episodes=EPISODES) as watch:
        every = watch.schedule.every
        watch.schedule.every = 1
        drawn = ratio(watch)
        watch.schedule.every = 10**9
        others = ratio(watch)
    policy = CurrentPolicy(population)
    world = CommonsEnv(game, 1, seed=0, first_world=EXHIBITED_WORLD)

    def exhibit(trained, logger):
        return Exhibition(policy, world, trained=trained, logger=logger)

    options = {"title": "cost", "episodes": EPISODES, "live": "serve", "exhibit": exhibit}
    with ViewerCallback(run, env, **options) as watch:
        watch.schedule.every = 10**9
        watch.exhibition._clock = clock
        watch.exhibition._due = clock()
        before = watch.exhibition.steps, clock()
        live = ratio(watch)
        steps_per_s = (watch.exhibition.steps - before[0]) / (clock() - before[1])
    return Cost(drawn, others, live, every, steps_per_s)


class Witness:
    """A callback that keeps the episodes that were played, and lets a watch see the turns."""

    def __init__(self, watch: ViewerCallback) -> None:
        self.watch = watch
        self.played: list[Episode] = []

    def on_step(self, batch: TensorDictBase) -> None:
        """Let the watch see the turn."""
        self.watch.on_step(batch)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Keep the episode."""
        self.played.append(episode)


def size(run: Path, episodes: int) -> tuple[int, int]:
    """Return the bytes of a recording of so many episodes, and the frames in it."""
    prepare_process(0)
    game = presets.game("commons")
    env = CommonsEnv(game, REPLICAS, seed=0)
    rng = np.random.default_rng(0)
    at_random = Population(env, (Scripted(),) * game.agents).others
    with ViewerCallback(run, env, title="size", episodes=episodes) as watch:
        witness = Witness(watch)
        observer = Observer([watch], env)
        training = Training(env, {}, Schedule(episodes=10**9), others=at_random, callbacks=[witness])
        unseen = TensorDict({}, [REPLICAS])
        for number in range(episodes):
            if watch.schedule.is_shown(number):
                for _ in range(game.rules.episode_steps):
                    training.step()
            else:
                witness.on_step(unseen)
            better = 0.1 + 1.1 * number / episodes
            for replica, number_played in enumerate(rng.integers(len(witness.played), size=REPLICAS)):
                episode = witness.played[number_played]
                metrics = {
                    **episode.metrics,
                    "collective_return": better * episode.metrics["collective_return"],
                }
                better_episode = replace(
                    episode, world=replica, replica=replica, episode=number, metrics=metrics
                )
                names = [f"agent_{agent}/{name}" for agent in AGENTS for name in ("loss", "epsilon", "q")]
                observer.on_episode(
                    better_episode, dict(zip(names, rng.random(len(names)).tolist(), strict=True))
                )
            if number % FLUSHED_EVERY == 0:
                watch.logger.flush()
    return watch.logger.path.stat().st_size, watch.logger.frames


def main(*, repeats: int = 6, episodes: int = EPISODES) -> None:
    """Print the table; end with exit code 1 where more is taken than is allowed.

    Args:
        repeats: of two episodes with the recording, and two without, for each kind.
        episodes: that are written.
    """
    with TemporaryDirectory() as folder:
        time_of = cost(Path(folder), repeats)
    with TemporaryDirectory() as folder:
        size_bytes, frames = size(Path(folder), episodes)
    time_share = time_of.share(time_of.others)
    live_share = time_of.share(time_of.live)
    table = Table("watching `commons`, 8 replicas", "measured", "allowed", title="the default recording")
    table.add_row("time, episodes with frames", f"{time_of.drawn - 1:+.1%}", "")
    table.add_row("time, episodes without", f"{time_of.others - 1:+.1%}", "")
    table.add_row(
        f"time, the same served, exhibition at {time_of.steps_per_s:.1f} steps/s",
        f"{time_of.live - 1:+.1%}",
        "",
    )
    table.add_row(f"time, one in {time_of.every} with frames", f"{time_share:+.2%}", f"{MOST_TIME:.0%}")
    table.add_row("time, the same served, with the exhibition", f"{live_share:+.2%}", f"{MOST_TIME:.0%}")
    table.add_row(
        f"file of {episodes:,} episodes", f"{size_bytes / 1e6:.1f} MB", f"{MOST_BYTES / 1e6:.0f} MB"
    )
    table.add_row("frames in it", f"{frames:,}", "")
    Console().print(table)
    if max(time_share, live_share) > MOST_TIME or size_bytes > MOST_BYTES:
        sys.exit("watching takes more than is allowed")


if __name__ == "__main__":
    tyro.cli(main)
