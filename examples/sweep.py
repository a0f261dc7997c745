"""How to compare an experiment under several conditions, replica by replica.
Prints what agents harvest for each length of a time-out, and how that differs from the first."""

from datetime import datetime

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
from cprl.studies import InProcess

game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
experiment = cprl.Experiment(
    name="sweep",
    game=game,
    agents=(Scripted("aggressive"), Scripted("greedy")),  # or who learns
    episodes=5,
    evaluation_episodes=10,
)
study = cprl.Study(experiment, {"game.rules.freeze_steps": [2, 10, 25]}, replicas=4)

# Processes(2) trains two conditions at a time; a study that was stopped is finished by the same line.
out = f"studies/sweep_{datetime.now():%Y%m%d_%H%M%S}"
result = cprl.run_study(study, out, on=InProcess())

table = result.table.windows("evaluation")
for (condition, name), apples in cprl.estimates(table, "collective_return", by="condition").items():
    print(f"{name}, {condition}: {apples.value:.1f} [{apples.low:.1f}, {apples.high:.1f}]")
print(f"differences, figures and text: {result.out / 'summary.md'}")
