"""How to measure trained agents in fresh worlds, and beside agents who act at random.
Prints what they harvest, how much more than at random, and the rewards of a few turns."""

import cprl
from cprl import Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning

game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(episode_steps=50))
agent = Learning(DQN(settings=DQNSettings(learning_rate=1e-3, gamma=0.9, epsilon_decay_steps=300)))
experiment = cprl.Experiment(name="evaluate", game=game, agents=(agent, agent), episodes=10, replicas=3)
run = cprl.run(experiment, watch="off", figures=False)

# Any run's directory, also one of docs/results. Each replica plays 10 episodes in worlds of its own.
table = cprl.evaluate_run(run, cprl.Fresh(episodes=10, greedy=True))  # a row for each episode and agent
for (policy, name), apples in cprl.estimates(table, "collective_return", by="policy").items():
    print(f"{name}, {policy}: {apples.value:.1f} [{apples.low:.1f}, {apples.high:.1f}]")
more = cprl.differences(table, "collective_return", by="policy", reference={"policy": "random"})
for (policy, name), apples in more.items():
    print(f"{name}, {policy} - random: {apples.value:+.1f} [{apples.low:+.1f}, {apples.high:+.1f}]")

# The agents of replica 0, as a TorchRL policy in four worlds.
loaded = cprl.load(run)
steps = loaded.env(worlds=4).rollout(10, loaded.policy(0, worlds=4), break_when_any_done=False)
print(steps["next", "agents", "reward"].sum(1).squeeze(-1))  # [4 worlds, 2 agents]
