"""Does looking further ahead save the commons? The discount factor, from none to the published one.

python recipes/study/discount.py --jobs 2
"""

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    {"agents.*.algorithm.settings.gamma": [0.0, 0.8, 0.95, 0.99, 0.995]},
    name="discount",
    question="Do agents who value the future more sustain the commons longer?",
    expectation=(
        "Not by foresight: others would take what one leaves. But a higher discount factor makes values "
        "harder to learn, so on a short schedule agents with 0.99 and 0.995 harvest less greedily and "
        "end at about the level of random play; with 0.8 and 0.95 the tragedy is deepest, and agents "
        "without any foresight harvest only what lies before them and drain less."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
