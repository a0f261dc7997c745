"""What governs the commons, row by row? The page beside the figures of figure.py, which answers to a finger.

    python recipes/study/governs/governs_page.py

To be run in the root of the repository: reads docs/results/studies/changes, and writes what_governs.html in
docs/results/governs. Its numbers are the texts of judged.md, made by the same functions: the page draws what
it says, and says no digit that the tables do not have. governs_page.html is the page without its numbers.
"""

import json
from pathlib import Path
from typing import Any, Final

import changes
import tyro
from asking import RESULTS
from bounds import BOUNDS, read_bounds
from changes import EXPECTATIONS
from figure import GROUPS, TICKS, random_income, rows_of
from judging import LEARNING, change_text, judge, mean_text, outcomes_of, share_texts

from cprl.measuring.registry import INCOME_EQUALITY

PAGE: Final = "what_governs.html"
TEMPLATE: Final = Path("recipes", "study", "governs", "governs_page.html")
PLACE: Final = "{figures}"
"""Where the numbers stand in the template."""
COLUMNS: Final = (
    *("name", "group", "income", "learning", "survival", "equality", "ofMost", "ofBest"),
    *("replicas", "expected", "verdict", "difference"),
)
"""What a row of the page has; the last three only where something was changed."""


def figures() -> dict[str, Any]:
    """Return all numbers of the page; those with an interval as texts, "460 [449, 470]"."""
    outcomes = outcomes_of(changes.STUDY.name)
    clocks = outcomes.table.design.clocks
    bounds = read_bounds(BOUNDS)
    conditions = {condition.name: condition for condition in changes.STUDY.all_conditions}
    judged = {one.expectation.label: one for one in judge(outcomes, EXPECTATIONS)}
    rows = []
    for group, name in rows_of([*GROUPS]):
        income = outcomes.values(name)
        row = [
            *(name, group, mean_text(income), mean_text(outcomes.values(name, measure=LEARNING))),
            mean_text(outcomes.values(name, "survival_steps"), "survival_steps", clocks[name]),
            mean_text(outcomes.values(name, INCOME_EQUALITY), INCOME_EQUALITY),
            *share_texts(conditions[name], outcomes, bounds),
            len(income),
        ]
        if name in judged:
            expected = judged[name].expectation.sign
            row += [expected, judged[name].verdict, change_text(judged[name].change)]
        rows.append(row)
    return {
        "columns": COLUMNS,
        "rows": rows,
        "groups": {group: f"rgb{colour}" for group, colour in GROUPS.items()},
        "random": round(random_income()),
        "turns": int(max(clocks.values())),
        "ticks": TICKS,
        "expectations": len(judged),
    }


def page() -> str:
    """Return the page with its numbers, a row of them on each line."""
    made = figures()
    rows = ",\n".join(json.dumps(row) for row in made.pop("rows"))
    text = f'{json.dumps(made)[:-1]}, "rows": [\n{rows}\n]}}'
    return TEMPLATE.read_text(encoding="utf-8").replace(PLACE, text)


def main(*, out: Path = RESULTS.parent / "governs") -> None:
    """Write the page.

    Args:
        out: the directory.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / PAGE).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
