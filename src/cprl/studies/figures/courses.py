"""The course of a training under each condition: running means over its episodes, beside random play."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cprl.measuring.statistics import curve_interval
from cprl.runs.curves import SMOOTHED_EPISODES, running_mean
from cprl.studies.figures.levels import (
    MOST_CONDITIONS,
    colours_of,
    is_one,
    legend,
    names_of,
    replicas_text,
    short,
    with_counts,
)
from cprl.studies.tables.comparing import compare, metric_title, metrics_of
from cprl.studies.tables.sources import RANDOM, TRAINING
from cprl.studies.tables.table import StudyTable
from cprl.terminal.style import RANDOM_LINE, SMALL_PT, head, picture_path, save

METRICS: Final = ("collective_return", "survival_steps")
"""What is drawn unless something else is asked for."""
_PART: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
_MOST_TOGETHER: Final = 6
"""Conditions that one panel shows; more have a panel each, beside the reference."""
_REFERENCE: Final = "#777777"

Values = NDArray[np.float64]


def courses(table: StudyTable, path: Path | str, *, metrics: Sequence[str] = ()) -> Path:
    """Draws the mean over replicas in the course of the training, its 95 % interval, and random play.

    Up to six conditions share panels, one for each metric; more have a panel each, of the first metric, with
    the reference beside it in grey. Running means are over whole windows of the table and centred.

    Args:
        metrics: by default the collective return and survival; else the first that the table has.
    """
    path, design = picture_path(path), table.design
    chosen = metrics_of(table, metrics or [own for own in METRICS if own in table.metrics])[
        : len(metrics) or 2
    ]
    names = with_counts(names_of(design), table.replicas)
    shown = [own for own in design.conditions if table.replicas[own]]
    if len(shown) > MOST_CONDITIONS:
        raise ValueError(f"the table has {len(shown)} conditions; allowed: up to {MOST_CONDITIONS}")
    curves = {(name, own): _course(table, name, own) for name in shown for own in chosen}
    windows = sorted({own[2] for own in curves.values()}) or [1]
    over = f"{windows[0]} to {windows[-1]}" if len(windows) > 1 else f"{windows[0]}"
    note = f"{replicas_text(table.replicas)}. "
    note += f"Centred running means over {over} episodes" if windows[-1] > 1 else "Nothing is smoothed"
    note += ", then over replicas; bands: 95% intervals over replicas by Student's t."
    if len(shown) <= _MOST_TOGETHER:
        figure = _together(table, shown, chosen, names, curves)
    else:
        figure = _apart(table, shown, chosen[0], names, curves)
    head(figure, f"{design.name}: the course of the training", note)
    return save(figure, path)


def _course(table: StudyTable, condition: str, metric: str) -> tuple[Values, Values, int]:
    """Centres, [W], running means of each replica, [R, W], and the episodes of a running mean."""
    rows = table.values(condition, metric, TRAINING)
    if rows is None:
        return np.zeros(0), np.zeros((1, 0)), 1
    lengths: Any = rows["window_episodes"]
    length, episodes = int(lengths.max()), int(lengths.sum())
    whole = lengths == length
    count = max(1, min(SMOOTHED_EPISODES, episodes // _PART) // length)
    means = running_mean(rows["value"][:, whole], count)
    middles = rows["episode"][whole] + (length - 1) / 2
    return running_mean(middles.astype(np.float64), count), means, min(count, int(whole.sum())) * length


def _together(
    table: StudyTable,
    shown: Sequence[str],
    metrics: Sequence[str],
    names: dict[str, str],
    curves: dict[tuple[str, str], tuple[Values, Values, int]],
) -> Figure:
    """All conditions in one panel for each metric."""
    design = table.design
    figure = Figure((9.0, 2.9 * len(metrics) + 1.4), layout="constrained")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]
    levels = [next(iter(design.conditions[own].values()), own) for own in shown]
    colours = colours_of(shown, levels if len(design.factors) == 1 else list(shown))
    random = [compare(table, metric, part=RANDOM).by_name for metric in metrics]
    levels_of = [{own: by_name[own].estimate for own in shown} for by_name in random]
    same = all(is_one(found.values()) for found in levels_of)
    for axes, metric, found in zip(panels, metrics, levels_of, strict=True):
        for name in shown:
            _draw(axes, curves[name, metric], colours[name], names[name].replace("\n", " "))
            level = found[name]
            if level is not None and not same:
                axes.axhline(level.value, **{**RANDOM_LINE, "color": colours[name], "linewidth": 1.0})
        level = found[shown[0]] if shown else None
        if level is not None:
            if same:
                axes.axhline(level.value, **RANDOM_LINE, label="random play")
            else:
                axes.plot([], [], **RANDOM_LINE, label="random play, in the colour of its condition")
        axes.set_ylabel(metric_title(metric), fontsize=SMALL_PT + 1)
        _begin_at_0([axes])
        axes.tick_params(labelsize=SMALL_PT)
    panels[-1].set_xlabel("episode", fontsize=SMALL_PT + 1)
    heading = short(design.factors[0]) if len(design.factors) == 1 else None
    legend(figure, panels[0], title=heading)
    return figure


def _apart(
    table: StudyTable,
    shown: Sequence[str],
    metric: str,
    names: dict[str, str],
    curves: dict[tuple[str, str], tuple[Values, Values, int]],
) -> Figure:
    """A panel for each condition but the reference, which is in all."""
    reference = table.design.reference
    others = [own for own in shown if own != reference]
    columns = 4
    rows = -(-len(others) // columns)
    figure = Figure((12.0, 2.5 * rows + 1.6), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).reshape(-1)
    random = compare(table, metric, part=RANDOM).by_name
    for axes, name in zip(panels, others, strict=False):
        if reference in shown:
            label = f"reference: {names[reference]}".replace("\n", " ")
            _draw(axes, curves[reference, metric], _REFERENCE, label)
        _draw(axes, curves[name, metric], "#08519c", "the condition of the panel")
        level = random[name].estimate
        if level is not None:
            axes.axhline(level.value, **RANDOM_LINE, label="random play under the condition of the panel")
        axes.set_title(names[name], fontsize=SMALL_PT)
        axes.tick_params(labelsize=SMALL_PT)
    _begin_at_0(list(panels))  # earlier it would cut what is drawn later
    for axes in panels[len(others) :]:
        axes.set_visible(False)
    for axes in panels[max(len(others) - columns, 0) : len(others)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("episode", fontsize=SMALL_PT)
    figure.supylabel(metric_title(metric), fontsize=SMALL_PT + 1)
    legend(figure, panels[0])
    return figure


def _begin_at_0(panels: Sequence[Axes]) -> None:
    """Lets the axis that panels share begin at 0, unless some of what they show is below."""
    if all(axes.dataLim.y0 >= 0 for axes in panels):
        panels[0].set_ylim(0, None)


def _draw(axes: Axes, course: tuple[Values, Values, int], colour: str, label: str) -> None:
    at, values, _ = course
    if not len(at):
        return
    middle, low, high = curve_interval(values)
    axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
    label = f"\N{ZERO WIDTH SPACE}{label}" if label.startswith("_") else label  # matplotlib would hide it
    axes.plot(at, middle, color=colour, linewidth=2, marker="." if len(at) < 3 else None, label=label)
