"""What does the beam do to the tragedy on the open map? Lengths of 10 and 20 cells, and no beam.

    python recipes/study/perolat/perolat_open.py --jobs 2 --runs studies/runs

Random agents are in the evaluation of every condition. See perolat_base.py.
Three conditions, at most 6 core hours.
"""

from perolat_base import BEAMS, EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        f"beam of {BEAMS[0]}": {},
        f"beam of {BEAMS[1]}": {"game.rules.beam_length_cells": BEAMS[1]},
        "no beam": {"game.rules.may_fire": False},
    },
    name="perolat_open",
    question="Do agents who learn fare worse on an open commons than random ones, and worst without a beam?",
    expectation=(
        "After Perolat et al.: agents first learn to harvest, then deplete the commons, and harvest less "
        "than random agents do. Agents who tag each other are fewer at a time, so the stock lasts longer: "
        "without a beam it is depleted sooner, survival and sustainability are lower, and so is the "
        "harvest. With the longer beam it lasts longer than with the shorter one."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
