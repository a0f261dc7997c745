"""Why do agents harvest less while they learn than with the weights that they have learned?

    python recipes/study/governs/changes.py --only "nothing changed" --only "tax of 0.77, shared"
    python recipes/study/governs/in_motion.py --jobs 2

The agents that these trainings ended with go on in new worlds, for 100,000 steps, at an exploration of 0.05:
all of them learning, one of them, none of them (a learning rate of 1e-12), all at a tenth of the rate, and
all with targets that are copied a tenth as often. Buffers and optimisers begin anew in each, and updates
after 16,000 steps. Here the primary outcome is the income while they learn, in the last two episodes of each
world.

10 conditions, 8 replicas: some 0.15 core hours. Contradicted by: agents that go on as before and harvest as
much as agents that do not.
"""

from dataclasses import replace
from typing import Any, Final

from asking import EXPERIMENT, SETTINGS, Expectation, Sign, expected_text, trained
from changes import NOTHING, STUDY as CHANGES

import cprl
from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning

RULES: Final = {"no rule": NOTHING, "tax": "tax of 0.77, shared"}
"""By the name here: the condition of changes.py."""
GOING_ON: Final = replace(SETTINGS, epsilon_start=0.05, epsilon_end=0.05, learning_starts=16_000)
STILL: Final = replace(GOING_ON, learning_rate=1e-12)
ALL, ONE, NONE = "all learn", "one learns", "none learns"
SLOWER, LONGER = "a tenth of the rate", "targets ten times as old"


def agents(rule: str, settings: DQNSettings, learners: int = 4) -> tuple[Learning, ...]:
    """Return the trained agents under a rule, the first of which learn with these settings."""
    each = [settings] * learners + [STILL] * (4 - learners)
    stored = trained(CHANGES, RULES[rule])
    return tuple(
        Learning(DQN(settings=own), start_from=start) for own, start in zip(each, stored, strict=True)
    )


def conditions() -> dict[str, dict[str, Any]]:
    table = {}
    games = {condition.name: condition.experiment.game for condition in CHANGES.all_conditions}
    for rule, named in RULES.items():
        ways = {
            ALL: agents(rule, GOING_ON),
            ONE: agents(rule, GOING_ON, learners=1),
            NONE: agents(rule, STILL),
            SLOWER: agents(rule, replace(GOING_ON, learning_rate=1e-4)),
            LONGER: agents(rule, replace(GOING_ON, target_every_updates=2_500)),
        }
        table |= {f"{rule}: {way}": {"game": games[named], "agents": specs} for way, specs in ways.items()}
    return table


def expectation(rule: str, more: str, less: str, sign: Sign, why: str) -> Expectation:
    return Expectation(
        label=f"{rule}: {more} - {less}",
        more=(f"{rule}: {more}",),
        less=(f"{rule}: {less}",),
        sign=sign,
        why=why,
        part="training",
    )


EXPECTATIONS: Final = tuple(
    expected
    for rule in RULES
    for expected in (
        expectation(rule, ALL, NONE, "less", "values move with every update, and greed is never far"),
        expectation(rule, ONE, NONE, "same", "one agent's moves do not strip the board"),
        expectation(rule, SLOWER, ALL, "more", "values move a tenth as fast"),
        expectation(rule, LONGER, ALL, "more", "values are learned from targets that stand still"),
    )
)

STUDY = cprl.Study(
    replace(EXPERIMENT, steps=100_000),
    conditions=conditions(),
    name="in_motion",
    question="Why do agents harvest less while they learn than with frozen weights?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
