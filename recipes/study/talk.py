"""Does talk help? Agents who can send one of four signals, alone and under a quota.

python recipes/study/talk.py --jobs 2
"""

from base import EXPERIMENT

import cprl
from cprl.institutions import Quota

TALK = {"game.rules.signals": 4}
QUOTA = {"game.institutions": (Quota(share=0.25, window_steps=50, fine=1.0),)}

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={"silence": {}, "talk": TALK, "quota": QUOTA, "quota, talk": {**QUOTA, **TALK}},
    name="talk",
    question="Do agents who can talk keep a commons better, alone and with a quota that can be broken?",
    expectation=(
        "People who talk keep commons far better (Ostrom, Gardner and Walker, 1994). Independent learners "
        "share no language: a signal costs nothing, binds nobody, and means nothing at first, so no "
        "difference in harvest after fines or survival is expected, without and with the quota. What may "
        "differ comes from five times as many actions and four more planes: they learn more slowly, so the "
        "board lives somewhat longer."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
