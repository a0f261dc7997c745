"""The runs of recipes/institutions.py as two Markdown tables and two figures, for docs/institutions.md.

    for name in none boundaries quota vote monitoring graduated_sanctions mediation sanctioner levies; do
        python recipes/institutions.py --institution $name --watch off --out runs/$name
    done
    python docs/institutions_table.py --runs runs --figures docs/institutions

A number is the mean of the last 30 episodes of a replica, then over replicas, with the 95 % interval by
Student's t over replicas. A difference is paired: replica r has the same seeds under each institution and
under none.
"""

from pathlib import Path
from typing import Final

import numpy as np
import tyro
from numpy.typing import NDArray

from cprl.experiment import presets
from cprl.measuring.statistics import Estimate, curve_interval, estimate, holm
from cprl.measuring.windows import centres, running_mean
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.terminal import style
from cprl.terminal.style import INTERVAL, MEAN, RANDOM_LINE

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
WITHOUT_MONEY: Final = {"income": "collective_return", "income_equality": "equality"}
"""By the metric of income: that of the harvest, of which it is a copy where no apple is paid and lost."""
LAST, SMOOTHED = 30, 10
"""Episodes at the end that are compared; episodes of a running mean."""
CLOCK: Final = presets.game("commons").rules.episode_steps
"""The turns of an episode at most."""

Values = NDArray[np.float64]


def of_replicas(run: Path) -> dict[str, Values]:
    """The mean of the last episodes of each replica, [R] by metric."""
    curves = curves_of(run)
    curves.setdefault("income_equality", curves["equality"])
    return {name: np.nanmean(curves[name][:, -LAST:], 1) for name in METRICS}


def text_of(estimated: Estimate, *, sign: str = "") -> str:
    """An estimate with its interval."""
    numbers = estimated.value, *estimated.interval
    digits = 2 if max(map(abs, numbers)) < 5 else 0
    value, low, high = (f"{number:{sign}.{digits}f}" for number in numbers)
    return f"{value} [{low}, {high}]"


def difference_texts(differences: dict[str, dict[str, Estimate]]) -> tuple[dict[str, list[str]], int]:
    """Differences with their intervals, bold where they are not 0 by Holm's method, and how many that
    compared: a metric of income that is the harvest's, since nothing is lost, counts once."""
    compared = {
        (name, metric): estimated
        for name, of_metric in differences.items()
        for metric, estimated in of_metric.items()
        if not is_copy(metric, of_metric)
    }
    is_different = holm([estimated.p_value for estimated in compared.values()])
    marks = dict(zip(compared, is_different, strict=True))
    rows: dict[str, list[str]] = {}
    for name, of_metric in differences.items():
        rows[name] = []
        for metric, estimated in of_metric.items():
            counted = WITHOUT_MONEY[metric] if is_copy(metric, of_metric) else metric
            text = text_of(estimated, sign="+")
            rows[name].append(f"**{text}**" if marks[name, counted] else text)
    return rows, len(compared)


def is_copy(metric: str, differences: dict[str, Estimate]) -> bool:
    """Whether a metric of income is in a row what that of the harvest is."""
    if metric not in WITHOUT_MONEY:
        return False
    own, other = differences[metric], differences[WITHOUT_MONEY[metric]]
    return np.allclose((own.value, own.low, own.high), (other.value, other.low, other.high), atol=1e-9)


def table(head: str, rows: dict[str, list[str]]) -> str:
    """A Markdown table with a row for each institution."""
    columns = [head, *METRICS.values()]
    lines = ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * len(METRICS)]
    lines += ["| " + " | ".join([NAMES[name], *cells]) + " |" for name, cells in rows.items()]
    return "\n".join(lines)


def forest(differences: dict[str, dict[str, Estimate]], path: Path) -> None:
    """Draws the paired differences of every metric, with their intervals."""
    names = list(differences)
    with style.drawing(path) as sheet:
        panels = sheet.panels(len(METRICS), columns=4, high=2.4 * len(names) + 6, sharey=True)
        for axes, metric in zip(panels, METRICS, strict=True):
            for place, name in enumerate(names):
                found = differences[name][metric]
                axes.plot([found.low, found.high], [place, place], color=INTERVAL, linewidth=2.5)
                axes.plot([found.value], [place], "o", color=MEAN, markersize=6)
            axes.axvline(0, **RANDOM_LINE)
            axes.set_title(METRICS[metric])
            axes.set_yticks(range(len(names)), [NAMES[name] for name in names])
            axes.locator_params(axis="x", nbins=4)
        panels[0].invert_yaxis()
        sheet.title = "Differences from no institution"
        sheet.caption = f"Paired by replica; means of the last {LAST} episodes, 95 % intervals."


def courses(runs: dict[str, Path], path: Path) -> None:
    """Draws the harvest over the training under each institution, beside none and random play."""
    returns = {name: curves_of(run)["collective_return"] for name, run in runs.items()}
    random = as_curves(read_table(runs[NONE] / "evaluation" / "random.parquet"))["collective_return"].mean()
    others = [name for name in runs if name != NONE]
    with style.drawing(path) as sheet:
        panels = sheet.panels(len(others), columns=4, high=15, sharex=True, sharey=True)
        for axes, name in zip(panels, others, strict=True):
            for institution, colour in ((NONE, "#777777"), (name, MEAN)):
                middle, low, high = curve_interval(running_mean(returns[institution], SMOOTHED))
                at = centres(returns[institution], SMOOTHED)
                label = "no institution" if institution == NONE else "with the institution"
                axes.fill_between(at, low, high, color=colour, alpha=0.25, linewidth=0)
                axes.plot(at, middle, color=colour, linewidth=2, label=label)
            axes.axhline(random, **RANDOM_LINE, label="random play")
            axes.set_title(NAMES[name])
        for axes in panels[-4:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("episode")
        sheet.title = "Harvest under each institution, apples"
        sheet.caption = f"Centred means of {SMOOTHED} episodes; bands: 95 % intervals."


def main(*, runs: Path, figures: Path) -> None:
    """Prints the tables and draws the figures.

    Args:
        runs: the directory that holds the runs, each in a directory of its own name.
        figures: where the figures are written.
    """
    found = {name: runs / name for name in NAMES if (runs / name / "evaluation").is_dir()}
    values = {name: of_replicas(run) for name, run in found.items()}
    levels = {
        name: [text_of(estimate(own[metric]).of(metric, CLOCK)) for metric in METRICS]
        for name, own in values.items()
    }
    print(table("institution", levels), end="\n\n")
    differences = {
        name: {metric: estimate(own[metric] - values[NONE][metric]) for metric in METRICS}
        for name, own in values.items()
        if name != NONE
    }
    texts, compared = difference_texts(differences)
    print(table("difference from none", texts), end="\n\n")
    print(f"Bold: not 0 by Holm's method for {compared} comparisons, those that are copies counted once.")
    figures.mkdir(exist_ok=True)
    forest(differences, figures / "differences.png")
    courses(found, figures / "courses.png")


if __name__ == "__main__":
    tyro.cli(main)
