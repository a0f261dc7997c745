"""How good can a quota, sanctions and a tax be? The best that a search finds, beside what was chosen by hand.

    python recipes/study/best_rules.py --jobs 2

Four DQN agents on `commons` learn from sixteen worlds, on the schedule of recipes/tragedy.py. The best of
each kind was found by Optuna on the harvest after fines, in worlds of seeds that this study does not use:

    cprl search recipes/study/best_rules.py --rule quota --seed 5000 --points 16 --metric income
        --vary "game.institutions.0.share=uniform(0.1,0.8)" --vary game.institutions.0.fine=None,1,2,4
        --vary game.institutions.0.window_steps=10,25,50,100,200
    cprl search recipes/study/best_rules.py --rule sanctions --seed 5000 --points 16 --metric income
        --vary game.institutions.1.freeze_steps=1x5x25x100,5x25x100x100,25x100x400x400,100x100x100x100
        --vary game.institutions.1.fines=0x0x0x0,0x1x2x4,1x2x4x8,2x2x2x2
        --vary game.institutions.1.recovery_steps=10,50,200,1000
    cprl search recipes/study/best_rules.py --rule tax --seed 5000 --points 12 --metric income
        --vary "game.institutions.0.rate=uniform(0,1)" --vary game.institutions.0.period_steps=1,10,100,1000
"""

from dataclasses import replace
from typing import Final, Literal

from base import TRAGEDY

import cprl
from cprl.institutions import GraduatedSanctions, Institution, Quota, Tax

Rule = Literal["none", "quota", "sanctions", "tax"]

QUOTA: Final = Quota(share=0.25, window_steps=50)
BROKEN: Final = replace(QUOTA, fine=0.0)
"""The same quota, which sanctions have to hold."""
BY_HAND: Final[dict[Rule, tuple[Institution, ...]]] = {
    "none": (),
    "quota": (QUOTA,),
    "sanctions": (
        BROKEN,
        GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), recovery_steps=50),
    ),
    "tax": (Tax(rate=0.5),),
}
"""The settings of recipes/institutions.py; of the tax a rate in the middle of what its votes decide on."""
BEST: Final[dict[Rule, tuple[Institution, ...]]] = {
    "quota": (Quota(share=0.385191, window_steps=25),),
    "sanctions": (
        BROKEN,
        GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 0, 0, 0), recovery_steps=50),
    ),
    "tax": (Tax(rate=0.770762, period_steps=1),),
}
"""The settings that the searches found."""


def experiment(*, rule: Rule = "none") -> cprl.Experiment:
    """Return four DQN agents on `commons` under a rule as it was chosen by hand, or under none.

    Args:
        rule: which one.
    """
    game = replace(TRAGEDY.game, institutions=BY_HAND[rule])
    return replace(TRAGEDY, name=f"best_rules_{rule}", game=game)


STUDY = cprl.Study(
    experiment(),
    conditions={
        "none": {},
        **{f"{rule}, by hand": {"game.institutions": BY_HAND[rule]} for rule in BEST},
        **{f"{rule}, best found": {"game.institutions": best} for rule, best in BEST.items()},
    },
    replicas=8,
    name="best_rules",
    question="How much better are a quota, sanctions and a tax that were searched than those chosen by hand?",
    expectation=(
        "Less better in these worlds than in those of the search, where the best was chosen by chance, too. "
        "The quota gains some tenth, since its share is half as large again; sanctions lose nothing by "
        "giving up their fines, which only take from the harvest. Before the search no tax was expected to "
        "do much, since votes on one did not; it found 488 apples for 77 % in every turn where no other tax "
        "gave more than 301, and a tax of half in every turn, by hand, is expected in between. What all pay "
        "and all share is nearly equal, so there equality costs nothing; the looser quota is a little less "
        "equal than the tighter."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
