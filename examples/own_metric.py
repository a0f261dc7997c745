"""How to measure a number of your own in each episode of a training and an evaluation.
Prints its mean over replicas, with its interval, for the agents of the experiment and for random ones."""

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted


def largest_share(episode):
    """Return the share of all harvested apples that the agent with most harvested."""
    return episode.harvest.max() / episode.harvest.sum()  # NaN, undefined, where nobody harvested


largest_share.title = "largest share of the harvest"  # in tables and figures; may be left out
largest_share.unit = "0 to 1"

game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
experiment = cprl.Experiment(
    name="own_metric",
    game=game,
    agents=(Scripted("greedy"), Scripted("random")),
    episodes=3,
    replicas=4,
    evaluation_episodes=5,
    metrics=(largest_share,),
)
run = cprl.run(experiment, watch="off")  # its table, figure and recording have the metric

table = cprl.evaluate_run(run, cprl.Fresh(episodes=10))
for (policy, name), share in cprl.estimates(table, "largest_share", by="policy").items():
    print(f"{name}, {policy}: {share.value:.2f} [{share.low:.2f}, {share.high:.2f}]")
