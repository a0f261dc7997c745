"""Two agents on `two_complex` that learn by one of six losses of TorchRL's; another loss is another line.

    python recipes/swap_the_loss.py --loss dqn              5 replicas of 1000 episodes
    python recipes/swap_the_loss.py --loss ppo

A loss of your own is a line too: docs/algorithms.md has one of twenty lines.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import tyro

from cprl import presets
from cprl.algorithms.actor_critic import IQL, SAC
from cprl.algorithms.dqn import CQL, DQN
from cprl.algorithms.on_policy import PPO
from cprl.experiment import conduct
from cprl.learners.settings import RolloutSettings
from cprl.population import Learner, Population
from cprl.process import prepare_process
from cprl.runs.directory import start_run
from cprl.viewer.streams import check_watch

REPLAY = replace(presets.learner("two_complex"), learning_rate=1e-4, epsilon_decay_steps=100_000)
"""The published settings, but for a schedule that fits 1000 episodes: ten times the step, a fifth of the
decay."""

LOSSES = {
    "dqn": DQN(settings=REPLAY),
    "double_dqn": DQN(settings=REPLAY, double=True),
    "cql": CQL(settings=REPLAY),
    "sac": SAC(settings=REPLAY),
    "iql": IQL(settings=REPLAY),
    "ppo": PPO(settings=RolloutSettings()),
}


def main(
    *,
    loss: Literal["dqn", "double_dqn", "cql", "sac", "iql", "ppo"] = "dqn",
    replicas: int = 5,
    episodes: int = 1000,
    evaluation_episodes: int = 20,
    seed: int = 0,
    out: Path | None = None,
    resume: bool = False,
    watch: str = "file",
    compile: bool = True,
) -> Path:
    """Trains both agents of all replicas, evaluates them on fresh worlds, and returns the run's directory.

    Args:
        loss: by which both learn.
        replicas: independent repetitions of the whole training, side by side.
        episodes: how many each trains.
        evaluation_episodes: fresh episodes for each replica, and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        resume: with the run in `out`, which was stopped; bit for bit as if it had not been.
        watch: "file", or live as well: "serve", "spawn", "connect ADDRESS"; "off" for no recording.
        compile: whether torch compiles the update; needs a C++ compiler, and is several times faster.
    """
    check_watch(watch)
    prepare_process(seed)
    game, name = presets.game("two_complex"), f"swap_the_loss_{loss}"
    population = Population(game, [Learner(LOSSES[loss])] * 2, replicas=replicas, seed=seed, compile=compile)
    recipe = {"replicas": replicas, "episodes": episodes, "seed": seed, "game": game}
    run = start_run(out, name, {**recipe, "population": population.told()}, resume=resume)
    return conduct(
        run,
        population,
        episodes=episodes,
        title=f"two_complex, {loss}, {replicas} replicas, {episodes} episodes",
        evaluation_episodes=evaluation_episodes,
        watch=watch,
    )


if __name__ == "__main__":
    tyro.cli(main)
