"""Do monitoring and sanctions need each other? A quota that can be broken, monitoring, sanctions: all eight.

    python recipes/study/governs/oversight.py --jobs 2 --block 8

All eight conditions have the three institutions, so that agents see the same numbers; "without" is a setting
that does nothing: a quota of a thousand times the yield, which nobody breaks, a detection of one breach in
five, the chance that is there before anybody monitors, and sanctions without a turn or an apple. A detected
breach costs one apple, just what the bite brings; sanctions add time-outs that grow, and no fines. Where
no quota binds, monitoring and sanctions act on nothing, so their effects there are 0 by construction, and
whatever is measured there is the noise of this design.

Ostrom: rules that nobody watches or punishes are broken, and each of the two needs the other. 8 conditions,
16 replicas: some 0.75 core hours. Contradicted by: an interaction of monitoring and sanctions under the quota
that is 0 or below, or either of them that helps alone as much as both.
"""

from itertools import product
from typing import Final

from asking import EXPERIMENT, Expectation, expected_text

import cprl
from cprl.institutions import GraduatedSanctions, Monitoring, Quota

FACTORS: Final = ("quota", "monitoring", "sanctions")
LADDER: Final = (5, 25, 100, 100)
"""Turns out of play, by offence."""


def name(*factors: str) -> str:
    return ", ".join(factors) or "none"


def levels(*factors: str) -> dict[str, object]:
    """Return the condition in which these factors are at work."""
    return {
        "game.institutions": (
            Quota(share=0.25 if "quota" in factors else 1000, window_steps=50, fine=1.0),
            Monitoring(prob=1.0 if "monitoring" in factors else 0.2),
            GraduatedSanctions(
                freeze_steps=LADDER if "sanctions" in factors else (0, 0, 0, 0),
                fines=(0, 0, 0, 0),
                recovery_steps=50,
                on="violations",
            ),
        )
    }


ALL: Final = tuple(
    tuple(factor for factor, is_there in zip(FACTORS, there, strict=True) if is_there)
    for there in product((False, True), repeat=3)
)
BOTH: Final = name(*FACTORS)
ALONE: Final = name("quota")
MONITORED: Final = name("quota", "monitoring")
SANCTIONED: Final = name("quota", "sanctions")

EXPECTATIONS: Final = (
    Expectation(
        label="the quota by itself",
        more=(ALONE,),
        less=(name(),),
        sign="same",
        why="a breach costs a fifth of what it brings, so the quota is broken",
    ),
    Expectation(
        label="monitoring, under the quota, without sanctions",
        more=(MONITORED,),
        less=(ALONE,),
        sign="same",
        why="the certain fine takes just what the bite brings",
    ),
    Expectation(
        label="sanctions, under the quota, without monitoring",
        more=(SANCTIONED,),
        less=(ALONE,),
        sign="more",
        why="a breach in five detected is enough for time-outs of a hundred turns",
    ),
    Expectation(
        label="both, under the quota",
        more=(BOTH,),
        less=(ALONE,),
        sign="more",
        why="who breaks the quota is out of play",
    ),
    Expectation(
        label="monitoring x sanctions, under the quota",
        more=(BOTH, ALONE),
        less=(MONITORED, SANCTIONED),
        sign="more",
        why="as Ostrom states it: each needs the other",
    ),
    Expectation(
        label="monitoring and sanctions where no quota binds",
        more=(name("monitoring", "sanctions"),),
        less=(name(),),
        sign="same",
        why="there is nothing to detect",
    ),
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions={name(*factors): levels(*factors) for factors in ALL},
    replicas=16,
    name="oversight",
    question="Do monitoring and sanctions need each other, under a quota that can be broken?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
