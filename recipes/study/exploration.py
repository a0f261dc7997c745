"""Is the tragedy an artefact of the end of exploration? The steps over which epsilon decays.

    python recipes/study/exploration.py --jobs 2

300 episodes instead of 200, so that those who explore longest have time after it.
"""

from dataclasses import replace

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    replace(EXPERIMENT, episodes=300),
    {"agents.*.algorithm.settings.epsilon_decay_steps": [10_000, 50_000, 100_000, 200_000]},
    name="exploration",
    reference="epsilon_decay_steps=100000",
    question="Is the tragedy an artefact of the end of exploration?",
    expectation=(
        "The peak of the harvest and the fall after it move with the decay, because random actions leave "
        "apples standing. The end does not: once epsilon is at its end the harvest is the same however "
        "long exploration took. So the end of exploration decides when the tragedy comes, not whether."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
