"""What do the pages compare that no summary of a study does? Other settings, and planned contrasts.

    python recipes/study/contrasts.py

To be run in the root of the repository: reads tables in docs/results, and writes into docs/results/governs
contrasts.md, and elsewhere.md, what each change of elsewhere.py adds. "While learning" is the mean of the
last 30 episodes of a training, in which agents explore and their weights change after every turn; "frozen"
that of fresh episodes of the same agents at its end, whose weights no longer change and who explore half as
much. A contrast is the mean of some conditions minus that of others, in each replica.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
import tyro
from page import table

from cprl.measuring.registry import METRICS
from cprl.measuring.statistics import Estimate, difference, estimate, judge_family
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import values_of as replicas_of
from cprl.values.array_types import Float64

RESULTS: Final = Path("docs", "results")
LAST: Final = 30
"""Episodes at the end of each replica."""
LONGER: Final = {"PPO, 256 worlds": 256, "DQN, full schedule": 1_000}
"""Episodes at the end, by setting of elsewhere.py: one of each world, since the last 30 of 256 worlds are the
longest ones; and as many as agents need that go up and down over hundreds, chosen after the last 30 were
seen."""
UNCHANGED: Final = "nothing changed"

Part = Literal["training", "evaluation"]


@cache
def table_of(study: str) -> StudyTable:
    """Return the committed table of a study."""
    return StudyTable.read(RESULTS / "studies" / study / "table.parquet")


@cache
def _by_condition(study: str, metric: str, part: Part, last: int) -> Mapping[str, Mapping[int, float]]:
    return replicas_of(table_of(study).windows(part, last=last), metric)


def values_of(study: str, condition: str, metric: str, part: Part = "training", last: int = LAST) -> Float64:
    """Return a metric of each replica; "income" is the income, and without money the harvest."""
    values = _by_condition(study, metric, part, last).get(condition)
    same_as = METRICS[metric].same_as
    if not values and same_as is not None:
        values = _by_condition(study, same_as, part, last)[condition]
    return np.array(list(values.values()))


class Contrast(NamedTuple):
    """The mean of some conditions of a study minus that of others."""

    label: str
    study: str
    metric: str
    more: Sequence[str]
    less: Sequence[str]
    last: int = LAST
    """Episodes at the end of the training."""

    def difference(self, part: Part) -> Estimate:
        """Return the difference of the means over conditions, paired by replica."""
        means = []
        for conditions in (self.more, self.less):
            values = [values_of(self.study, one, self.metric, part, self.last) for one in conditions]
            means.append(np.mean(values, axis=0))
        return difference(*means, paired=True)


LEARNERS: Final = "../learners/commons"
EQUALITY: Final = "income_equality"
HARVEST: Final = "collective_return"
CONTRASTS: Final = [
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
            f"full schedule, {change} - {UNCHANGED}, {title}, last 1,000",
            "elsewhere",
            metric,
            [f"DQN, full schedule: {change}"],
            [f"DQN, full schedule: {UNCHANGED}"],
            1_000,
        )
        for change in ("quota", "penalty that is certain")
        for metric, title in ((EQUALITY, "equality of income"), ("survival_steps", "survival, turns"))
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


def contrasts() -> list[str]:
    """Return the contrasts in Markdown."""
    rows = []
    for contrast in CONTRASTS:
        cells = [contrast.label]
        for part in ("training", "evaluation"):
            change = contrast.difference(part)
            cells += [f"{change:+}", f"{change.p_value:.2g}"]
        rows.append(cells)
    return [
        "By `python recipes/study/contrasts.py`, which says what the columns mean.",
        "",
        "Each p is of one comparison, not corrected for the others. Of learners and of many worlds the "
        "harvest is compared, in apples.",
        "",
        *table(["contrast", "while learning", "p", "frozen", "p"], rows, numbers=4),
    ]


def elsewhere() -> list[str]:
    """Return tables in Markdown of what each change adds by setting, and how many times the income it
    gives."""
    longer = "While learning, longer ends: 256 episodes of PPO, 1,000 of the full schedule:"
    return [
        "Income, apples, and what each change adds, paired by replica.",
        "Stars: not 0 by Holm's method for the 24 changes of a table together.",
        "",
        *("While learning, the last 30 episodes:", "", *elsewhere_table("training", {})),
        *(longer, "", *elsewhere_table("training", LONGER)),
        *("Frozen, in fresh worlds:", "", *elsewhere_table("evaluation", {})),
    ]


def elsewhere_table(part: Part, last: Mapping[str, int]) -> list[str]:
    """Return a table of what each change adds by setting."""
    names = [name.partition(": ") for name in table_of("elsewhere").design.conditions]
    settings = list(dict.fromkeys(setting for setting, _, _ in names))
    changes = [change for change in dict.fromkeys(change for _, _, change in names) if change != UNCHANGED]
    bases = []
    pairs = []
    for setting in settings:
        episodes = last.get(setting, LAST)
        base, *others = (
            values_of("elsewhere", f"{setting}: {change}", "income", part, episodes)
            for change in (UNCHANGED, *changes)
        )
        mean = estimate(base)
        bases.append(f"{mean.value:,.0f} [{mean.low:,.0f}, {mean.high:,.0f}]")
        pairs += [(income, base) for income in others]
    texts = change_texts(pairs)
    lines = [[UNCHANGED, *bases]]
    lines += [[change, *texts[place :: len(changes)]] for place, change in enumerate(changes)]
    return table(["apples", *settings], lines, numbers=len(settings))


def change_texts(pairs: Sequence[tuple[Float64, Float64]]) -> list[str]:
    """Return the difference of each, paired by replica, and the ratio; stars by Holm's method for all of
    these."""
    changes = {(str(place),): difference(*pair, paired=True) for place, pair in enumerate(pairs)}
    texts = []
    for change, (value, base) in zip(judge_family(changes).values(), pairs, strict=True):
        texts.append(f"{change:+}{'*' * change.differs}, x {value.mean() / base.mean():.1f}")
    return texts


def main(*, out: Path = RESULTS / "governs") -> None:
    """Write the tables.

    Args:
        out: the directory.
    """
    for name, lines in {"contrasts": contrasts(), "elsewhere": elsewhere()}.items():
        (out / f"{name}.md").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
