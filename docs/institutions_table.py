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
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cprl.measuring.statistics import Estimate, curve_interval, estimate, holm
from cprl.runs.curves import as_curves, centres, curves_of, running_mean
from cprl.runs.episodes import read_table
from cprl.terminal import style
from cprl.terminal.style import INTERVAL, MEAN, RANDOM_LINE, SMALL_PT

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
    "net": "harvest - fines + transfers",
    "equality": "equality",
    "sustainability": "sustainability, steps",
    "survival_steps": "survival, steps",
    "peacefulness": "peacefulness, steps",
}
LAST, SMOOTHED = 30, 10
"""Episodes at the end that are compared; episodes of a running mean."""

Values = NDArray[np.float64]


def of_replicas(run: Path) -> dict[str, Values]:
    """The mean of the last episodes of each replica, [R] by metric."""
    curves = curves_of(run)
    curves["net"] = np.sum([own for name, own in curves.items() if name.startswith("return_")], axis=0)
    return {name: np.nanmean(curves[name][:, -LAST:], 1) for name in METRICS}


def text_of(estimated: Estimate, *, sign: str = "") -> str:
    """An estimate with its interval."""
    numbers = estimated.value, estimated.low, estimated.high
    digits = 2 if max(map(abs, numbers)) < 5 else 0
    value, low, high = (f"{number:{sign}.{digits}f}" for number in numbers)
    return f"{value} [{low}, {high}]"


def difference_texts(differences: dict[str, dict[str, Estimate]]) -> dict[str, list[str]]:
    """Differences with their intervals; bold those that are not 0 by Holm's method for all of them."""
    estimates = [estimated for of_metric in differences.values() for estimated in of_metric.values()]
    is_different = holm([estimated.p_value for estimated in estimates])
    texts = [text_of(estimated, sign="+") for estimated in estimates]
    texts = [f"**{text}**" if differs else text for text, differs in zip(texts, is_different, strict=True)]
    rows = np.array(texts).reshape(len(differences), len(METRICS))
    return {name: list(row) for name, row in zip(differences, rows, strict=True)}


def table(head: str, rows: dict[str, list[str]]) -> str:
    """A Markdown table with a row for each institution."""
    columns = [head, *METRICS.values()]
    lines = ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * len(METRICS)]
    lines += ["| " + " | ".join([NAMES[name], *cells]) + " |" for name, cells in rows.items()]
    return "\n".join(lines)


def forest(differences: dict[str, dict[str, Estimate]], path: Path) -> None:
    """Draws the paired differences of every metric, with their intervals."""
    figure = Figure((12.0, 0.42 * len(differences) + 1.4), layout="constrained")
    names = list(differences)
    for axes, metric in zip(figure.subplots(1, len(METRICS), sharey=True), METRICS, strict=True):
        for place, name in enumerate(names):
            found = differences[name][metric]
            axes.plot([found.low, found.high], [place, place], color=INTERVAL, linewidth=2.5)
            axes.plot([found.value], [place], "o", color=MEAN, markersize=6)
        axes.axvline(0, **RANDOM_LINE)
        axes.set_title(METRICS[metric], fontsize=SMALL_PT)
        axes.set_yticks(range(len(names)), [NAMES[name] for name in names])
        axes.tick_params(labelsize=SMALL_PT)
    figure.axes[0].invert_yaxis()
    figure.suptitle(
        f"difference from none, paired by replica; means of the last {LAST} episodes, 95 % intervals",
        fontsize=SMALL_PT + 1,
    )
    style.save(figure, path)


def courses(runs: dict[str, Path], path: Path) -> None:
    """Draws the harvest over the training under each institution, beside none and random play."""
    returns = {name: curves_of(run)["collective_return"] for name, run in runs.items()}
    random = as_curves(read_table(runs[NONE] / "evaluation" / "random.parquet"))["collective_return"].mean()
    others = [name for name in runs if name != NONE]
    rows = -(-len(others) // 4)
    figure = Figure((12.0, 2.6 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, 4, sharex=True, sharey=True, squeeze=False).reshape(-1)
    for axes, name in zip(grid, others, strict=False):
        for own, colour in ((NONE, "#777777"), (name, MEAN)):
            smooth = running_mean(returns[own], SMOOTHED)
            at = centres(returns[own], SMOOTHED)
            middle, low, high = curve_interval(smooth)
            axes.fill_between(at, low, high, color=colour, alpha=0.25, linewidth=0)
            axes.plot(
                at, middle, color=colour, linewidth=2, label=NAMES[own] if own != NONE else "no institution"
            )
        axes.axhline(random, **RANDOM_LINE, label="random play")
        axes.set_title(NAMES[name], fontsize=SMALL_PT + 1)
        axes.tick_params(labelsize=SMALL_PT)
    for axes in grid[len(others) :]:
        axes.set_visible(False)
    figure.supxlabel("episode", fontsize=SMALL_PT + 1)
    figure.supylabel(f"harvest, apples; centred mean of {SMOOTHED} episodes", fontsize=SMALL_PT + 1)
    handles, labels = grid[0].get_legend_handles_labels()
    labels[1] = "with the institution"
    figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=SMALL_PT)
    style.save(figure, path)


def main(*, runs: Path, figures: Path) -> None:
    """Prints the tables and draws the figures.

    Args:
        runs: the directory that holds the runs, each in a directory of its own name.
        figures: where the figures are written.
    """
    found = {name: runs / name for name in NAMES if (runs / name / "evaluation").is_dir()}
    values = {name: of_replicas(run) for name, run in found.items()}
    levels = {name: [text_of(estimate(own[metric])) for metric in METRICS] for name, own in values.items()}
    print(table("institution", levels), end="\n\n")
    differences = {
        name: {metric: estimate(own[metric] - values[NONE][metric]) for metric in METRICS}
        for name, own in values.items()
        if name != NONE
    }
    print(table("difference from none", difference_texts(differences)))
    figures.mkdir(exist_ok=True)
    forest(differences, figures / "differences.png")
    courses(found, figures / "courses.png")


if __name__ == "__main__":
    tyro.cli(main)
