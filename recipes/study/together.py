"""Which rules need each other? Ostrom's rules, sight and number of agents, in a fraction of all cases.

    python recipes/study/together.py --jobs 2

Seven factors of two levels in sixteen of their 128 combinations, a design 2^(7-3) of resolution IV
(NIST/SEMATECH e-Handbook of Statistical Methods, section 5.3.3.4): no main effect is mixed with another or
with an interaction of two factors, and interactions of two are found in seven groups of three.
recipes/study/effects.py computes both.
"""

from itertools import product
from typing import Any, Final

from agents import crowded
from base import AGENT, EXPERIMENT

import cprl
from cprl.institutions import Boundaries, GraduatedSanctions, Monitoring, Quota, Tax, Vote

FACTORS: Final = ("quota", "boundaries", "monitoring", "sanctions", "vote", "sight", "few")
"""The last three are products of the first four: vote = quota x boundaries x monitoring, sight = boundaries x
monitoring x sanctions, few = quota x monitoring x sanctions."""
FINE: Final = 1.0
"""The fine of a forbidden bite, in apples: what the bite brings."""


def design() -> list[dict[str, bool]]:
    """Return whether each factor is at its high level, for each condition."""
    conditions = []
    for basis in product((False, True), repeat=4):
        q, b, m, s = (1 if high else -1 for high in basis)
        generated = (q * b * m > 0, b * m * s > 0, q * m * s > 0)
        conditions.append(dict(zip(FACTORS, (*basis, *generated), strict=True)))
    return conditions


def condition(levels: dict[str, bool]) -> dict[str, Any]:
    """Return what differs from the experiment.

    Rules can be broken and cost a fine where detected, one turn in five, or always where it is monitored;
    sanctions add time-outs and fines that grow; a vote sets a tax; sight is 11 x 23 cells in place of 7 x
    15; few are two agents in place of four.
    """
    agents = 2 if levels["few"] else 4
    detection_prob = 1.0 if levels["monitoring"] else 0.2
    board = crowded(agents)
    quota = Quota(share=0.25, window_steps=50, fine=FINE)
    boundaries = Boundaries.strips(height=board.height, width=board.width, agents=agents, bite_fine=FINE)
    rules = [rule for rule, name in ((quota, "quota"), (boundaries, "boundaries")) if levels[name]]
    sanctions = GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), on="violations")
    if rules:
        rules.append(Monitoring(prob=detection_prob))
        rules += [sanctions] * levels["sanctions"]
    rules += [Vote(on=Tax(), choices=(0.0, 0.25, 0.5, 0.75))] * levels["vote"]
    rows, columns = (11, 23) if levels["sight"] else (7, 15)
    return {
        "agents": (AGENT,) * agents,
        "game.map": board,
        "game.institutions": tuple(rules),
        "game.rules.window_rows": rows,
        "game.rules.window_columns": columns,
    }


def name(levels: dict[str, bool]) -> str:
    """Return the factors that are at their high level.

    Without a quota or boundaries those named monitoring and sanctions are not in the game, see `condition`.
    """
    return ", ".join(factor for factor in FACTORS if levels[factor]) or "none"


STUDY = cprl.Study(
    EXPERIMENT,
    conditions={name(levels): condition(levels) for levels in design()},
    name="together",
    question="Which of Ostrom's principles need each other?",
    expectation=(
        "Ostrom finds the principles together, and says that rules without monitoring and sanctions are "
        "broken. So the interactions of quota or boundaries with monitoring and with sanctions are expected "
        "to be positive for the harvest after fines and for survival, and larger than the main effects of "
        "monitoring and sanctions, which do nothing where no rule can be broken. The main effect of the "
        "quota is positive; of boundaries smaller; of a vote on a tax about nothing; of more sight about "
        "nothing; of two agents instead of four positive."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
