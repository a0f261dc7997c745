"""How large must a tax be? Rates of 0 to 1 by tenths, of each bite, shared equally.

    python recipes/study/governs/tax_rate.py --jobs 2
    python recipes/study/governs/thresholds.py

What the margins of scripted agents predict (docs/results/governs/thresholds.md, computed before this study
ran): greed stops to pay among restrained agents above a rate of 0.21 [0.17, 0.24], and among greedy ones,
where learners come from, above 0.70 [0.66, 0.75]; in between the game is a stag hunt. On Melting Pot's
Commons Harvest, Willis et al. (IJCAI 2025, arXiv 2501.16138) find the threshold at an own share near 0.29,
which is a rate of 0.95 here. Frozen weights are measured at explorations of 0, 0.02, 0.05 and 0.1.

11 conditions, 8 replicas: some 0.5 core hours. Contradicted by: a rise below the threshold, none above.
"""

from typing import Final

from asking import EXPERIMENT, Expectation, Sign, expected_text

import cprl
from cprl.institutions import Tax

RATES: Final = tuple(tenths / 10 for tenths in range(11))
STAG_HUNT: Final = "restraint would pay among restrained agents, but learners come from ruin"


def name(rate: float) -> str:
    return f"rate {rate:g}"


def expectation(rate: float, sign: Sign, why: str) -> Expectation:
    return Expectation(
        label=f"{name(rate)} - no tax", more=(name(rate),), less=(name(0),), sign=sign, why=why
    )


EXPECTATIONS: Final = (
    expectation(0.1, "same", "greed pays everywhere"),
    expectation(0.2, "same", "greed pays everywhere"),
    *(expectation(rate, "same", STAG_HUNT) for rate in (0.3, 0.4, 0.5, 0.6)),
    expectation(0.7, "more", "at the threshold of the agents who are in ruin"),
    *(expectation(rate, "more", "greed no longer pays in ruin") for rate in (0.8, 0.9)),
    expectation(1.0, "more", "all are paid alike: a team's reward"),
    Expectation(
        label="above the threshold - below it",
        more=tuple(map(name, (0.8, 0.9, 1.0))),
        less=tuple(map(name, (0.3, 0.4, 0.5, 0.6))),
        sign="more",
        why="what learners do changes there",
    ),
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        name(0): {},
        **{name(rate): {"game.institutions": (Tax(rate=rate),)} for rate in RATES if rate},
    },
    name="tax_rate",
    question="How large must a tax be, of each bite and shared equally, until learners keep the commons?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
