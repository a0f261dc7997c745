"""Figures of metrics against a factor whose levels are numbers, or of conditions one below the other."""

from collections.abc import Iterable, Mapping, Sequence
from math import isclose
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from cprl.measuring.statistics import Estimate
from cprl.studies.tables.comparing import (
    INTERVALS,
    LAST,
    Compared,
    Comparison,
    Kind,
    compare,
    metric_title,
    metrics_of,
)
from cprl.studies.tables.table import RANDOM, TRAINING, Design, StudyTable
from cprl.terminal.style import CHARACTER_IN, MEAN, RANDOM_LINE, SMALL_PT, head, picture_path, save, wrapped
from cprl.values import refusal

MOST_CONDITIONS: Final = 60
"""A figure with a row for each condition has at most so many rows."""
NAME_CHARACTERS: Final = 34
"""The largest number of characters on a line of a condition's name; then it wraps."""
COLOURS: Final = ("#08519c", "#d95f02", "#1b9e77", "#7b3294", "#a50f15", "#8c6d31", "#e7298a", "#555555")
"""Of conditions or lines that have names; numbers get a scale from dark to light."""
FAINT: Final = "#9ecae1"
_COLUMNS: Final = 3
_MOST_LINES: Final = 8
_CLOSEST: Final = 0.07
"""The smallest distance of two levels, as a share of the axis, at which their names can be read."""
_APART: Final = 30
"""Levels whose largest is more than so many times the smallest stand on a logarithmic axis."""


