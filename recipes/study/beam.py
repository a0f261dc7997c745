"""What if nobody can fire? The beam, none, and one that tags at its first hit.

python recipes/study/beam.py --jobs 2
"""

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        "beam": {},
        "no beam": {"game.rules.may_fire": False},
        "one hit tags": {"game.rules.hits_to_tag": 1},
    },
    name="beam",
    question="What if nobody can fire, or if one hit is enough?",
    expectation=(
        "Without the beam all agents are in play always: the stock falls faster, harvest and survival "
        "are lower than with it, equality is higher. Where one hit tags, fewer are in play, so harvest "
        "and survival are higher and peacefulness lower."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
