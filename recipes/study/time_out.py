"""How long should a tagged agent stay out? The time-out, from one turn to most of an episode.

python recipes/study/time_out.py --jobs 2
"""

from base import EXPERIMENT

import cprl

STUDY = cprl.Study(
    EXPERIMENT,
    {"game.rules.freeze_steps": [1, 5, 25, 100, 400]},
    name="time_out",
    question="What if tagged agents stay out longer?",
    expectation=(
        "The longer the time-out, the fewer agents are in play at once, so the slower the stock falls: "
        "harvest and survival rise with it, peacefulness falls. With one turn the beam is worth nothing "
        "and the tragedy is at its worst."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
