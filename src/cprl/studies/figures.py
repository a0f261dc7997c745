"""Figures of a comparison: metrics against a factor, and conditions one below the other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from cprl.arguments import choice, refusal
from cprl.arguments import path as path_of
from cprl.measuring.statistics import Interval
from cprl.plotting.style import MEAN, RANDOM_LINE, SMALL_PT
from cprl.studies.comparing import LAST, Compared, Comparison, compare, metrics_of
from cprl.studies.panels import (
    FAINT,
    LEVEL,
    MOST_CONDITIONS,
    colours_of,
    head,
    is_logarithmic,
    is_numeric,
    legend,
    levels_note,
    names_of,
    replicas_text,
    short,
    with_counts,
    wrapped,
    write_figure,
)
from cprl.studies.sources import Design
from cprl.studies.table import StudyTable
from cprl.studies.texts import metric_title
from cprl.studies.windows import RANDOM, TRAINING

_COLUMNS: Final = 3
_MOST_LINES: Final = 8

Kind = Literal["levels", "differences"]


def by_factor(
    table: StudyTable,
    factor: str,
    path: Path | str,
    *,
    metrics: Sequence[str] = (),
    part: str = TRAINING,
    last: int = LAST,
    interval: Interval = "bca",
) -> Path:
    """Draws metrics against a factor whose levels are numbers; far apart ones on a logarithmic axis.

    Points are means over replicas with their intervals, faint ones single replicas. Conditions that are equal
    but for this factor are joined by a line, which has a colour of its own if there are several. In random
    draws, where hardly any are, points stand alone: the other factors vary too.

    Args:
        table: the table.
        factor: one of its factors.
        path: the PNG.
        metrics: by default those of `cprl.studies.comparing.METRICS` that it has.
        part: see `cprl.studies.comparing.compare`.
        last: likewise.
        interval: likewise.

    Raises:
        ValueError: for a factor whose levels are not numbers, and for what does not fit.
    """
    design, path = table.design, path_of("path", path)
    numeric = [own for own in design.factors if is_numeric([at[own] for at in design.conditions.values()])]
    if factor not in numeric:
        raise refusal(
            "factor", factor, ", ".join(numeric) or "none, as no factor has levels that are numbers"
        )
    comparisons = [
        compare(table, own, part=part, last=last, interval=interval) for own in metrics_of(table, metrics)
    ]
    lines = _lines(design, factor)
    others = [own for own in design.factors if own != factor]
    only = [
        design.conditions[own[0]][others[0]] if len(others) == 1 else nth
        for nth, own in enumerate(lines.values())
    ]
    colours = {"": LEVEL} if len(lines) == 1 else colours_of(list(lines), only)
    figure, panels = _grid(len(comparisons))
    for axes, comparison in zip(panels, comparisons, strict=True):
        random = compare(table, comparison.metric, part=RANDOM)
        for name, members in lines.items():
            found = [comparison.by_name[own] for own in members]
            at = [design.conditions[own][factor] for own in members]
            _draw_line(
                axes, at, found, colours[name] if len(lines) > 1 else LEVEL, name, joined=design.is_grid
            )
        _draw_random(axes, [own[factor] for own in design.conditions.values()], random)
        _number_axis(axes, factor, table)
        axes.set_title(metric_title(comparison.metric), fontsize=SMALL_PT + 1)
        axes.tick_params(labelsize=SMALL_PT)
    for axes in panels[-_COLUMNS:]:
        axes.set_xlabel(factor, fontsize=SMALL_PT)
    legend(figure, panels[0])
    note = f"{replicas_text(table.replicas)}. {levels_note(comparisons[0])} Faint: single replicas."
    if not design.is_grid and others:
        note += f" Random draws, in which {', '.join(map(short, others))} differ too."
    head(figure, f"{design.name}: outcome by {short(factor)}", note)
    return write_figure(figure, path)


def by_condition(
    table: StudyTable,
    path: Path | str,
    *,
    kind: Kind = "levels",
    metrics: Sequence[str] = (),
    part: str = TRAINING,
    last: int = LAST,
    interval: Interval = "bca",
) -> Path:
    """Draws the conditions one below the other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `MOST_CONDITIONS` conditions.
        path: the PNG.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
        metrics: see `by_factor`.
        part: see `cprl.studies.comparing.compare`.
        last: likewise.
        interval: likewise.

    Raises:
        ValueError: for too many conditions, and for what does not fit.
    """
    choice("kind", kind, ("levels", "differences"))
    design, path = table.design, path_of("path", path)
    shown = [own for own in design.conditions if kind == "levels" or own != design.reference]
    if kind == "differences" and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(shown) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(shown)}")
    comparisons = [
        compare(table, own, part=part, last=last, interval=interval) for own in metrics_of(table, metrics)
    ]
    names = with_counts(names_of(design), table.replicas)
    rows_in = 0.34 if all("\n" not in names[own] for own in shown) else 0.46
    figure = Figure((12.0, rows_in * len(shown) + 1.8), layout="constrained")
    panels = figure.subplots(1, len(comparisons), sharey=True, squeeze=False)[0]
    for axes, comparison in zip(panels, comparisons, strict=True):
        for place, name in enumerate(shown):
            _draw_row(axes, place, comparison.by_name[name], kind)
        if kind == "differences":
            axes.axvline(0, **RANDOM_LINE)
        else:
            _mark_random(axes, shown, compare(table, comparison.metric, part=RANDOM))
        axes.set_title(wrapped(metric_title(comparison.metric), 9.5 / len(panels)), fontsize=SMALL_PT)
        axes.set_yticks(range(len(shown)), [names[own] for own in shown])
        axes.tick_params(labelsize=SMALL_PT)
        axes.locator_params(axis="x", nbins=3)
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].set_ylim(len(shown) - 0.4, -0.6)
    figure.supylabel(
        short(design.factors[0]) if len(design.factors) == 1 else "condition", fontsize=SMALL_PT + 1
    )
    replicas, first = replicas_text(table.replicas), comparisons[0]
    if kind == "levels":
        title = f"{design.name}: outcome by condition"
        note = f"{replicas}. {levels_note(first)} Faint: single replicas. Dashed: random play."
    else:
        name = design.reference.replace("\n", " ")
        title = f"{design.name}: difference from {name}"
        how = "Paired by replica" if first.is_paired else "Not paired: each condition has chance of its own"
        note = f"{replicas}. {how}; means of {first.episodes_text}; {first.interval_text}."
    head(figure, title, note)
    return write_figure(figure, path)


def _lines(design: Design, factor: str) -> dict[str, list[str]]:
    """Conditions that are equal but for a factor, in the order of its levels, by what they have in common."""
    others = [own for own in design.factors if own != factor]
    found: dict[str, list[str]] = {}
    for name, levels in design.conditions.items():
        common = ", ".join(f"{short(own)} {levels[own]}" for own in others) if design.is_grid else ""
        found.setdefault(common, []).append(name)
    if len(found) > _MOST_LINES:
        found = {"": [name for own in found.values() for name in own]}
    return {
        common: sorted(own, key=lambda name: float(design.conditions[name][factor]))
        for common, own in found.items()
    }


def _grid(count: int) -> tuple[Figure, list[Axes]]:
    """Panels for so many metrics, in rows of three."""
    columns = min(count, _COLUMNS)
    rows = -(-count // columns)
    figure = Figure((max(4.0 * columns, 6.0), 2.9 * rows + 1.3), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, list(panels[:count])


def _draw_line(
    axes: Axes, at: Sequence[float], found: Sequence[Compared], colour: str, name: str, *, joined: bool
) -> None:
    """Means with their intervals over a factor, and each replica."""
    for x, own in zip(at, found, strict=True):
        axes.plot([x] * len(own.defined), own.defined, ".", color=colour, alpha=0.25, markersize=5, zorder=2)
        if own.estimate is not None:
            bounds = [own.estimate.low, own.estimate.high]
            axes.plot([x, x], bounds, color=colour, linewidth=2.2, alpha=0.8, zorder=3)
    defined = [(x, own.estimate.value) for x, own in zip(at, found, strict=True) if own.estimate is not None]
    label = name or "mean and interval"
    line = "-" if joined and len({x for x, _ in defined}) == len(defined) else "none"
    axes.plot(
        *np.array(defined).reshape(-1, 2).T,
        marker="o",
        linestyle=line,
        color=colour,
        linewidth=1.4,
        label=label,
        zorder=4,
    )


def _draw_random(axes: Axes, at: Sequence[float], random: Comparison) -> None:
    """Random play: its mean over the conditions with a level, by level."""
    by_level: dict[float, list[float]] = {}
    for x, own in zip(at, random.conditions, strict=True):
        if own.estimate is not None:
            by_level.setdefault(x, []).append(own.estimate.value)
    if by_level:
        order = sorted(by_level)
        means = [float(np.mean(by_level[x])) for x in order]
        look = {**RANDOM_LINE, "marker": "_"} if len(order) == 1 else RANDOM_LINE
        axes.plot(order, means, label="random play", **look)


def _number_axis(axes: Axes, factor: str, table: StudyTable) -> None:
    """A tick for each level where there are few, with the number of replicas where it differs."""
    counts: dict[float, int] = {}
    for name, own in table.design.conditions.items():
        counts[own[factor]] = counts.get(own[factor], 0) + table.replicas[name]
    levels, same = sorted(counts), len(set(counts.values())) == 1
    if is_logarithmic(levels):
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
    if len(levels) <= _MOST_LINES:
        axes.xaxis.set_major_locator(FixedLocator(levels))
        axes.set_xticks(levels, [f"{own:g}" + ("" if same else f"\nn={counts[own]}") for own in levels])


def _draw_row(axes: Axes, place: int, own: Compared, kind: Kind) -> None:
    """One condition's mean or difference with its interval."""
    found = own.estimate if kind == "levels" else own.difference
    if kind == "levels":
        values = own.defined
        axes.plot(values, [place + 0.16] * len(values), ".", color=FAINT, markersize=5, zorder=2)
    if found is None:
        why = "no run" if not own.replicas else "undefined" if own.estimate is None else "no pairs"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        middle: dict[str, Any] = {
            "ha": "center",
            "va": "center",
            "transform": axes.get_yaxis_transform(),
            "bbox": box,
        }
        axes.text(0.5, place, why, fontsize=SMALL_PT, **middle)
        return
    axes.plot([found.low, found.high], [place, place], color=MEAN, linewidth=2.5, alpha=0.6, zorder=3)
    axes.plot([found.value], [place], "o", color=MEAN, markersize=6, zorder=4)


def _mark_random(axes: Axes, shown: Sequence[str], random: Comparison) -> None:
    """Random play under each condition."""
    look: dict[str, Any] = {**RANDOM_LINE, "linestyle": (0, (2, 1))}
    for place, name in enumerate(shown):
        own = random.by_name[name]
        if own.estimate is not None:
            axes.plot([own.estimate.value] * 2, [place - 0.42, place + 0.42], **look)
