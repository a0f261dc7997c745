"""A small training that is served live until it is ended; `test_viewers.py` looks at it with real viewers.

python tests/train_and_watch.py RUN
"""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

from cprl import CommonsEnv, presets
from cprl.learners.replay import ReplayLearner
from cprl.process import prepare_process
from cprl.training import train
from cprl.viewer.callback import ViewerCallback

AGENTS = (0, 1, 2, 3)


class Leisure:
    """Leaves the processor to viewers, which draw without a graphics card."""

    def on_step(self, batch):
        time.sleep(0.01)

    def on_episode(self, episode, learning):
        """Nothing."""


def main(run: Path, *, episodes: int = 4000) -> None:
    """Trains the four agents of two replicas in short episodes of the commons."""
    os.nice(15)
    prepare_process(5)
    game = presets.game("commons")
    game = replace(game, rules=replace(game.rules, episode_steps=100))
    settings = replace(presets.dqn_settings("commons"), buffer_size=2000, hidden_cells=(8,))
    agents = ReplayLearner(game.spaces, agents=AGENTS, replicas=2, settings=settings, seed=5, compile=False)
    env = CommonsEnv(game, 2, seed=5)
    with ViewerCallback(run, env, title="a live training", episodes=episodes, live="serve") as watch:
        train(env, {AGENTS: agents}, episodes=episodes, callbacks=[watch, Leisure()])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
