"""Experiment 2 of the study: one DQN agent alone on `single_complex`, where apples hang in nine crosses.

    python recipes/single_complex.py                          8 replicas of 6000 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning


def experiment(*, variant: presets.Variant = "published") -> cprl.Experiment:
    """Train one DQN agent alone on `single_complex`.

    Args:
        variant: the rules and the learner as the study is written, or as it was run.
    """
    settings = presets.dqn_settings("single_complex", variant=variant)
    return cprl.Experiment(
        name="single_complex",
        game=presets.game("single_complex", variant=variant),
        agents=(Learning(DQN(settings=settings)),),
        episodes=6000,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
