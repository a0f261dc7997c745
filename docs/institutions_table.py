"""The runs of recipes/institutions.py as two Markdown tables and two figures, for docs/institutions.md.

    for name in none boundaries quota vote monitoring graduated_sanctions mediation sanctioner levies; do
        python recipes/institutions.py --institution $name --watch off --out runs/$name
    done
    python docs/institutions_table.py --runs runs --figures docs/institutions

A number is the mean of the last 30 episodes of a replica, then over replicas, with the 95 % interval by
Student's t over replicas. A difference is paired: replica r has the same seeds under each institution and
under none.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import pyarrow as pa
import tyro

from cprl.measuring.statistics import Estimate, Family, curve_interval, differences, estimates
from cprl.measuring.table import complete, labelled
from cprl.measuring.windows import centres, last_of, running_mean
from cprl.runs.curves import curves_of
from cprl.runs.episodes import read_episodes, read_table
from cprl.terminal import style
from cprl.terminal.panels import draw_dots, draw_line
from cprl.terminal.style import RANDOM_LINE
from cprl.terminal.text_tables import TextTable, markdown

NONE: Final = "none"
NAMES: Final = {
    NONE: "none",
    "boundaries": "1 boundaries",
    "quota": "2 quota",
    "vote": "3 vote on a tax",
    "monitoring": "4 monitored quota",
    "graduated_sanctions": "5 graduated sanctions",
    "mediation": "6 mediation",
    "sanctioner": "7 elected sanctioner",
    "levies": "8 nested levies",
}
"""Directories of runs, and what they are called; numbers are those of Ostrom's principles."""
METRICS: Final = {
    "collective_return": "harvest, apples",
    "equality": "equality of the harvest",
    "income": "income, apples",
    "income_equality": "equality of income",
    "sustainability": "sustainability, steps",
    "survival_steps": "survival, steps",
    "peacefulness": "peacefulness, steps",
}
LAST = 30
"""The number of episodes at the end that are compared."""
SMOOTHED = 10
"""The number of episodes of a running mean."""


def ends(runs: Mapping[str, Path]) -> pa.Table:
    """Return the last episodes of each replica, labelled by institution."""
    tables = []
    for name, run in runs.items():
        rows = complete(last_of(read_episodes(run), LAST))
        if "income_equality" not in rows.column_names:  # where no apple is paid
            rows = rows.append_column("income_equality", rows["equality"])
        tables.append(labelled(rows, institution=name))
    columns = ["institution", "replica", "episode", "agent", "steps", "terminated", *METRICS]
    return pa.concat_tables([table.select(columns) for table in tables])


def text_of(one: Estimate, *, sign: str = "") -> str:
    """Return an estimate with its interval, bold where it differs from 0."""
    numbers = (one.value, *one.interval)
    digits = 2 if max(map(abs, numbers)) < 5 else 0
    value, low, high = (f"{number:{sign}.{digits}f}" for number in numbers)
    text = f"{value} [{low}, {high}]"
    return f"**{text}**" if one.differs else text


def table(head: str, family: Family, *, sign: str = "") -> str:
    """Return a Markdown table with a row for each institution."""
    rows = []
    for name in NAMES:
        if (name, "equality") in family:
            cells = [text_of(family[name, metric], sign=sign) for metric in METRICS]
            rows.append([NAMES[name], *cells])
    lines = markdown(TextTable("", [head, *METRICS.values()], rows))
    return "\n".join(lines).replace(r"\*\*", "**")


def forest(family: Family, path: Path) -> None:
    """Draw the paired differences of every metric, with their intervals."""
    names = [name for name in NAMES if (name, "equality") in family]
    with style.drawing(path) as sheet:
        panels = sheet.panels(len(METRICS), columns=4, high=2.4 * len(names) + 6, sharey=True)
        for axes, metric in zip(panels, METRICS, strict=True):
            draw_dots(axes, range(len(names)), [family[name, metric] for name in names], across=True)
            axes.axvline(0, **RANDOM_LINE)
            axes.set_title(METRICS[metric])
            axes.set_yticks(range(len(names)), [NAMES[name] for name in names])
            axes.locator_params(axis="x", nbins=4)
        panels[0].invert_yaxis()
        sheet.title = "Differences from no institution"
        sheet.caption = f"Paired by replica; means of the last {LAST} episodes, 95 % intervals."


def courses(runs: Mapping[str, Path], path: Path) -> None:
    """Draw the harvest over the training under each institution, beside none and random play."""
    returns = {name: curves_of(run)["collective_return"] for name, run in runs.items()}
    by_chance = read_table(runs[NONE] / "evaluation" / "random.parquet")
    random = estimates(by_chance, "collective_return")["collective_return"].value
    others = [name for name in runs if name != NONE]
    with style.drawing(path) as sheet:
        panels = sheet.panels(len(others), columns=4, high=15, sharex=True, sharey=True)
        for axes, name in zip(panels, others, strict=True):
            for institution, colour in ((NONE, "#777777"), (name, style.MEAN)):
                curve = curve_interval(running_mean(returns[institution], SMOOTHED))
                at = centres(returns[institution], SMOOTHED)
                label = "no institution" if institution == NONE else "with the institution"
                draw_line(axes, at, curve, color=colour, label=label)
            axes.axhline(random, **RANDOM_LINE, label="random play")
            axes.set_title(NAMES[name])
        for axes in panels[-4:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("episode")
        sheet.title = "Harvest under each institution, apples"
        sheet.caption = f"Centred means of {SMOOTHED} episodes; bands: 95 % intervals."


def draw(runs: Path, figures: Path) -> Family:
    """Draw the figures of runs, each in a directory of its own name, and return the differences from none."""
    runs_by_name = finished(runs)
    changes = differences(ends(runs_by_name), list(METRICS), "institution", {"institution": NONE})
    figures.mkdir(exist_ok=True)
    forest(changes, figures / "differences.png")
    courses(runs_by_name, figures / "courses.png")
    return changes


def finished(runs: Path) -> dict[str, Path]:
    """Return the runs of a directory that have ended."""
    return {name: runs / name for name in NAMES if (runs / name / "evaluation").is_dir()}


def main(*, runs: Path, figures: Path) -> None:
    """Print the tables and draw the figures.

    Args:
        runs: the directory that holds the runs, each in a directory of its own name.
        figures: where the figures are written.
    """
    changes = draw(runs, figures)
    print(table("institution", estimates(ends(finished(runs)), list(METRICS), by="institution")))
    print(table("difference from none", changes, sign="+"))
    print(
        f"Bold: not 0 by Holm's method for {changes.tests} comparisons, those that are copies counted once."
    )


if __name__ == "__main__":
    tyro.cli(main)
