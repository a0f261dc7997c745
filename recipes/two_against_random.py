"""Experiment 4 of the study: a DQN agent beside a random walker on `two_complex`.

    python recipes/two_against_random.py                          8 replicas of 6000 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning, Scripted


def experiment(*, variant: presets.Variant = "published") -> cprl.Experiment:
    """Train a DQN agent beside a random walker on `two_complex`.

    Args:
        variant: the rules and the learner as the study is written, as it was run, or as an earlier version of
            its program (docs/game.md).
    """
    settings = presets.dqn_settings("two_complex", variant=variant)
    return cprl.Experiment(
        name="two_against_random",
        game=presets.game("two_complex", variant=variant),
        agents=(Learning(DQN(settings=settings)), Scripted("random")),
        episodes=6000,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
