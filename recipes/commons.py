"""Experiment 5 of the study: four independent DQN agents on `commons`. Tragedy, or appropriation?

    python recipes/commons.py                          8 replicas of 4800 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace
from typing import Literal

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.learners.settings import Optimizer
from cprl.population import Learning


def experiment(
    *,
    variant: presets.Variant = "published",
    epsilon_decay_steps: int = 1_000_000,
    target_every_episodes: int = 3,
    gamma: float = 0.995,
    optimizer: Optimizer = "adam",
    loss_function: Literal["l1", "l2", "smooth_l1", "log_cosh"] = "l2",
) -> cprl.Experiment:
    """Train four independent DQN agents on `commons`.

    Args:
        variant: the rules and the learner as the study is written, or as it was run.
        epsilon_decay_steps: of exploration; versions of the study's program have 500,000 too.
        target_every_episodes: episodes between replacements of targets; the study's program has 3 or 10.
        gamma: the discount factor; versions of the study's program of April 2019 have 0.997.
        optimizer: "adam" or, as in some versions of the study's program of April 2019, "keras_rmsprop".
        loss_function: "l2", the squared error, or, as in some of the same versions, "log_cosh".
    """
    settings = replace(
        presets.dqn_settings("commons", variant=variant),
        epsilon_decay_steps=epsilon_decay_steps,
        target_every_episodes=target_every_episodes,
        gamma=gamma,
        optimizer=optimizer,
    )
    return cprl.Experiment(
        name="commons",
        game=presets.game("commons", variant=variant),
        agents=(Learning(DQN(settings=settings, loss_function=loss_function)),) * 4,
        episodes=4800,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
