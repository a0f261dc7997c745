"""What do institutions do to the tragedy? Three tables and a figure of the study of changes.py.

    python recipes/study/governs/institutions_page.py

To be run in the root of the repository: reads docs/results/studies/changes and writes institutions.md there
and docs/institutions/courses.png, which docs/institutions.md quotes and shows. judging.py says what is
measured, and in which family of tests it is judged.
"""

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from asking import RESULTS
from changes import CHANGES, EXPECTATIONS, NOTHING
from judging import FROZEN, LEARNING, MEASURES, Judged, Measure, Outcomes, judge, outcomes_of
from page import table

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY
from cprl.measuring.statistics import Estimate, curve_interval, difference, estimate
from cprl.measuring.table import by_replica, where
from cprl.terminal import style
from cprl.terminal.panels import draw_dots, draw_line
from cprl.terminal.style import RANDOM_LINE_STYLE
from cprl.values.array_types import Float64, Int64

STUDY: Final = "changes"
FIGURE: Final = Path("docs", "institutions", "courses.png")
LIMIT: Final = "quota (2)"
"""The rule that the others are compared with, besides none."""
RULES: Final = tuple(change.name for change in CHANGES if change.group == "institutions")
DRAWN: Final = {
    "boundaries (1)": "boundaries",
    "quota (2)": "quota",
    "vote on a tax (3)": "vote",
    "monitored quota (4)": "monitoring",
    "graduated sanctions (5)": "graduated_sanctions",
    "mediation (6)": "mediation",
    "elected sanctioner (7)": "sanctioner",
    "nested levies (8)": "levies",
}
"""The conditions that are drawn, and the words for them of recipes/institutions.py."""
POINTS: Final = 20
"""Points of the course of a training."""
NUMBERS: Final[dict[str, tuple[str, Measure]]] = {
    **{f"income {measure}": (INCOME, measure) for measure in MEASURES},
    "its equality": (INCOME_EQUALITY, FROZEN),
    "survival, steps": ("survival_steps", FROZEN),
    "harvest": (COLLECTIVE_RETURN, FROZEN),
}
"""The columns of the tables: the metric, and how it is measured."""


def values(outcomes: Outcomes, condition: str, metric: str, measure: Measure) -> Float64:
    """Return a metric of a condition in each replica, [R]."""
    return np.array([*outcomes.values(condition, metric, measure).values()])


def level(outcomes: Outcomes, condition: str, metric: str, measure: Measure) -> Estimate:
    """Return the mean of a metric over the replicas of a condition."""
    clock = outcomes.table.design.clocks[condition]
    return estimate(values(outcomes, condition, metric, measure)).bounded(metric, clock)


def change(
    outcomes: Outcomes, condition: str, metric: str, measure: Measure, reference: str = NOTHING
) -> Estimate:
    """Return how much more a condition has than another one, paired by replica."""
    changed = values(outcomes, condition, metric, measure)
    return difference(changed, values(outcomes, reference, metric, measure), paired=True)


def stopped(outcomes: Outcomes, condition: str) -> Estimate:
    """Return how much more income agents have once they are frozen than while they learn."""
    frozen, learning = (values(outcomes, condition, INCOME, measure) for measure in (FROZEN, LEARNING))
    return difference(frozen, learning, paired=True)


def level_row(outcomes: Outcomes, condition: str) -> list[str]:
    """Return a condition with its means."""
    means = [str(level(outcomes, condition, *number)) for number in NUMBERS.values()]
    return [condition, *means, f"{stopped(outcomes, condition):+}"]


def change_row(outcomes: Outcomes, condition: str, reference: str = NOTHING) -> list[str]:
    """Return a condition with its differences from another one."""
    changes = [change(outcomes, condition, *number, reference) for number in NUMBERS.values()]
    return [condition, *(f"{one:+}" for one in changes)]


