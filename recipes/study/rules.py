"""Do the rules help that the study names and never ran? One may punish, fines for regions, a sure penalty.

python recipes/study/rules.py --jobs 2
"""

from base import EXPERIMENT

import cprl
from cprl.institutions import Boundaries, Institution, Quota, Sanctioner

BOARD = EXPERIMENT.game.map


def under(*institutions: Institution, **rules: object) -> dict[str, object]:
    """Return a condition of institutions, and of rules of the game that differ."""
    return {"game.institutions": institutions} | {
        f"game.rules.{name}": value for name, value in rules.items()
    }


STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        "none": {},
        "one may punish, harshly": under(Sanctioner(agents=(0,)), hits_to_tag=1, freeze_steps=100),
        "fines for regions": under(
            Boundaries.strips(height=BOARD.height, width=BOARD.width, agents=4, bite_fine=2.0, step_fine=0.1)
        ),
        "automatic penalty": under(Quota(share=0.25, window_steps=50, fine=2.0)),
    },
    name="rules",
    question="Do the rules help that the study proposes and did not run?",
    expectation=(
        "The study expects that a single agent with the power to punish keeps the others in check, that "
        "fines for wandering make agents keep to their region, and that a certain penalty ends the tragedy. "
        "Eight replicas of an audit, on another machine, got 214 [201, 227] apples with one who punishes, "
        "216 [208, 225] after fines with regions and 361 [344, 378] after fines with the penalty, where 191 "
        "come without a rule; the same order is expected here. The penalty works because a fine of 2 that "
        "is certain exceeds the apple that it is for; the regions live longer, and spend on fines what they "
        "gain; the one who punishes harvests more than each of the others."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
