"""What do the pages compare that no summary of a study does? Frozen beside learning, and planned contrasts.

    python recipes/study/contrasts.py

To be run in the root of the repository: reads tables in docs/results, and writes
docs/results/governs/contrasts.md. "While learning" is the mean of the last 30 episodes of a training, in
which agents explore and their weights change after every turn; "frozen" that of fresh episodes of the same
agents at its end, whose weights no longer change and who explore half as much. A contrast is the mean of some
conditions minus that of others, in each replica.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import tyro
from governs import RESULTS, Part, values_of
from page import table
from together import design, name

from cprl.measuring.statistics import Estimate, difference, estimate

LEARNERS: Final = "../learners/commons"
SIDE_BY_SIDE: Final = {
    "none": ("best_rules", "none"),
    "quota by hand": ("best_rules", "quota, by hand"),
    "best quota found": ("best_rules", "quota, best found"),
    "sanctions by hand": ("best_rules", "sanctions, by hand"),
    "best sanctions found": ("best_rules", "sanctions, best found"),
    "tax by hand": ("best_rules", "tax, by hand"),
    "best tax found": ("best_rules", "tax, best found"),
    "DQN, 1 world": ("many_worlds", "DQN, as run, 1 world"),
    "DQN, 16 worlds": ("many_worlds", "DQN, as run, 16 worlds"),
    "PPO, 1 world": ("many_worlds", "PPO, as run, 1 world"),
    "PPO, 16 worlds": ("many_worlds", "PPO, as run, 16 worlds"),
}
"""The conditions that are shown frozen beside learning: the study and its name there."""


class Contrast(NamedTuple):
    """The mean of some conditions of a study minus that of others."""

    label: str
    study: str
    metric: str
    more: Sequence[str]
    less: Sequence[str]
    last: int = 30
    """Episodes at the end of the training."""

    def difference(self, part: Part) -> Estimate:
        """Return the difference of the means over conditions, paired by replica."""
        means = []
        for conditions in (self.more, self.less):
            values = [values_of(self.study, one, self.metric, part, self.last) for one in conditions]
            means.append(np.mean(values, axis=0))
        return difference(*means, paired=True)


TITLES: Final = {
    "income": "income",
    "survival_steps": "survival, turns",
    "income_equality": "equality of income",
}


def with_rule(factor: str, metric: str, *, is_there: bool) -> Contrast:
    """Return a factor of together.py in the combinations that have a quota or boundaries, or in the others,
    where monitoring and sanctions are not in the game."""
    cells = [levels for levels in design() if (levels["quota"] or levels["boundaries"]) == is_there]
    where = "where there is a quota or boundaries" if is_there else "where there is neither"
    more = [name(levels) for levels in cells if levels[factor]]
    less = [name(levels) for levels in cells if not levels[factor]]
    return Contrast(f"{factor} {where}, {TITLES[metric]}", "together", metric, more, less)


TAX: Final = ["tax, best found"]
BY_HAND: Final = ["quota, by hand"]
EQUALITY: Final = "income_equality"
HARVEST: Final = "collective_return"
CONTRASTS: Final = [
    with_rule("sanctions", "income", is_there=True),
    with_rule("monitoring", "income", is_there=True),
    with_rule("sanctions", "survival_steps", is_there=True),
    with_rule("monitoring", "survival_steps", is_there=True),
    with_rule("sanctions", "income", is_there=False),
    with_rule("monitoring", "income", is_there=False),
    Contrast("best tax - quota by hand, income", "best_rules", "income", TAX, BY_HAND),
    Contrast("best tax - quota by hand, equality of income", "best_rules", EQUALITY, TAX, BY_HAND),
    Contrast("best tax - best quota, equality of income", "best_rules", EQUALITY, TAX, ["quota, best found"]),
    Contrast(
        "three teams - three that learn alone",
        LEARNERS,
        HARVEST,
        ["VDN", "QMIX", "MAPPO"],
        ["DQN", "PPO", "IPPO"],
    ),
    *(
        Contrast(f"{team} - {alone}", LEARNERS, HARVEST, [team], [alone])
        for team, alone in (("VDN", "DQN"), ("QMIX", "DQN"), ("MAPPO", "PPO"))
    ),
    *(
        Contrast(
            f"PPO {variant}, {worlds} worlds - 1 world, last {last}",
            "many_worlds",
            HARVEST,
            [f"PPO, {variant}, {worlds} worlds"],
            [f"PPO, {variant}, 1 world"],
            last,
        )
        for variant in ("as run", "published")
        for worlds, last in ((16, 50), (256, 256))
    ),
    *(
        Contrast(
            f"full schedule, {change} - nothing changed, {TITLES[metric]}, last 1,000",
            "elsewhere",
            metric,
            [f"DQN, full schedule: {change}"],
            ["DQN, full schedule: nothing changed"],
            1_000,
        )
        for change in ("quota", "penalty that is certain")
        for metric in (EQUALITY, "survival_steps")
    ),
    Contrast(
        "Melting Pot, quota - twice the apples, income",
        "elsewhere",
        "income",
        ["DQN, Melting Pot: quota"],
        ["DQN, Melting Pot: twice the apples"],
    ),
]
"""All that the pages name."""


def side_by_side() -> list[str]:
    """Return the conditions that are shown frozen beside learning, in Markdown."""
    head = ["condition", "income while learning, apples", "income frozen", "frozen - while learning"]
    head += ["equality of the harvest, frozen", "equality of income, frozen"]
    rows = []
    for label, place in SIDE_BY_SIDE.items():
        learning = values_of(*place, "income")
        frozen = values_of(*place, "income", "evaluation")
        change = difference(frozen, learning, paired=True)
        equalities = [
            str(estimate(values_of(*place, metric, "evaluation"))) for metric in ("equality", EQUALITY)
        ]
        rows.append([label, str(estimate(learning)), str(estimate(frozen)), f"{change:+}", *equalities])
    return table(head, rows, numbers=5)


def main(*, out: Path = RESULTS / "governs" / "contrasts.md") -> None:
    """Write the tables.

    Args:
        out: the file.
    """
    rows = []
    for contrast in CONTRASTS:
        cells = [contrast.label]
        for part in ("training", "evaluation"):
            change = contrast.difference(part)
            cells += [f"{change:+}", f"{change.p_value:.2g}"]
        rows.append(cells)
    lines = [
        "By `python recipes/study/contrasts.py`, which says what the columns mean.",
        "",
        *side_by_side(),
        "Each p is of one comparison, not corrected for the others. Of learners and of many worlds the "
        "harvest is compared, in apples.",
        "",
        *table(["contrast", "while learning", "p", "frozen", "p"], rows, numbers=4),
    ]
    out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
