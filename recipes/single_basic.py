"""Experiment 1 of the study: one DQN agent alone on `single_basic`. Does it learn not to strip the board?

    python recipes/single_basic.py                          8 replicas of 6000 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning


def experiment(*, variant: presets.Variant = "published") -> cprl.Experiment:
    """Train one DQN agent alone on `single_basic`.

    Args:
        variant: the rules and the learner as the study is written, or as it was run.
    """
    settings = presets.dqn_settings("single_basic", variant=variant)
    return cprl.Experiment(
        name="single_basic",
        game=presets.game("single_basic", variant=variant),
        agents=(Learning(DQN(settings=settings)),),
        episodes=6000,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
