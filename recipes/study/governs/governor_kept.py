"""What is kept of a learned rule? Governors of governor.py, frozen, over others than they learned with.

    python recipes/study/governs/governor.py --jobs 2
    python recipes/study/governs/governor_kept.py --jobs 2

Each frozen governor plays with four agents that learn anew from nothing: they have the seed of another
replica than the one the governor learned with. Again on a board on which half as much regrows, which no
governor has seen.

4 conditions, 8 replicas: some 0.25 core hours. Contradicted by: another income under a frozen governor than
under the same one that learned beside its agents; a learned rule that is of no use where half regrows. One
family of all 4, by Holm's method.
"""

from dataclasses import replace
from typing import Any, Final

from asking import EXPERIMENT, GAME, Expectation, expected_text, trained
from changes import regrown
from governor import QUOTA, STUDY as GOVERNOR, TAX

import cprl
from cprl.institutions import Institution
from cprl.population import Frozen

LEARNED: Final[dict[str, tuple[Institution, ...]]] = {"tax": TAX, "quota": QUOTA}
HALVED: Final = "changes/regrowth x 0.5"
"""The same board without a rule."""


def frozen(rule: str) -> Frozen:
    """Return the governor that learned in the replica after this one, counted around."""
    run = trained(GOVERNOR, f"{rule} learned")[0].run
    replicas = EXPERIMENT.replicas
    others = tuple((replica + 1) % replicas for replica in range(replicas))
    return Frozen(run, GAME.agents, replica=others)


def conditions() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {}
    for rule, institutions in LEARNED.items():
        governor = frozen(rule)
        game = replace(GAME, institutions=institutions)
        halved = replace(regrown(0.5)["game"], institutions=institutions)
        table[f"{rule} kept"] = {"game": game, "governor": governor}
        table[f"{rule} kept, regrowth halved"] = {"game": halved, "governor": governor}
    return table


EXPECTATIONS: Final = tuple(
    expected
    for rule in LEARNED
    for expected in (
        Expectation(
            label=f"{rule}: frozen - learned beside its agents",
            more=(f"{rule} kept",),
            less=(f"governor/{rule} learned",),
            sign="same",
            why="what it does depends on the stock and the time more than on whom it meets",
        ),
        Expectation(
            label=f"regrowth halved: {rule} - no rule",
            more=(f"{rule} kept, regrowth halved",),
            less=(HALVED,),
            sign="more" if rule == "quota" else "same",
            why="it is tighter where the stock is low" if rule == "quota" else "its rates do little",
        ),
    )
)

STUDY = cprl.Study(
    EXPERIMENT,
    conditions=conditions(),
    name="governor_kept",
    question="What is kept of a learned rule under agents, and on a board, that it has not learned with?",
    expectation=expected_text(EXPECTATIONS),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
