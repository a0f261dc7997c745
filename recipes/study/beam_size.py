"""How large should the beam be? Its length and width, three of each.

python recipes/study/beam_size.py --jobs 2
"""

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    {"game.rules.beam_length_cells": [2, 6, 12], "game.rules.beam_width_cells": [1, 3, 5]},
    name="beam_size",
    question="How does the outcome depend on the length and width of the beam?",
    expectation=(
        "The more cells a beam covers, the more agents are out of play, and the higher are harvest and "
        "survival. Length matters less than width, because agents meet at short distances."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
