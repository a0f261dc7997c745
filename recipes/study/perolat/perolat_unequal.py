"""Four rooms of which one regrows faster: are agents less equal than with four equal rooms?

    python recipes/study/perolat/perolat_unequal.py --jobs 2 --runs studies/runs

Equal rooms are the walls of perolat_walls.py, whose runs are shared by `--runs`. See perolat_base.py.
Four conditions, at most 7 core hours; half of them are shared.
"""

from perolat_base import BEAMS, EXPERIMENT

import cprl
from cprl import maps

STUDY = cprl.Study(
    EXPERIMENT,
    {
        "game.rules.beam_length_cells": list(BEAMS),
        "rooms": {
            "equal": {"game.map": maps.rooms("single")},
            "unequal": {"game.map": maps.rooms("unequal")},
        },
    },
    name="perolat_unequal",
    question="Does it make agents less equal that one of four rooms is richer?",
    expectation=(
        "After Perolat et al.: who holds the richer room harvests more than others and keeps them out, so "
        "equality is lower than with equal rooms. The harvest of all is higher, since the richer room "
        "regrows faster; the three agents who begin in it harvest more than the mean of all."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
