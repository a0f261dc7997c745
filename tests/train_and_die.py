"""A small training that goes on from its checkpoints; `test_checkpoints.py` kills it at random moments.

python tests/train_and_die.py RUN [seconds from one checkpoint to the next]
"""

import sys
from pathlib import Path

from dqn_parts import dqn_learner

from cprl import CommonsEnv, Game, Rules, maps
from cprl.learners.settings import DQNSettings
from cprl.policies.lanes import random_lanes
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.episodes import EpisodeTable
from cprl.runs.weights import save_weights
from cprl.system.process import prepare_process
from cprl.training import train

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=25, freeze_steps=2),
)
SETTINGS = DQNSettings(
    buffer_size=300,
    batch_size=4,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=20,
    epsilon_decay_steps=1000,
    target_every_episodes=2,
)


def main(
    run: Path, *, every_s: float = 0.05, episodes: int = 60, engine: str = "lane_axis", callbacks=()
) -> None:
    """Trains agent 0 of three replicas beside a random one."""
    prepare_process(3)
    learner = dqn_learner(
        GAME.spaces, agents=[0], replicas=3, settings=SETTINGS, seed=3, engine=engine, compile=False
    )
    walker = random_lanes(8, seeds=[(3, replica, 1) for replica in range(3)], agents=1)
    run.mkdir(exist_ok=True)
    with (
        Checkpointer(run, every_s=every_s, resume_command=f"python {sys.argv[0]} {run}") as checkpoints,
        EpisodeTable(run / "episodes.parquet", resumable=True) as table,
    ):
        env = CommonsEnv(GAME, 3, seed=3)
        train(
            env,
            {(0,): learner},
            others={(1,): walker},
            episodes=episodes,
            callbacks=[table, *callbacks],
            checkpointer=checkpoints,
        )
        save_weights(run, learner.networks())
        checkpoints.done()


class Telling:
    """Says when training has begun."""

    turns = 0

    def on_step(self, batch):
        self.turns += 1
        if self.turns == 1:
            print("training", flush=True)

    def on_episode(self, episode, learning):
        """Nothing."""


if __name__ == "__main__":
    every_s = float(sys.argv[2]) if len(sys.argv) > 2 else 0.05
    episodes = int(sys.argv[3]) if len(sys.argv) > 3 else 60
    main(Path(sys.argv[1]), every_s=every_s, episodes=episodes, callbacks=[Telling()])
    print("done", flush=True)
