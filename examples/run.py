"""How to describe an experiment, train its agents and read what they did.
Prints what all agents together harvest in the first and in the last episodes."""

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning
from cprl.runs.curves import curves_of

# A is a site where an apple grows, an arrow an agent who faces that way.
BOARD = """
.A>.A.
AA..AA
.A.<A.
"""
# An apple grows back in a turn by these chances, where 0, 1, and 2 or more apples are near.
game = Game(map=maps.parse(BOARD), rules=Rules(regrow_prob=(0.02, 0.1, 0.2), episode_steps=50))
settings = DQNSettings(learning_rate=1e-3, gamma=0.9, epsilon_decay_steps=500, target_every_episodes=2)
agent = Learning(DQN(settings=settings))

experiment = cprl.Experiment(
    name="run",
    game=game,
    agents=(agent, agent),  # each learns on its own
    episodes=20,
    replicas=2,  # of the whole training, by which intervals are made
    evaluation_episodes=5,  # in fresh worlds, after the training
)
run = cprl.run(experiment, watch="off")  # a new directory in runs/; watch="serve" shows it live

harvest = curves_of(run)["collective_return"]  # float64 [replicas, episodes]
print(f"{run}: {harvest[:, :5].mean():.1f} apples at first, {harvest[:, -5:].mean():.1f} in the end")
