"""Was experiment 3 run by the earlier program? Its fault and its discount, each alone and together.

    python recipes/study/experiment_3.py --jobs 2

Two independent DQN agents on `two_complex` as run, and as the program of 10 April 2019 played it
(docs/game.md). Each condition, of 8 replicas and 6,000 episodes, takes one and a half to two hours of a core;
`--episodes 1000` is enough for what is expected below.
"""

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning

SETTINGS = presets.dqn_settings("two_complex", variant="as_run")

FAULT = {"game.rules.agent_1_right_moves_agent_0": True}
DISCOUNT = {"agents.*.algorithm.settings.gamma": 0.999}

STUDY = cprl.Study(
    cprl.Experiment(
        name="experiment_3",
        game=presets.game("two_complex", variant="as_run"),
        agents=(Learning(DQN(settings=SETTINGS)),) * 2,
        episodes=6000,
        replicas=8,
    ),
    conditions={
        "as run": {},
        "gamma 0.999": DISCOUNT,
        "the fault": FAULT,
        "10 April: both": {**FAULT, **DISCOUNT},
    },
    name="experiment_3",
    question="Was experiment 3 as published run by the earlier program, with its fault and discount?",
    expectation=(
        "From another implementation of the same rules, as means of the collective return with their "
        "standard errors: in the first window of 150 episodes (published 108.4) as run 101.9 ± 3.1, gamma "
        "0.999 103.1 ± 1.9, the fault 108.6 ± 2.6, both 109.7 ± 1.9; in episodes 500 to 600 (published "
        "about 188) 142 ± 5, 205 ± 11, 163 ± 30 and 174 ± 13. So the beginning tells the fault, the rise "
        "the discount, and both together come nearest to what was published."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
