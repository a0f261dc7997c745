"""What recovers after a shock? Regrowth halved, or half of the agents replaced by novices, at mid-training.

    python recipes/study/governs/changes.py --only "nothing changed" --only "quota (2)" ...
    python recipes/study/governs/order.py
    python recipes/study/governs/shocks.py --jobs 2

Under no rule, a quota, the best tax and sanctions without fines. Regrowth: the game changes after 400,000 of
800,000 steps, and a quota still allows as many apples as before; the same training without the shock is in
order.py. Novices: agents 2 and 3 of a population that was trained are replaced by agents who know nothing,
and all learn on for 400,000 steps; in the control all four are veterans. Buffers and optimisers begin anew in
both.

12 conditions, 8 replicas: some 0.7 core hours. Contradicted by: a rule under which halved regrowth costs
nothing, or no longer beats none, and novices who change an income by more than the margin in the end. How
fast incomes are back is in courses.parquet.
"""

from dataclasses import replace
from typing import Any, Final

from asking import AGENT, EXPERIMENT, STEPS, Expectation, expected_text, trained
from best_response import COPY as VETERAN, RULES as TRAINED
from changes import QUOTA, STUDY as CHANGES, regrown
from order import HELD, RULES as INSTITUTIONS, under

import cprl
from cprl import EarlierGame
from cprl.institutions import Institution

BEFORE: Final[dict[str, tuple[Institution, ...]]] = {
    "no rule": (),
    "quota": INSTITUTIONS["quota 0.25"],
    "sanctions": HELD,
    "tax": INSTITUTIONS["tax"],
}
AFTER: Final[dict[str, tuple[Institution, ...]]] = {
    **BEFORE,
    "quota": (replace(QUOTA, share=2 * QUOTA.share),),
    "sanctions": (replace(HELD[0], share=2 * QUOTA.share), HELD[1]),
}
"""Half the yield and twice the share: as many apples."""
UNSHOCKED: Final = {
    "no rule": "order/no tax, then no tax",
    "quota": "order/quota 0.25, then quota 0.25",
    "sanctions": "order/sanctions, then sanctions",
    "tax": "order/tax, then tax",
}


def halved(rule: str) -> dict[str, Any]:
    """Return the condition in which regrowth is halved in the middle of a training under a rule."""
    after = under(AFTER[rule])
    after = replace(after, rules=replace(after.rules, regrow_prob=regrown(0.5)["game"].rules.regrow_prob))
    earlier = (EarlierGame(game=under(BEFORE[rule]), steps=STEPS),)
    return {"game": after, "earlier": earlier, "steps": 2 * STEPS}


def population(rule: str, novices: int) -> dict[str, Any]:
    """Return the condition in which the last agents of a trained population are replaced by novices."""
    stored = trained(CHANGES, TRAINED[rule])
    veterans = tuple(replace(VETERAN, start_from=start) for start in stored[: 4 - novices])
    return {"game": under(BEFORE[rule]), "agents": (*veterans, *(AGENT,) * novices)}


def conditions() -> dict[str, dict[str, Any]]:
    table = {}
    for rule in BEFORE:
        table[f"{rule}, regrowth halved"] = halved(rule)
        table[f"{rule}, two novices"] = population(rule, novices=2)
        table[f"{rule}, four veterans"] = population(rule, novices=0)
    return table


EXPECTATIONS: Final = (
    *(
        Expectation(
            label=f"{rule}: regrowth halved - as before",
            more=(f"{rule}, regrowth halved",),
            less=(UNSHOCKED[rule],),
            sign="less",
            why="half as much grows",
        )
        for rule in BEFORE
    ),
    *(
        Expectation(
            label=f"regrowth halved: {rule} - no rule",
            more=(f"{rule}, regrowth halved",),
            less=("no rule, regrowth halved",),
            sign="more",
            why="a rule that keeps the board alive keeps what still grows",
        )
        for rule in BEFORE
        if rule != "no rule"
    ),
    *(
        Expectation(
            label=f"{rule}: two novices - four veterans",
            more=(f"{rule}, two novices",),
            less=(f"{rule}, four veterans",),
            sign="same",
            why="novices have learned what veterans know within the half",
        )
        for rule in BEFORE
    ),
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(),
    name="shocks",
    question="What recovers after a shock, under which rule, and how fast?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
