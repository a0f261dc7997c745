"""Which quota is best where agents learn for as long as published? Shares that nobody can exceed.

    python recipes/study/governs/quota_length.py --jobs 2

Conditions of quota_size.py with ten times the steps: the schedule of asking.py is a tenth of the published
one, whose exploration falls over 1,000,000 steps.

4 conditions of 4,000,000 steps, 8 replicas: some 2 core hours. Contradicted by: agents who learn longer and
do not spare a board without a rule, or get no more from a looser quota than from the tightest.
"""

from dataclasses import replace
from typing import Final

from asking import EXPERIMENT, SETTINGS, STEPS, Expectation, expected_text
from quota_size import NOTHING, conditions, name

import cprl
from cprl.algorithms import DQN
from cprl.population import Learning

TIMES: Final = 10
SHARES: Final = (0.25, 0.4, 0.5)
AGENT: Final = Learning(
    DQN(settings=replace(SETTINGS, epsilon_decay_steps=TIMES * SETTINGS.epsilon_decay_steps))
)

EXPECTATIONS: Final = (
    Expectation(
        label="no quota: published length - a tenth",
        more=(NOTHING,),
        less=(f"quota_size/{NOTHING}",),
        sign="more",
        why="the published training recovers in its second half",
    ),
    Expectation(
        label=f"{name(0.25)}: published length - a tenth",
        more=(name(0.25),),
        less=(f"quota_size/{name(0.25)}",),
        sign="same",
        why="agents take nearly all that it allows after a tenth",
    ),
    *(
        Expectation(
            label=f"{name(share)} - no quota",
            more=(name(share),),
            less=(NOTHING,),
            sign="more",
            why="it holds the harvest below what regrows",
        )
        for share in SHARES
    ),
    *(
        Expectation(
            label=f"{name(share)} - {name(0.25)}",
            more=(name(share),),
            less=(name(0.25),),
            sign="more",
            why="agents who learn longer leave some of a looser quota",
        )
        for share in SHARES[1:]
    ),
)

STUDY = cprl.Study(
    replace(EXPERIMENT, agents=(AGENT,) * 4, steps=TIMES * STEPS),
    conditions=conditions(SHARES),
    name="quota_length",
    question="How large must a quota be where agents learn for as long as published?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
