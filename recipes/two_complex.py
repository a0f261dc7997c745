"""Experiment 3 of the study: two independent DQN agents on `two_complex`. Do they share, or shoot?

    python recipes/two_complex.py                          8 replicas of 6000 episodes
    python recipes/two_complex.py --no-beam

Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning


def experiment(*, variant: presets.Variant = "published", beam: bool = True) -> cprl.Experiment:
    """Train two independent DQN agents on `two_complex`.

    Args:
        variant: the rules and the learner as the study is written, as it was run, or as an earlier version of
            its program (docs/game.md).
        beam: whether agents have the beam; without it nobody is tagged.
    """
    game = presets.game("two_complex", variant=variant)
    settings = presets.dqn_settings("two_complex", variant=variant)
    name = "two_complex" if beam else "two_complex_no_beam"
    return cprl.Experiment(
        name=name,
        game=replace(game, rules=replace(game.rules, may_fire=beam)),
        agents=(Learning(DQN(settings=settings)),) * 2,
        episodes=6000,
        replicas=8,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
