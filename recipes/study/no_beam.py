"""Does tagging the random agent prevent the tragedy? Experiment 4 with the beam and without.

    python recipes/study/no_beam.py --jobs 2

A DQN agent beside a random one on `two_complex` as run, 8 replicas of 1,000 episodes; the published
experiment has 6,000.
"""

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning, Scripted

SETTINGS = presets.dqn_settings("two_complex", variant="as_run")

STUDY = cprl.Study(
    cprl.Experiment(
        name="two_against_random",
        game=presets.game("two_complex", variant="as_run"),
        agents=(Learning(DQN(settings=SETTINGS)), Scripted("random")),
        episodes=1000,
        replicas=8,
    ),
    conditions={"beam": {}, "no beam": {"game.rules.may_fire": False}},
    name="no_beam",
    question="Does the learner of experiment 4 prevent depletion by tagging the random agent?",
    expectation=(
        "The study says so. If tagging is the cause, the stock lasts for less without a beam: survival is "
        "shorter and more episodes end empty. The collective harvest differs little, since a random agent "
        "takes a small part."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
