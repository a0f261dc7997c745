"""Do cleverer agents fare worse? The width of the network's two hidden layers ("cognitive capability").

python recipes/study/network_width.py --jobs 2
"""

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    {"agents.*.algorithm.settings.hidden_cells": [(2, 2), (8, 8), (32, 32), (128, 128)]},
    name="network_width",
    question='What does the capability of the network ("cognitive capability") do to the commons?',
    expectation=(
        "The more capable the agents, the faster each learns to harvest and the deeper the tragedy: "
        "harvest and survival at the end fall with the width. Two units are too few to find apples: "
        "close to random play."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
