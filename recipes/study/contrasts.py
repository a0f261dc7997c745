"""What do the pages compare that no summary of a study does? Frozen beside learning, and planned contrasts.

    python recipes/study/contrasts.py

To be run in the root of the repository: reads tables in docs/results, and writes
docs/results/governs/contrasts.md. "While learning" is the mean of the last 30 episodes of a training, in
which agents explore and their weights change after every turn; "frozen" that of fresh episodes of the same
agents at its end, whose weights no longer change and who explore half as much. A contrast is the mean of some
conditions minus that of others, in each replica.
"""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import tyro
from governs import RESULTS, Part, values_of
from numpy.typing import NDArray
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
    more: list[str]
    less: list[str]
    last: int = 30
    """Episodes at the end of the training."""


def with_rule(factor: str, *, metric: str, is_there: bool) -> Contrast:
    """A factor of together.py in the combinations that have a quota or boundaries, or in the others, where
    monitoring and sanctions are not in the game."""
    cells = [levels for levels in design() if (levels["quota"] or levels["boundaries"]) == is_there]
    where = "where there is a quota or boundaries" if is_there else "where there is neither"
    return Contrast(
        label=f"{factor} {where}, {'income' if metric == 'income' else 'survival, turns'}",
        study="together",
        metric=metric,
        more=[name(levels) for levels in cells if levels[factor]],
        less=[name(levels) for levels in cells if not levels[factor]],
    )


def contrasts() -> list[Contrast]:
    """All that the pages name."""
    found = []
    for metric in ("income", "survival_steps"):
        for factor in ("sanctions", "monitoring"):
            found.append(with_rule(factor, metric=metric, is_there=True))
    found.append(with_rule("sanctions", metric="income", is_there=False))
    found.append(with_rule("monitoring", metric="income", is_there=False))
    tax, quota = ["tax, best found"], ["quota, by hand"]
    equality = "income_equality"
    best = ["quota, best found"]
    teams = ["VDN", "QMIX", "MAPPO"]
    alone = ["DQN", "PPO", "IPPO"]
    found += [
        Contrast("best tax - quota by hand, income", "best_rules", "income", tax, quota),
        Contrast("best tax - quota by hand, equality of income", "best_rules", equality, tax, quota),
        Contrast("best tax - best quota, equality of income", "best_rules", equality, tax, best),
        Contrast("three teams - three that learn alone", LEARNERS, "collective_return", teams, alone),
    ]
    for one, other in (("VDN", "DQN"), ("QMIX", "DQN"), ("MAPPO", "PPO")):
        found.append(Contrast(f"{one} - {other}", LEARNERS, "collective_return", [one], [other]))
    for variant in ("as run", "published"):
        for worlds, last in ((16, 50), (256, 256)):
            more = [f"PPO, {variant}, {worlds} worlds"]
            less = [f"PPO, {variant}, 1 world"]
            label = f"PPO {variant}, {worlds} worlds - 1 world, last {last}"
            found.append(Contrast(label, "many_worlds", "collective_return", more, less, last))
    for change in ("quota", "penalty that is certain"):
        for metric, title in ((equality, "equality of income"), ("survival_steps", "survival, turns")):
            more = [f"DQN, full schedule: {change}"]
            less = ["DQN, full schedule: nothing changed"]
            label = f"full schedule, {change} - nothing changed, {title}, last 1,000"
            found.append(Contrast(label, "elsewhere", metric, more, less, 1_000))
    more = ["DQN, Melting Pot: quota"]
    less = ["DQN, Melting Pot: twice the apples"]
    found.append(Contrast("Melting Pot, quota - twice the apples, income", "elsewhere", "income", more, less))
    return found


def mean_of(contrast: Contrast, conditions: list[str], part: Part) -> NDArray[np.float64]:
    """The mean over conditions of each replica, [R]."""
    values = [values_of(contrast.study, one, contrast.metric, part, contrast.last) for one in conditions]
    return np.mean(values, axis=0)


def text_of(found: Estimate) -> str:
    """A difference with its interval and the p-value of this comparison alone."""
    return f"{found:+} | {found.p_value:.2g}"


def side_by_side() -> list[str]:
    """The conditions that are shown frozen beside learning, in Markdown."""
    lines = [
        "| condition | income while learning, apples | income frozen | frozen - while learning | "
        "equality of the harvest, frozen | equality of income, frozen |",
        "|---|" + "---:|" * 5,
    ]
    for label, (study, condition) in SIDE_BY_SIDE.items():
        learning = values_of(study, condition, "income", "training")
        frozen = values_of(study, condition, "income", "evaluation")
        cells = [estimate(learning), estimate(frozen)]
        equalities = [
            estimate(values_of(study, condition, metric, "evaluation"))
            for metric in ("equality", "income_equality")
        ]
        change = difference(frozen, learning, paired=True)
        texts = [*map(str, cells), f"{change:+}", *map(str, equalities)]
        lines.append(f"| {label} | {' | '.join(texts)} |")
    return lines


def main(*, out: Path = RESULTS / "governs" / "contrasts.md") -> None:
    """Write the tables.

    Args:
        out: the file.
    """
    lines = [
        "By `python recipes/study/contrasts.py`, which says what the columns mean.",
        "",
        *side_by_side(),
        "",
        "Each p is of one comparison, not corrected for the others. Of learners and of many worlds the "
        "harvest is compared, in apples.",
        "",
        "| contrast | while learning | p | frozen | p |",
        "|---|" + "---:|" * 4,
    ]
    for contrast in contrasts():
        cells = []
        for part in ("training", "evaluation"):
            pair = mean_of(contrast, contrast.more, part), mean_of(contrast, contrast.less, part)
            cells.append(text_of(difference(*pair, paired=True)))
        lines.append(f"| {contrast.label} | {' | '.join(cells)} |")
    out.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
