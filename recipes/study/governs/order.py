"""Does restraint that was learned under a rule outlast the rule?

    python recipes/study/governs/order.py --jobs 2

The design of M. A. Janssen, R. Holahan, A. Lee and E. Ostrom (Science 328, 2010), who gave groups of people a
rule in the first or in the second half of an experiment, with learners: rule then none, none then rule, rule
then rule, none then none, 400,000 steps each, for quotas of two sizes, sanctions without fines, and the best
tax. Learners, buffers, optimisers and exploration carry on; only the game changes. Where a rule shows agents
numbers, "none" is the same institution with a limit that nobody reaches, so that observations stay the same.
Talk, which the people had, is left out: what signals do among learners is in changes.py.

15 conditions of 800,000 steps, 8 replicas: some 1.3 core hours. Learners have no memory but their weights and
what their buffers hold for 6,250 turns, so history is expected to leave nothing. Contradicted by: an income
at the end that the first half of the training moves by more than the margin. How fast the harvest comes
back is in courses.parquet.
"""

from dataclasses import replace
from typing import Any, Final

from asking import EXPERIMENT, GAME, STEPS, Expectation, expected_text
from changes import LADDER, QUOTA

import cprl
from cprl import EarlierGame, Game
from cprl.institutions import Institution, Tax

OPEN: Final = 1000.0
"""A quota's share that nobody reaches."""
HELD: Final = (replace(QUOTA, fine=0.0), replace(LADDER, fines=(0, 0, 0, 0)))
"""A quota that sanctions without fines have to hold."""
RULES: Final[dict[str, tuple[Institution, ...]]] = {
    "quota 0.25": (QUOTA,),
    "quota 0.5": (replace(QUOTA, share=0.5),),
    "sanctions": HELD,
    "tax": (Tax(rate=0.77),),
}
NONE: Final[dict[str, tuple[Institution, ...]]] = {
    "quota 0.25": (replace(QUOTA, share=OPEN),),
    "quota 0.5": (replace(QUOTA, share=OPEN),),
    "sanctions": (replace(HELD[0], share=OPEN), HELD[1]),
    "tax": (Tax(rate=0.0),),
}
"""By rule: the same observations without it."""
WITHOUT: Final = {
    "quota 0.25": "no quota",
    "quota 0.5": "no quota",
    "sanctions": "no sanctions",
    "tax": "no tax",
}


def under(institutions: tuple[Institution, ...]) -> Game:
    return replace(GAME, institutions=institutions)


def halves(first: tuple[Institution, ...], second: tuple[Institution, ...]) -> dict[str, Any]:
    """Return the condition of a training whose rules change in its middle."""
    return {"game": under(second), "earlier": (EarlierGame(game=under(first), steps=STEPS),)}


def conditions() -> dict[str, dict[str, Any]]:
    table = {}
    for rule, institutions in RULES.items():
        without, none = WITHOUT[rule], NONE[rule]
        table[f"{rule}, then none"] = halves(institutions, none)
        table[f"none, then {rule}"] = halves(none, institutions)
        table[f"{rule}, then {rule}"] = halves(institutions, institutions)
        table[f"{without}, then {without}"] = halves(none, none)
    return table


EXPECTATIONS: Final = tuple(
    expected
    for rule in RULES
    for expected in (
        Expectation(
            label=f"{rule}, then none - never",
            more=(f"{rule}, then none",),
            less=(f"{WITHOUT[rule]}, then {WITHOUT[rule]}",),
            sign="same",
            why="the rule's restraint is forgotten",
        ),
        Expectation(
            label=f"none, then {rule} - always",
            more=(f"none, then {rule}",),
            less=(f"{rule}, then {rule}",),
            sign="same",
            why="the rule works on whom it meets",
        ),
    )
)

STUDY = cprl.Study(
    replace(EXPERIMENT, steps=2 * STEPS),
    conditions=conditions(),
    name="order",
    question="Does restraint that learners learned under a rule outlast the rule?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
