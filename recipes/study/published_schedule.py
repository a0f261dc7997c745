"""Do the answers of the short schedule hold at the published one? Time-out, beam and discount.

    python recipes/study/published_schedule.py --jobs 2

Each condition, of 4,800 episodes, takes two to three hours of a core. The one that changes nothing is
experiment 5 as run, whose results are committed; a study finds it finished in its directory of runs after

    cp -r docs/results/commons studies/runs/dfd7ebd751a3-s0-r8
"""

from base import PUBLISHED

import cprl

STUDY = cprl.Study(
    PUBLISHED,
    conditions={
        "experiment 5 as run": {},
        "time-out of 100": {"game.rules.freeze_steps": 100},
        "no beam": {"game.rules.may_fire": False},
        "gamma 0.95": {"agents.*.algorithm.settings.gamma": 0.95},
    },
    name="published_schedule",
    question="Do the answers of the short schedule hold at the published one?",
    expectation=(
        "In sign, not in size: a time-out of 100 gives a higher harvest and survival than 25 at the "
        "end, no beam a lower one, and gamma 0.95 the deepest tragedy and no recovery. All fall later "
        "than on the short schedule, after exploration has ended."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
