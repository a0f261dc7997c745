"""How rich must a resource be to survive its users? All regrowth probabilities, halved to quadrupled.

python recipes/study/regrowth.py --jobs 2
"""

import numpy as np
from base import EXPERIMENT

import cprl

PROBS = np.array(EXPERIMENT.game.rules.regrow_prob)
TIMES = (0.25, 0.5, 1.0, 2.0, 4.0)

STUDY = cprl.Study(
    EXPERIMENT,
    {
        "regrowth": {
            f"{times:g}": {"game.rules.regrow_prob": tuple((times * PROBS).tolist())} for times in TIMES
        }
    },
    reference="regrowth=1",
    name="regrowth",
    question="How does the tragedy depend on how fast apples regrow?",
    expectation=(
        "Harvest rises more than in proportion to regrowth, because a stock that lasts regrows longer. "
        "There is a threshold, between one and four times the published rate, above which agents with "
        "the beam cannot drain the board and survival is the whole episode; below the published rate all "
        "is gone early."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
