"""Unlike neighbours on `commons`: two DQN agents, one PPO agent and one that follows a rule, in one training.

    python recipes/mixed.py                               4 replicas of 500 episodes
    python recipes/mixed.py --neighbour greedy

Copy this file and change who plays: docs/algorithms.md lists who there is.
"""

from dataclasses import replace

import cprl
from cprl import presets
from cprl.algorithms import DQN, PPO, RolloutSettings
from cprl.policies.scripted import ScriptedPolicy
from cprl.population import Learning, Scripted


def experiment(*, neighbour: ScriptedPolicy = "sustainable") -> cprl.Experiment:
    """Train two DQN agents and one PPO agent beside one that follows a rule on `commons`.

    Args:
        neighbour: the rule that agent 3 follows.
    """
    settings = replace(presets.dqn_settings("commons"), learning_rate=1e-4, epsilon_decay_steps=100_000)
    dqn = Learning(DQN(settings=settings))
    ppo = Learning(PPO(settings=RolloutSettings()))
    return cprl.Experiment(
        name="mixed",
        game=presets.game("commons"),
        agents=(dqn, dqn, ppo, Scripted(neighbour)),
        episodes=500,
        replicas=4,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
