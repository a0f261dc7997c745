"""How to draw a picture of your own from the episodes of a run.
Prints where the picture is: the harvest of each agent, episode by episode, over replicas."""

import matplotlib.pyplot as plt

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
from cprl.runs.curves import curves_of

game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
experiment = cprl.Experiment(
    name="plot",
    game=game,
    agents=(Scripted("greedy"), Scripted("random")),
    episodes=20,
    replicas=8,
    evaluation_episodes=1,
)
run = cprl.run(experiment, watch="off", figures=False)

# Any number of docs/metrics.md by its name, float64 [replicas, episodes]; read_episodes(run) has the rows.
curves = curves_of(run)
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for agent, script in enumerate(["greedy", "random"]):
    returns = curves[f"return_{agent}"]
    error = returns.std(0, ddof=1) / len(returns) ** 0.5
    axes.plot(returns.mean(0), label=script)
    axes.fill_between(range(returns.shape[1]), returns.mean(0) - error, returns.mean(0) + error, alpha=0.3)
axes.set(xlabel="episode", ylabel="apples, mean and standard error")
axes.legend()
figure.savefig(run / "own.png")
print(run / "own.png")
