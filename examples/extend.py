"""How to train for longer when a run is finished, as if it had been so long from the start.
Prints that the extended training has the same episodes as one that was so long from the start."""

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import PPO, RolloutSettings
from cprl.population import Learning
from cprl.runs.episodes import read_episodes

game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
agent = Learning(PPO(settings=RolloutSettings(rollout_steps=50, minibatch_size=25)))
short = cprl.Experiment(name="extend", game=game, agents=(agent, agent), episodes=4, evaluation_episodes=2)
long = replace(short, episodes=8)

out = Path("runs", f"extend_{datetime.now():%Y%m%d_%H%M%S}")
# The state of the training, replay buffers included, may be hundreds of megabytes, so runs forget it.
extended = cprl.run(short, out / "extended", watch="off", keep_checkpoint=True)
cprl.run(long, extended, watch="off", resume=True)

whole = cprl.run(long, out / "whole", watch="off")
table, whole_table = (read_episodes(run).to_pylist() for run in (extended, whole))
print(f"the same episodes: {str(table) == str(whole_table)}")  # as text, since NaN is unequal to itself