def by_factor(
    table: StudyTable,
    factor: str,
    path: Path | str,
    *,
    metrics: Sequence[str] = (),
    part: str = TRAINING,
    last: int = LAST,
) -> Path:
    """Draws metrics against a factor whose levels are numbers.

    The axis is logarithmic where the largest level is more than 30 times the smallest. Up to eight levels,
    some of which would then be too close to be told apart, stand at equal distances, which the axis says.

    Points are means over replicas with their intervals, faint ones single replicas. Conditions that are equal
    but for this factor are joined by a line, which has a colour of its own if there are several. In random
    draws, where hardly any are, points stand alone: the other factors vary too. Dashes are random play under
    each condition; there are none where it differs and points stand alone that have the same level.

    Args:
        metrics: by default those of `cprl.studies.tables.comparing.METRICS` that it has.
    """
    design, path = table.design, picture_path(path)
    numeric = [name for name in design.factors if is_numeric(design.levels(name))]
    if factor not in numeric:
        allowed = ", ".join(numeric) or "none, as no factor has levels that are numbers"
        raise refusal("factor", factor, allowed)
    comparisons = [compare(table, metric, part=part, last=last) for metric in metrics_of(table, metrics)]
    by_chance = [compare(table, comparison.metric, part=RANDOM).by_name for comparison in comparisons]
    lines, others = _lines(design, factor), [name for name in design.factors if name != factor]
    only = [design.conditions[names[0]][others[0]] for names in lines.values()] if len(others) == 1 else []
    colours = colours_of(list(lines), only or range(len(lines)))
    places, is_even = places_of(design.levels(factor))
    is_same = all(_is_same(random.values(), design, factor) for random in by_chance)
    columns = min(len(comparisons), _COLUMNS)
    rows = -(-len(comparisons) // columns)
    figure = Figure((max(4.0 * columns, 6.0), 2.9 * rows + 1.3), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels[len(comparisons) :]:
        axes.set_visible(False)
    panels = panels[: len(comparisons)]
    for axes, comparison, random in zip(panels, comparisons, by_chance, strict=True):
        for label, names in lines.items():
            at = [places[design.conditions[name][factor]] for name in names]
            line = "-" if design.is_grid and len(set(at)) == len(at) else "none"
            colour = colours[label]
            _draw_line(axes, at, [comparison.by_name[name] for name in names], colour, line, label)
            if is_same or len(lines) > 1:
                means = [_value(random[name].estimate) for name in names]
                look = RANDOM_LINE if is_same else {**RANDOM_LINE, "color": colour}
                look = look if line == "-" else {**look, "linestyle": "none"}
                axes.plot(at, means, marker="_", markersize=9, **look)
        if is_same or len(lines) > 1:
            label = "random play" if is_same else "random play, in the colour of its conditions"
            axes.plot([], [], label=label, **RANDOM_LINE)
        _draw_axis(axes, places, _replicas_by_level(table, factor), is_even=is_even)
        axes.set_title(wrapped(title_of(comparison), 3.6), fontsize=SMALL_PT + 1)
        axes.tick_params(labelsize=SMALL_PT)
    for axes in panels[-_COLUMNS:]:
        axes.set_xlabel(f"{factor}\n(levels at equal distances)" if is_even else factor, fontsize=SMALL_PT)
    legend(figure, panels[0])
    note = f"{replicas_text(table.replicas)}. {levels_note(comparisons[0])} Faint: single replicas."
    if others and list(lines) == [""]:
        note += f" Conditions differ in {', '.join(map(short, others))} too."
    head(figure, f"{design.name}: outcome by {short(factor)}", note)
    return save(figure, path)


def places_of(levels: Iterable[float]) -> tuple[dict[float, float], bool]:
    """Return where each level stands on an axis of numbers, in order, and whether at equal distances."""
    ordered = sorted(set(levels))
    at = np.log(ordered) if is_logarithmic(ordered) else np.array(ordered, np.float64)
    is_crowded = np.diff(at).min(initial=np.inf) < _CLOSEST * np.ptp(at)
    if is_crowded and len(ordered) <= _MOST_LINES:
        return {level: float(place) for place, level in enumerate(ordered)}, True
    return {level: level for level in ordered}, False


def _replicas_by_level(table: StudyTable, factor: str) -> dict[float, int]:
    counts: dict[float, int] = {}
    for name, levels in table.design.conditions.items():
        counts[levels[factor]] = counts.get(levels[factor], 0) + table.replicas[name]
    return counts


def _draw_axis(
    axes: Axes, places: Mapping[float, float], replicas: Mapping[float, int], *, is_even: bool
) -> None:
    """A tick for each level where there are few, with the number of replicas where it differs."""
    if not is_even and is_logarithmic(list(places)):
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")  # of matplotlib's own, formulas are texts like names
        axes.xaxis.set_minor_locator(NullLocator())
    if len(places) <= _MOST_LINES:
        is_same = len(set(replicas.values())) == 1
        texts = [f"{level:g}" + ("" if is_same else f"\nn={replicas[level]}") for level in places]
        axes.set_xticks(list(places.values()), texts)


def _lines(design: Design, factor: str) -> dict[str, list[str]]:
    """Conditions that are equal but for a factor, in the order of its levels, by what they have in common."""
    others = [name for name in design.factors if name != factor]
    lines: dict[str, list[str]] = {}
    in_order = sorted(design.conditions.items(), key=lambda condition: float(condition[1][factor]))
    for name, levels in design.conditions.items():  # lines are in the order of the conditions
        common = ", ".join(f"{short(other)} {levels[other]}" for other in others) if design.is_grid else ""
        lines.setdefault(common, []).append(name)
    if len(lines) > _MOST_LINES:
        lines = {"": list(design.conditions)}
    return {common: [name for name, _ in in_order if name in names] for common, names in lines.items()}


def _draw_line(
    axes: Axes, at: Sequence[float], line: Sequence[Compared], colour: str, style: str, label: str
) -> None:
    """Means with their intervals over a factor, and each replica."""
    for place, compared in zip(at, line, strict=True):
        values, mean = compared.defined, compared.estimate
        axes.plot([place] * len(values), values, ".", color=colour, alpha=0.25, markersize=5, zorder=2)
        if mean is not None:
            bounds = [mean.low, mean.high]
            axes.plot([place, place], bounds, color=colour, linewidth=2.2, alpha=0.8, zorder=3)
    means = [_value(compared.estimate) for compared in line]
    look: dict[str, Any] = {"marker": "o", "linestyle": style, "linewidth": 1.4, "zorder": 4}
    axes.plot(at, means, color=colour, label=label or "mean and interval", **look)


def _value(estimate: Estimate | None) -> float:
    return float("nan") if estimate is None else estimate.value


def _is_same(random: Iterable[Compared], design: Design, factor: str) -> bool:
    """Whether random play is the same under all conditions of each level of a factor."""
    of_level: dict[float, list[Estimate | None]] = {}
    for compared in random:
        level = design.conditions[compared.condition][factor]
        of_level.setdefault(level, []).append(compared.estimate)
    return all(map(is_one, of_level.values()))


def by_condition(
    table: StudyTable,
    path: Path | str,
    *,
    kind: Kind = "levels",
    metrics: Sequence[str] = (),
    part: str = TRAINING,
    last: int = LAST,
) -> Path:
    """Draws the conditions one below the other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `MOST_CONDITIONS` conditions.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
    """
    design, path = table.design, picture_path(path)
    conditions = [name for name in design.conditions if kind == "levels" or name != design.reference]
    if kind == "differences" and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(conditions) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(conditions)}")
    comparisons = [compare(table, metric, part=part, last=last) for metric in metrics_of(table, metrics)]
    first, names = comparisons[0], names_of(table)
    rows_in = 0.34 if all("\n" not in names[name] for name in conditions) else 0.46
    figure = Figure((12.0, rows_in * len(conditions) + 1.8), layout="constrained")
    panels = figure.subplots(1, len(comparisons), sharey=True, squeeze=False)[0]
    for axes, comparison in zip(panels, comparisons, strict=True):
        random = compare(table, comparison.metric, part=RANDOM).by_name
        for place, name in enumerate(conditions):
            _draw_row(axes, place, comparison.by_name[name], kind)
            level = random[name].estimate
            if kind == "levels" and level is not None:
                look = {**RANDOM_LINE, "linestyle": (0, (2, 1))}
                axes.plot([level.value] * 2, [place - 0.42, place + 0.42], **look)
        if kind == "differences":
            axes.axvline(0, **RANDOM_LINE)
        axes.set_title(wrapped(title_of(comparison), 9.5 / len(panels)), fontsize=SMALL_PT)
        axes.set_yticks(range(len(conditions)), [names[name] for name in conditions])
        axes.tick_params(labelsize=SMALL_PT)
        axes.locator_params(axis="x", nbins=3)
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].set_ylim(len(conditions) - 0.4, -0.6)
    what = short(design.factors[0]) if len(design.factors) == 1 else "condition"
    figure.supylabel(what, fontsize=SMALL_PT + 1)
    title = f"{design.name}: outcome by condition"
    note = (
        f"{replicas_text(table.replicas)}. {levels_note(first)} Faint: single replicas. Dashed: random play."
    )
    if kind == "differences":
        title = f"{design.name}: difference from {' '.join(design.reference.splitlines())}"
        pairing = f"{first.pairing_text[0].upper()}{first.pairing_text[1:]}"
        note = f"{replicas_text(table.replicas)}. {pairing}; means of {first.episodes_text}; {INTERVALS}."
    head(figure, title, note)
    return save(figure, path)


