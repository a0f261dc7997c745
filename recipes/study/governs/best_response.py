"""What is a best response worth? One agent learns anew among three that stay as they are.

    python recipes/study/governs/changes.py --only "nothing changed" --only "quota (2)" ...
    python recipes/study/governs/best_response.py --jobs 2

Agent 0 of a population that was trained under a rule is replaced by a responder, which learns for as many
steps as the population did: from a copy of the agent that it replaces, or from nothing. Its gain is its
income in fresh worlds minus that of the agent that it replaces, in the same worlds. A best response never
loses, since it may copy: a gain below 0 says only that the responder learned less.

8 conditions, 8 replicas: some 0.35 core hours. A gain of 12.5 apples matters, a quarter of the margin for
four agents. Contradicted by: a population whose members have that much to gain.
"""

from dataclasses import replace
from typing import Any, Final

from asking import AGENT, EXPERIMENT, MARGIN, SETTINGS, Expectation, Sign, expected_text, trained
from changes import NOTHING, STUDY as CHANGES

import cprl
from cprl.algorithms import DQN
from cprl.population import Frozen, Learning

RULES: Final = {
    "no rule": NOTHING,
    "quota": "quota (2)",
    "sanctions": "sanctions without fines (5)",
    "tax": "tax of 0.77, shared",
}
"""By the name here: the condition of changes.py."""
COPY: Final = Learning(DQN(settings=replace(SETTINGS, epsilon_start=0.1)))
"""Learns on at the exploration that its training ended with."""
EXPECTED: Final[dict[str, tuple[Sign, str]]] = {
    "no rule": ("same", "all are greedy already, and the board dies before another way pays"),
    "quota": ("same", "nobody can take more than the quota, which all take"),
    "sanctions": ("same", "a breach costs more turns than it brings"),
    "tax": ("same", "less than half of a bite is one's own"),
}


def responders(replaced: Frozen) -> dict[str, Learning]:
    """Return who learns a response in the place of an agent, by what it starts from."""
    return {"a copy": replace(COPY, start_from=replaced), "nothing": AGENT}


def gain(label: str, *, responder: str, incumbents: str, sign: Sign, why: str) -> Expectation:
    """Return what is expected of the income of agent 0 in a condition, beside that of whom it replaced."""
    return Expectation(
        label=label,
        more=(responder,),
        less=(incumbents,),
        sign=sign,
        why=why,
        metric="agent_0/return",
        margin=MARGIN / 4,
    )


def conditions() -> dict[str, dict[str, Any]]:
    table = {}
    games = {condition.name: condition.experiment.game for condition in CHANGES.all_conditions}
    for rule, named in RULES.items():
        replaced, *others = trained(CHANGES, named)
        for start, responder in responders(replaced).items():
            table[f"{rule}, from {start}"] = {"game": games[named], "agents": (responder, *others)}
    return table


EXPECTATIONS: Final = tuple(
    gain(
        f"gain under {rule}, from {start}",
        responder=f"{rule}, from {start}",
        incumbents=f"changes/{RULES[rule]}",
        sign=sign,
        why=why,
    )
    for rule, (sign, why) in EXPECTED.items()
    for start in ("a copy", "nothing")
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(),
    name="best_response",
    question="What does an agent gain that learns a response to the others, which stay as they are?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
