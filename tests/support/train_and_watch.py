"""A small training that is served live, and afterwards until it is ended; for `test_real_viewers.py`.

python tests/support/train_and_watch.py RUN EPISODES
"""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import cprl
from cprl import Custom, Experiment, presets
from cprl.algorithms import DQN
from cprl.population import Learning


class Leisure:
    """Leaves the processor to viewers, which draw without a graphics card."""

    is_extendable = True

    def on_step(self, batch):
        time.sleep(0.01)


def main(run: Path, episodes: int) -> None:
    """Trains four agents in two replicas, in short episodes of the commons."""
    os.nice(15)
    game = presets.game("commons")
    settings = replace(presets.dqn_settings("commons"), buffer_size=2000, hidden_cells=(8,))
    experiment = Experiment(
        name="a live training",
        game=replace(game, rules=replace(game.rules, episode_steps=100)),
        agents=[Learning(DQN(settings=settings))] * 4,
        replicas=2,
        episodes=episodes,
        seed=5,
        evaluation_episodes=1,
        engine="eager",
        callbacks=[Custom("train_and_watch:Leisure")],
    )
    cprl.run(experiment, run, watch="serve", linger=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