def _draw_row(axes: Axes, place: int, compared: Compared, kind: Kind) -> None:
    """One condition's mean or difference with its interval."""
    mean = compared.estimate if kind == "levels" else compared.difference
    if kind == "levels":
        values = compared.defined
        axes.plot(values, [place + 0.16] * len(values), ".", color=FAINT, markersize=5, zorder=2)
    if mean is None:
        why = "no run" if not compared.replicas else "undefined" if compared.estimate is None else "no pairs"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.get_yaxis_transform()}
        axes.text(0.5, place, why, fontsize=SMALL_PT, bbox=box, **middle)
        return
    axes.plot([mean.low, mean.high], [place, place], color=MEAN, linewidth=2.5, alpha=0.6, zorder=3)
    axes.plot([mean.value], [place], "o", color=MEAN, markersize=6, zorder=4)


def is_numeric(levels: Sequence[Any]) -> bool:
    """Whether levels stand on an axis of numbers: at least two, all numbers."""
    return len(set(levels)) > 1 and all(
        isinstance(level, int | float) and not isinstance(level, bool) for level in levels
    )


def is_logarithmic(levels: Sequence[float]) -> bool:
    """Whether that axis is logarithmic."""
    return min(levels) > 0 and max(levels) > _APART * min(levels)


def short(factor: str) -> str:
    """A factor in a word, e.g. "freeze steps"."""
    return factor.rpartition(".")[2].replace("_", " ")


