"""Four rooms with walls and without, the same apples: does it take walls to have a territory of one's own?

    python recipes/study/perolat/perolat_walls.py --jobs 2 --runs studies/runs

`cprl visits RUN --figure visits.png` draws where the agents of a run go. See perolat_base.py.
Four conditions, at most 7 core hours.
"""

from perolat_base import BEAMS, EXPERIMENT

import cprl
from cprl import maps

STUDY = cprl.Study(
    EXPERIMENT,
    {
        "game.rules.beam_length_cells": list(BEAMS),
        "rooms": {
            "no walls": {"game.map": maps.rooms("none")},
            "walls": {"game.map": maps.rooms("single")},
        },
    },
    name="perolat_walls",
    question="Do walls with one entrance to each room let agents exclude others, and what comes of it?",
    expectation=(
        "After Perolat et al.: where a room has one entrance, agents learn to keep others out. With walls "
        "cells are more exclusive, agents spend more of their time in the room in which they began, and more "
        "of the tags are in the territory of who fires. The stock lasts longer and the harvest is higher "
        "than without walls; equality is lower, since some hold a room and others none."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