def lines(outcomes: Outcomes) -> list[str]:
    """Return the lines of the page of tables, of the rules that have been trained."""
    judged = {one.expectation.label: one for one in judge(outcomes, EXPECTATIONS)}
    trained = [name for name in RULES if name in judged]
    levels = [level_row(outcomes, name) for name in (NOTHING, *trained)]
    changes = [change_row(outcomes, name) + expected_and_found(judged[name]) for name in trained]
    beside = [change_row(outcomes, name, LIMIT) for name in trained if name != LIMIT]
    return [
        "# What institutions do to the tragedy",
        "",
        "By `python recipes/study/governs/institutions_page.py`: the rules among the changes of this study.",
        "Apples are of all agents together; what is not said otherwise is frozen at 0.05.",
        "Brackets are 95 % intervals over replicas by Student's t.",
        f"Random play harvests {random_play(outcomes)} apples without a rule.",
        "",
        *table(["", *NUMBERS, "income frozen minus learning"], levels, numbers=len(NUMBERS) + 1),
        "Differences from nothing changed, paired by replica; the verdict is on the first column, in one",
        f"family of tests of {len(judged)} changes.",
        "",
        *table(["", *NUMBERS, "expected", "verdict"], changes),
        f"Differences from {LIMIT}, paired by replica, in no family of tests.",
        "",
        *table(["", *NUMBERS], beside, numbers=len(NUMBERS)),
    ]


def expected_and_found(judged: Judged) -> list[str]:
    """Return what was expected of the income, and the verdict."""
    return [judged.expectation.sign, judged.verdict]


def course(courses: pa.Table, condition: str) -> tuple[Int64, Float64]:
    """Return the last steps of the `POINTS` of a training, [P], and the income in each replica, [R, P].

    Every world ends an episode within a point, however long boards last.
    """
    rows = where(courses, condition=condition, metric=INCOME)
    rows = rows.sort_by([("replica", "ascending"), ("step", "ascending")])
    replicas = len(rows["replica"].unique())
    steps = np.unique(rows["step"].to_numpy()).reshape(POINTS, -1)[:, -1]
    episodes = rows["episodes"].to_numpy().reshape(replicas, POINTS, -1)
    means = rows["value"].to_numpy().astype(np.float64).reshape(episodes.shape)
    return steps, np.nansum(means * episodes, axis=2) / episodes.sum(2)


def random_play(outcomes: Outcomes) -> Estimate:
    """Return the harvest of random play without institutions."""
    rows = where(outcomes.table.windows("random"), condition=NOTHING)
    return estimate(by_replica(rows, COLLECTIVE_RETURN)["value"].to_numpy())


def draw(outcomes: Outcomes, courses: pa.Table, path: Path) -> None:
    """Draw the income over the training under each institution, and frozen at its end, beside none."""
    with style.drawing(path) as sheet:
        panels = sheet.panels(len(DRAWN), columns=4, row_height_em=15, sharex=True, sharey=True)
        for axes, name in zip(panels, DRAWN, strict=True):
            for condition, colour, place in ((NOTHING, "#777777", 1.06), (name, style.MEAN_COLOUR, 1.12)):
                label = "no institution" if condition == NOTHING else "with the institution"
                steps, income = course(courses, condition)
                thousands = steps / 1000
                draw_line(axes, thousands, curve_interval(income), color=colour, label=label)
                end = level(outcomes, condition, INCOME, FROZEN)
                draw_dots(axes, [place * thousands[-1]], [end], color=colour)
            axes.axhline(random_play(outcomes).value, **RANDOM_LINE_STYLE, label="random play")
            axes.set_title(name)
        sheet.xlabel = "thousand steps"
        sheet.title = "Income under each institution, apples"
        sheet.caption = (
            "Lines: means of the episodes that end within 20,000 steps, while agents learn; dots: frozen, in "
            "fresh worlds; bands and bars: 95 % intervals."
        )


def draw_courses(results: Path = RESULTS, figure: Path = FIGURE) -> None:
    """Draw the figure from the tables of the study."""
    courses = pq.read_table(results / STUDY / "courses.parquet")
    draw(outcomes_of(STUDY, results), courses, figure)


def main() -> None:
    """Write the page of tables, and the figure."""
    text = "\n".join(lines(outcomes_of(STUDY)))
    (RESULTS / STUDY / "institutions.md").write_text(text, encoding="utf-8")
    draw_courses()


if __name__ == "__main__":
    main()