def names_of(table: StudyTable) -> dict[str, str]:
    """What figures call each condition: the level alone where there is one factor; wrapped.

    With the number of replicas where it is not the same for all.
    """
    design, names = table.design, list(table.design.conditions)
    words = names
    if len(design.factors) == 1:
        levels = design.levels(design.factors[0])
        words = [f"{level:,.6g}" if isinstance(level, float) else str(level) for level in levels]
        words = words if len(set(words)) == len(words) else names
    is_same = len(_counts(table.replicas)) == 1
    counts = ["" if is_same else f" (n={table.replicas[name]})" for name in names]
    return {
        name: f"{fill(word, NAME_CHARACTERS)}{count}"
        for name, word, count in zip(names, words, counts, strict=True)
    }


def colours_of(names: Sequence[str], levels: Sequence[Any]) -> dict[str, str]:
    """A colour for each of several lines: from dark to light where their levels are numbers."""
    if len(names) > 2 and is_numeric(levels):
        order = sorted(set(levels))
        shades = matplotlib.colormaps["viridis"]
        places = {level: 0.88 * place / (len(order) - 1) for place, level in enumerate(order)}
        return {name: to_hex(shades(places[level])) for name, level in zip(names, levels, strict=True)}
    return {name: COLOURS[place % len(COLOURS)] for place, name in enumerate(names)}


def replicas_text(replicas: Mapping[str, int]) -> str:
    """How many replicas conditions have, e.g. "8 replicas each", but for those that were not run."""
    counts = _counts(replicas)
    if len(counts) == 1:
        return f"{counts[0]} replica{'s' * (counts[0] != 1)} each"
    return f"{counts[0]} to {counts[-1]} replicas each (n)"


def _counts(replicas: Mapping[str, int]) -> list[int]:
    return sorted({number for number in replicas.values() if number}) or [0]


def levels_note(comparison: Comparison) -> str:
    """What points and intervals are."""
    return f"Means of {comparison.episodes_text}, then over replicas; {INTERVALS}."


def is_one(estimates: Iterable[Estimate | None]) -> bool:
    """Whether estimates are one number, but for the rounding of exported tables to float32."""
    values = [estimate.value for estimate in estimates if estimate is not None]
    return not values or isclose(min(values), max(values), rel_tol=1e-6)


def title_of(comparison: Comparison) -> str:
    """A metric with its unit, and in how many episodes it is undefined, which are in no mean."""
    undefined = sum(compared.undefined for compared in comparison.conditions)
    episodes = sum(compared.episodes for compared in comparison.conditions)
    name = metric_title(comparison.metric)
    return f"{name}, undefined in {undefined:,} of {episodes:,} episodes" if undefined else name


def legend(figure: Figure, axes: Axes, *, title: str | None = None) -> None:
    """A legend of a panel below the figure, each label once, in as many columns as there is room for."""
    entries = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if not entries:
        return
    widest_in = CHARACTER_IN * (max(map(len, entries)) + 6)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside lower center",
        ncols=max(1, min(len(entries), int(figure.get_figwidth() / widest_in))),
        fontsize=SMALL_PT,
        title=title,
        title_fontsize=SMALL_PT,
        frameon=False,
    )
