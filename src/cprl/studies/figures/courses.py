"""The course of a training under each condition: running means over its episodes, beside random play."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

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
)
from cprl.studies.tables.comparing import compare, metric_title, metrics_of
from cprl.studies.tables.table import RANDOM, TRAINING, StudyTable
from cprl.terminal.style import RANDOM_LINE, SMALL_PT, head, picture_path, save

METRICS: Final = ("collective_return", "survival_steps")
"""What is drawn unless something else is asked for."""
_PART: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
_MOST_TOGETHER: Final = 6
"""Conditions that one panel shows; more have a panel each, beside the reference."""
_COLUMNS: Final = 4

Values = NDArray[np.float64]
Lines = Mapping[str, tuple[str, str]]
"""The colour and the label of conditions that a panel shows."""


def courses(table: StudyTable, path: Path | str, *, metrics: Sequence[str] = ()) -> Path:
    """Draws the mean over replicas in the course of the training, its 95 % interval, and random play.

    Up to six conditions share panels, one for each metric; more have a panel each, of the first metric, with
    the reference beside it in grey. Running means are over whole windows of the table and centred.

    Args:
        metrics: by default the collective return and survival; else the first that the table has.
    """
    path, design = picture_path(path), table.design
    usual = [metric for metric in METRICS if metric in table.metrics]
    chosen = metrics_of(table, metrics or usual)[: len(metrics) or 2]
    conditions = [name for name in design.conditions if table.replicas[name]]
    if len(conditions) > MOST_CONDITIONS:
        raise ValueError(f"the table has {len(conditions)} conditions; allowed: up to {MOST_CONDITIONS}")
    names = names_of(table)
    if len(conditions) <= _MOST_TOGETHER:
        figure, windows = _together(table, conditions, chosen, names)
    else:
        figure, windows = _apart(table, conditions, chosen[0], names)
    over = f"{min(windows)} to {max(windows)}" if len(windows) > 1 else f"{max(windows)}"
    note = f"{replicas_text(table.replicas)}. "
    note += f"Centred running means over {over} episodes" if max(windows) > 1 else "Nothing is smoothed"
    note += ", then over replicas; bands: 95% intervals over replicas by Student's t."
    head(figure, f"{design.name}: the course of the training", note)
    return save(figure, path)


def _together(
    table: StudyTable, conditions: Sequence[str], metrics: Sequence[str], names: Mapping[str, str]
) -> tuple[Figure, set[int]]:
    """All conditions in one panel for each metric; with the episodes of running means."""
    design = table.design
    factor = design.factors[0] if len(design.factors) == 1 else None
    levels = [name if factor is None else design.conditions[name][factor] for name in conditions]
    colours = colours_of(conditions, levels)
    lines = {name: (colours[name], names[name]) for name in conditions}
    figure = Figure((9.0, 2.9 * len(metrics) + 1.4), layout="constrained")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]
    random = [compare(table, metric, part=RANDOM).by_name for metric in metrics]
    is_same = all(is_one(by_name[name].estimate for name in conditions) for by_name in random)
    windows: set[int] = set()
    for axes, metric, by_name in zip(panels, metrics, random, strict=True):
        windows |= _draw(axes, table, metric, lines)
        known = {name: level.value for name in conditions if (level := by_name[name].estimate) is not None}
        for name, value in list(known.items())[: 1 if is_same else None]:
            colour = RANDOM_LINE["color"] if is_same else colours[name]
            axes.axhline(value, **{**RANDOM_LINE, "color": colour, "linewidth": 1.4 if is_same else 1.0})
        if known:
            text = "random play" if is_same else "random play, in the colour of its condition"
            axes.plot([], [], **RANDOM_LINE, label=text)
        axes.set_ylabel(metric_title(metric), fontsize=SMALL_PT + 1)
        _begin_at_0([axes])
        axes.tick_params(labelsize=SMALL_PT)
    panels[-1].set_xlabel("episode", fontsize=SMALL_PT + 1)
    legend(figure, panels[0], title=None if factor is None else short(factor))
    return figure, windows


def _apart(
    table: StudyTable, conditions: Sequence[str], metric: str, names: Mapping[str, str]
) -> tuple[Figure, set[int]]:
    """A panel for each condition but the reference, which is in all; with the episodes of running means."""
    reference = table.design.reference
    others = [name for name in conditions if name != reference]
    rows = -(-len(others) // _COLUMNS)
    figure = Figure((12.0, 2.5 * rows + 1.6), layout="constrained")
    panels = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False).reshape(-1)
    random = compare(table, metric, part=RANDOM).by_name
    windows: set[int] = set()
    for axes, name in zip(panels, others, strict=False):
        lines = {reference: ("#777777", f"reference: {names[reference]}")} if reference in conditions else {}
        windows |= _draw(axes, table, metric, {**lines, name: ("#08519c", "the condition of the panel")})
        level = random[name].estimate
        if level is not None:
            axes.axhline(level.value, **RANDOM_LINE, label="random play under the condition of the panel")
        axes.set_title(names[name], fontsize=SMALL_PT)
        axes.tick_params(labelsize=SMALL_PT)
    _begin_at_0(list(panels))  # earlier it would cut what is drawn later
    for axes in panels[len(others) :]:
        axes.set_visible(False)
    for axes in panels[max(len(others) - _COLUMNS, 0) : len(others)]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel("episode", fontsize=SMALL_PT)
    figure.supylabel(metric_title(metric), fontsize=SMALL_PT + 1)
    legend(figure, panels[0])
    return figure, windows


def _begin_at_0(panels: Sequence[Axes]) -> None:
    """Lets the axis that panels share begin at 0, unless some of what they show is below."""
    if all(axes.dataLim.y0 >= 0 for axes in panels):
        panels[0].set_ylim(0, None)


def _draw(axes: Axes, table: StudyTable, metric: str, lines: Lines) -> set[int]:
    """Draws the courses of conditions; returns over how many episodes their running means are."""
    windows = set()
    for name, (colour, label) in lines.items():
        grid = table.values(name, metric, TRAINING)
        if grid is None:
            continue
        lengths = grid["window_episodes"]
        length, episodes = int(lengths.max()), int(lengths.sum())
        is_whole = lengths == length
        count = max(1, min(SMOOTHED_EPISODES, episodes // _PART) // length)
        middles = (grid["episode"][is_whole] + (length - 1) / 2).astype(np.float64)
        at = running_mean(middles, count)
        middle, low, high = curve_interval(running_mean(grid["value"][:, is_whole], count))
        axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
        label = " ".join(label.splitlines())
        label = f"\N{ZERO WIDTH SPACE}{label}" if label.startswith("_") else label  # matplotlib would hide it
        axes.plot(at, middle, color=colour, linewidth=2, marker="." if len(at) < 3 else None, label=label)
        windows.add(min(count, int(is_whole.sum())) * length)
    return windows or {1}
