"""How large must a quota be? Shares of 0.25 to 0.8 of the proven yield, which nobody can exceed.

    python recipes/study/governs/quota_size.py --jobs 2

A share of s allows floor(s x 27.8) apples for each agent in 50 turns, so an episode of twenty windows at most
80 times as many: 480, 640, 880, 1,040, 1,280, 1,520 and 1,760 apples. The best known policy gets 1,390.

8 conditions, 8 replicas: some 0.35 core hours. Contradicted by: a loose quota that helps, a tight one that
does not, or a looser one that beats the tightest by more than the margin.
"""

from collections.abc import Sequence
from typing import Any, Final

from asking import EXPERIMENT, Expectation, expected_text

import cprl
from cprl.institutions import Quota

NOTHING: Final = "no quota"
SHARES: Final = (0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


def name(share: float) -> str:
    return f"share {share:g}"


def conditions(shares: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Return the condition without a quota, and one for each share."""
    quotas = {name(share): Quota(share=share, window_steps=50) for share in shares}
    return {NOTHING: {}, **{label: {"game.institutions": (quota,)} for label, quota in quotas.items()}}


EXPECTATIONS: Final = (
    *(
        Expectation(
            label=f"{name(share)} - no quota",
            more=(name(share),),
            less=(NOTHING,),
            sign="more",
            why="what agents take is held below what regrows",
        )
        for share in (0.25, 0.3, 0.4, 0.5)
    ),
    *(
        Expectation(
            label=f"{name(share)} - no quota",
            more=(name(share),),
            less=(NOTHING,),
            sign="same",
            why="it allows more than the best known policy sustains, so agents strip the board under it",
        )
        for share in (0.7, 0.8)
    ),
    Expectation(
        label="share 0.4 - share 0.25",
        more=(name(0.4),),
        less=(name(0.25),),
        sign="same",
        why="a search found 0.385 best, and it gave no more than a quarter in new worlds",
    ),
    Expectation(
        label="share 0.5 - share 0.25",
        more=(name(0.5),),
        less=(name(0.25),),
        sign="less",
        why="in windows in which the stock is low, agents take it all",
    ),
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(SHARES),
    name="quota_size",
    question="How large must a quota be that nobody can exceed?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
