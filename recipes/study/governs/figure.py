"""What governs the commons, at a glance? The conditions of changes.py by group, the largest income first.

    python recipes/study/governs/figure.py

To be run in the root of the repository: reads docs/results/studies/changes, and draws rules_and_people.png
and resource_minds_weapons.png in docs/results/governs: two pictures, so that each can be read on a phone.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import tyro
from changes import CHANGES, NOTHING, STUDY
from judging import FROZEN, LEARNING, Measure, outcomes_of

from cprl.measuring.registry import INCOME, INCOME_EQUALITY
from cprl.measuring.statistics import Estimate, estimate
from cprl.measuring.table import where
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION
from cprl.terminal import style
from cprl.terminal.panels import draw_dots

GROUPS: Final = {
    "nothing": GREY,
    "institutions": ORANGE,
    "people": PURPLE,
    "resource": GREEN,
    "minds": BLUE,
    "weapons": VERMILION,
}
PICTURES: Final = {
    "rules_and_people.png": ("nothing", "institutions", "people"),
    "resource_minds_weapons.png": ("nothing", "resource", "minds", "weapons"),
}
TICKS: Final = (50, 100, 200, 500, 1000, 2500)
"""Apples, on both ends of the axis."""
LEFT_WHILE_LEARNING: Final = {"marker": "|", "markersize": 9, "markeredgewidth": 1.6, "zorder": 5}


def mean(condition: str, metric: str = INCOME, measure: Measure = FROZEN) -> Estimate:
    """Return a metric of a condition over its replicas."""
    return estimate([*outcomes_of(STUDY.name).values(condition, metric, measure).values()])


def random_income() -> float:
    """Return the income of agents that act at random on the unchanged board."""
    rows = where(outcomes_of(STUDY.name).table.windows("random"), condition=NOTHING, metric=INCOME)
    return float(np.mean(rows["value"].to_numpy()))


def rows_of(groups: Sequence[str]) -> list[tuple[str, str]]:
    """Return (group, condition) of each row of a picture."""
    members = [("nothing", NOTHING), *((change.group, change.name) for change in CHANGES)]
    by_income = sorted(members, key=lambda row: -mean(row[1]).value)
    return [row for group in groups for row in by_income if row[0] == group]


def draw(path: Path, groups: Sequence[str]) -> None:
    """Draw income and equality of the conditions of some groups."""
    rows = rows_of(groups)
    names = [name for _, name in rows]
    with style.drawing(path) as sheet:
        income, equality = sheet.panels(
            2, columns=2, row_height_em=1.7 * len(rows) + 6, sharey=True, width_ratios=(3, 1)
        )
        for group in groups:
            places = [place for place, row in enumerate(rows) if row[0] == group]
            look = {"across": True, "color": np.array(GROUPS[group]) / 255, "label": group}
            draw_dots(income, places, [mean(names[place]) for place in places], **look)
            draw_dots(equality, places, [mean(names[place], INCOME_EQUALITY) for place in places], **look)
            for axes in (income, equality):
                axes.axhline(places[-1] + 0.5, color="#d0d0d0", linewidth=0.8)
        learning = [mean(name, measure=LEARNING).value for name in names]
        income.plot(
            *(learning, range(len(names))),
            **{**LEFT_WHILE_LEARNING, "color": "#222222", "linestyle": "none", "label": "while learning"},
        )
        income.axvline(random_income(), **style.RANDOM_LINE_STYLE, label="random play")
        income.set_yticks(range(len(names)), names)
        income.set_xscale("log")
        income.set_xticks(TICKS, [f"{apples:,}" for apples in TICKS])
        income.minorticks_off()
        income.set_ylim(len(rows) - 0.3, -0.7)
        income.set_title("income, apples an episode (log)")
        equality.set_title("its equality")
        equality.set_xlim(right=1)
        for axes in (income, equality):
            axes.tick_params(top=True, labeltop=True)
            axes.grid(axis="x", alpha=0.3)
        sheet.title = "What governs the commons"
        sheet.caption = (
            "Dots: frozen weights in fresh worlds, with 95 % intervals by Student's t over 8 replicas; bars: "
            "the same agents while they learn. Random play is that of the unchanged board; changes of the "
            "resource also change what a board bears. (1) to (8): Ostrom's principles."
        )


def main(*, out: Path = Path("docs", "results", "governs")) -> None:
    """Draw both pictures.

    Args:
        out: the directory.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, groups in PICTURES.items():
        draw(out / name, groups)


if __name__ == "__main__":
    tyro.cli(main)
