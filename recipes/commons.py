"""Experiment 5 of the study: four independent DQN agents on `commons`. Tragedy, or appropriation?

    python recipes/commons.py                          8 replicas of 4800 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning


def experiment(
    *,
    variant: presets.Variant = "published",
    epsilon_decay_steps: int = 1_000_000,
    target_every_episodes: int = 3,
) -> cprl.Experiment:
    """Four independent DQN agents on `commons`.

    Args:
        variant: the rules and the learner as the study is written, or as it was run.
        epsilon_decay_steps: of exploration; versions of the study's program have 500,000 too.
        target_every_episodes: episodes between replacements of targets; the study's program has 3 or 10.
    """
    settings = replace(
        presets.dqn_settings("commons", variant=variant),
        epsilon_decay_steps=epsilon_decay_steps,
        target_every_episodes=target_every_episodes,
    )
    return cprl.Experiment(
        name="commons",
        game=presets.game("commons", variant=variant),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=4800,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
