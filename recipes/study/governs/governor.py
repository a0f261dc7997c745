"""Can a governor learn a rule while the governed learn against it? A tax rate or a quota, set every 50 turns.

    python recipes/study/governs/governor.py --jobs 2

The design of the AI Economist (Zheng et al., Science Advances 8, 2022) on a commons: a governor sees the
stock, the harvest, its lowest part, violations and the time, and sets one number in each world by itself,
paid by the income of all in those 50 turns. Beside it the best constants that are known (tax_rate.py,
quota_size.py), a harvest control rule of fisheries, and the agents' own votes on the same options. Evaluation
is with frozen weights, also of the governor, which draws from its policy.

13 conditions, 8 replicas, 400,000 steps each (41.6 million): some 0.7 core hours. A governor decides 8,000
times in a training of a replica and takes 62 rounds of updates. Contradicted by: a learned tax as good as the
best constant; a learned quota no better than the vote. One family of all 11, by Holm's method.
"""

from dataclasses import replace
from typing import Any, Final

from asking import EXPERIMENT, GAME, STEPS, Expectation, Sign, expected_text

import cprl
from cprl.algorithms import PPO, RolloutSettings
from cprl.institutions import Governor, Institution, Quota, Tax, Vote
from cprl.policies.governors import Constant, StockRule
from cprl.population import Learning

LEARNED: Final = Learning(
    PPO(
        settings=RolloutSettings(
            gamma=0.95, learning_rate=1e-3, rollout_steps=8, minibatch_size=128, epochs=8
        ),
    )
)
"""A discount for each period: a horizon of 20 periods, an episode."""
TAX: Final = (Tax(), Governor(sets="tax.rate"))
QUOTA: Final = (Quota(window_steps=50), Governor(sets="quota.share"))
NOTHING: Final = "changes/nothing changed"


def governed(institutions: tuple[Institution, ...], **more: Any) -> dict[str, Any]:
    return {"game": replace(GAME, institutions=institutions), **more}


def conditions() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {}
    for rule, institutions, constants in (("tax", TAX, (0.5, 0.75, 1.0)), ("quota", QUOTA, (0.25, 0.5))):
        for number in constants:
            table[f"{rule} {number:g}"] = governed(institutions, governor=Constant(number))
        table[f"{rule} by the stock"] = governed(institutions, governor=StockRule())
        table[f"{rule} by vote"] = governed((Vote(on=institutions[0]),))
        table[f"{rule} learned"] = governed(institutions, governor=LEARNED)
        table[f"{rule} learned later"] = governed(
            institutions, governor=LEARNED, governor_from_step=STEPS // 2
        )
    return table


def expectation(more: str, less: str, sign: Sign, why: str) -> Expectation:
    label = f"{more} - {less.partition('/')[2] or less}"
    return Expectation(label=label, more=(more,), less=(less,), sign=sign, why=why)


EXPECTATIONS: Final = (
    expectation("tax 1", NOTHING, "more", "all are paid alike"),
    expectation("tax learned", "tax 1", "less", "what a rate does to learners shows after the period"),
    expectation("tax learned", NOTHING, "same", "rates about the middle do nothing"),
    expectation("tax learned", "tax by vote", "less", "a vote lasts an episode, and is paid for all of it"),
    expectation("tax by the stock", "tax 1", "less", "it is low where restraint would have to begin"),
    expectation("tax learned later", "tax learned", "same", "the reward says as little as before"),
    expectation("quota 0.25", NOTHING, "more", "as in quota_size.py"),
    expectation("quota by the stock", "quota 0.25", "more", "it allows more where there is more"),
    expectation("quota learned", "quota 0.25", "more", "a quota works within a few periods"),
    expectation("quota learned", "quota by vote", "more", "a vote is taken once an episode, blindly"),
    expectation("quota learned", "quota by the stock", "same", "it finds about that rule"),
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(),
    name="governor",
    question="Does a governor that learns find a rule as good as the best constant, a rule of thumb, a vote?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
