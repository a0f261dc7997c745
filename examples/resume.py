"""How to resume a training that was stopped, by Ctrl-C, a full disk or a cluster's time limit.
Prints that the resumed training has the same episodes as one that was never stopped."""

import signal
from datetime import datetime
from pathlib import Path

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning
from cprl.runs.episodes import read_episodes


class CtrlC:
    """A callback that stops the training after so many turns, as Ctrl-C does."""

    turns = 0

    def on_step(self, turn):
        self.turns += 1
        if self.turns == 130:
            signal.raise_signal(signal.SIGINT)


game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
agent = Learning(DQN(settings=DQNSettings(buffer_size=500)))
experiment = cprl.Experiment(
    name="resume", game=game, agents=(agent, agent), episodes=6, evaluation_episodes=2
)

out = Path("runs", f"resume_{datetime.now():%Y%m%d_%H%M%S}")
try:
    cprl.run(experiment, out / "stopped", watch="off", callbacks=[CtrlC()])
except KeyboardInterrupt:
    print(f"stopped; on the command line: cprl run {out / 'stopped'} --resume")
stopped = cprl.run(experiment, out / "stopped", watch="off", resume=True)

whole = cprl.run(experiment, out / "whole", watch="off")
parts = [str(read_episodes(run).to_pylist()) for run in (stopped, whole)]
print(f"the same episodes: {parts[0] == parts[1]}")  # as text, since NaN is unequal to itself
