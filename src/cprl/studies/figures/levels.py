"""Figures of metrics against a factor whose levels are numbers, or of conditions one below the other."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isclose
from pathlib import Path
from textwrap import fill
from typing import Any, Final, Literal, Self

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from cprl.arguments import choice, refusal
from cprl.measuring.statistics import Estimate
from cprl.studies.tables.comparing import LAST, Compared, Comparison, compare, metric_title, metrics_of
from cprl.studies.tables.sources import RANDOM, TRAINING, Design
from cprl.studies.tables.table import StudyTable
from cprl.terminal.style import CHARACTER_IN, MEAN, RANDOM_LINE, SMALL_PT, head, picture_path, save, wrapped

_COLUMNS: Final = 3
_MOST_LINES: Final = 8
_CLOSEST: Final = 0.07
"""The smallest distance of two levels, as a share of the axis, at which their names can be read."""


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
    numeric = [own for own in design.factors if is_numeric([at[own] for at in design.conditions.values()])]
    if factor not in numeric:
        raise refusal(
            "factor", factor, ", ".join(numeric) or "none, as no factor has levels that are numbers"
        )
    comparisons = [compare(table, own, part=part, last=last) for own in metrics_of(table, metrics)]
    lines = _lines(design, factor)
    others = [own for own in design.factors if own != factor]
    only = [
        design.conditions[own[0]][others[0]] if len(others) == 1 else nth
        for nth, own in enumerate(lines.values())
    ]
    colours = dict.fromkeys(lines, LEVEL) if len(lines) == 1 else colours_of(list(lines), only)
    figure, panels = _grid(len(comparisons))
    axis = _Axis.of(factor, table)
    random = {own.metric: compare(table, own.metric, part=RANDOM).by_name for own in comparisons}
    is_same = all(_is_same(own.values(), factor) for own in random.values())
    for axes, comparison in zip(panels, comparisons, strict=True):
        for name, members in lines.items():
            found = [comparison.by_name[own] for own in members]
            at = [axis.places[design.conditions[own][factor]] for own in members]
            _draw_line(axes, at, found, colours[name], name, joined=design.is_grid)
            if is_same or len(lines) > 1:
                chance = [random[comparison.metric][own] for own in members]
                colour = RANDOM_LINE["color"] if is_same else colours[name]
                _draw_random(axes, at, chance, colour, joined=design.is_grid)
        if is_same or len(lines) > 1:
            label = "random play" if is_same else "random play, in the colour of its conditions"
            axes.plot([], [], label=label, **RANDOM_LINE)
        axis.draw(axes)
        axes.set_title(wrapped(title_of(comparison), 3.6), fontsize=SMALL_PT + 1)
        axes.tick_params(labelsize=SMALL_PT)
    for axes in panels[-_COLUMNS:]:
        axes.set_xlabel(axis.title, fontsize=SMALL_PT)
    legend(figure, panels[0])
    note = f"{replicas_text(table.replicas)}. {levels_note(comparisons[0])} Faint: single replicas."
    if others and list(lines) == [""]:
        note += f" Conditions differ in {', '.join(map(short, others))} too."
    head(figure, f"{design.name}: outcome by {short(factor)}", note)
    return save(figure, path)


@dataclass(frozen=True, kw_only=True)
class _Axis:
    """Where the levels of a factor stand."""

    factor: str
    counts: dict[float, int]
    """The number of replicas of each level, in order."""
    is_even: bool
    """Whether levels stand at equal distances."""

    @classmethod
    def of(cls, factor: str, table: StudyTable) -> Self:
        """That of a factor of a table."""
        counts: dict[float, int] = {}
        for name, own in table.design.conditions.items():
            counts[own[factor]] = counts.get(own[factor], 0) + table.replicas[name]
        levels = sorted(counts)
        at = np.log(levels) if is_logarithmic(levels) else np.array(levels, np.float64)
        is_crowded = np.diff(at).min(initial=np.inf) < _CLOSEST * np.ptp(at)
        return cls(
            factor=factor,
            counts={own: counts[own] for own in levels},
            is_even=bool(is_crowded) and len(levels) <= _MOST_LINES,
        )

    @property
    def places(self) -> dict[float, float]:
        """The place of each level."""
        return {own: float(nth) if self.is_even else own for nth, own in enumerate(self.counts)}

    @property
    def title(self) -> str:
        """The factor, and what is to be known of the axis."""
        return f"{self.factor}\n(levels at equal distances)" if self.is_even else self.factor

    def draw(self, axes: Axes) -> None:
        """A tick for each level where there are few, with the number of replicas where it differs."""
        if not self.is_even and is_logarithmic(list(self.counts)):
            axes.set_xscale("log")
            axes.xaxis.set_major_formatter("{x:g}")  # of matplotlib's own, formulas are texts like names
            axes.xaxis.set_minor_locator(NullLocator())
        if len(self.counts) <= _MOST_LINES:
            is_same = len(set(self.counts.values())) == 1
            texts = [f"{own:g}" + ("" if is_same else f"\nn={n}") for own, n in self.counts.items()]
            axes.set_xticks(list(self.places.values()), texts)


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
    means = [np.nan if own.estimate is None else own.estimate.value for own in found]
    label = name or "mean and interval"
    line = "-" if joined and len(set(at)) == len(at) else "none"
    axes.plot(at, means, marker="o", linestyle=line, color=colour, linewidth=1.4, label=label, zorder=4)


def _is_same(random: Iterable[Compared], factor: str) -> bool:
    """Whether random play is the same under all conditions of each level of a factor."""
    of_level: dict[float, list[Estimate | None]] = {}
    for own in random:
        of_level.setdefault(own.levels[factor], []).append(own.estimate)
    return all(map(is_one, of_level.values()))


def _draw_random(
    axes: Axes, at: Sequence[float], random: Sequence[Compared], colour: str, *, joined: bool
) -> None:
    """Random play under each of the conditions that a line joins."""
    means = [np.nan if own.estimate is None else own.estimate.value for own in random]
    look = {**RANDOM_LINE, "color": colour}
    if not (joined and len(set(at)) == len(at)):
        look["linestyle"] = "none"
    axes.plot(at, means, marker="_", markersize=9, **look)


MOST_CONDITIONS: Final = 60
"""A figure with a row for each condition has at most so many rows."""
NAME_CHARACTERS: Final = 34
"""The largest number of characters on a line of a condition's name; then it wraps."""
COLOURS: Final = ("#08519c", "#d95f02", "#1b9e77", "#7b3294", "#a50f15", "#8c6d31", "#e7298a", "#555555")
"""Of conditions or lines that have names; numbers get a scale from dark to light."""
LEVEL: Final = "#08519c"
FAINT: Final = "#9ecae1"
NUMBERS_MAP: Final = "viridis"
_APART: Final = 30
"""Levels whose largest is more than so many times the smallest stand on a logarithmic axis."""


def is_numeric(levels: Sequence[Any]) -> bool:
    """Whether levels stand on an axis of numbers: at least two, all numbers."""
    return len(set(levels)) > 1 and all(
        isinstance(own, int | float) and not isinstance(own, bool) for own in levels
    )


def is_logarithmic(levels: Sequence[float]) -> bool:
    """Whether that axis is logarithmic."""
    return min(levels) > 0 and max(levels) > _APART * min(levels)


def short(factor: str) -> str:
    """A factor in a word, e.g. "freeze steps"."""
    return factor.rpartition(".")[2].replace("_", " ")


def names_of(design: Design) -> dict[str, str]:
    """What figures call each condition: the level alone where there is one factor; wrapped."""
    if len(design.factors) == 1:
        only = design.factors[0]
        words = [_text(own[only]) for own in design.conditions.values()]
        if len(set(words)) == len(words):
            return dict(zip(design.conditions, (fill(own, NAME_CHARACTERS) for own in words), strict=True))
    return {own: fill(own, NAME_CHARACTERS) for own in design.conditions}


def colours_of(names: Sequence[str], levels: Sequence[Any]) -> dict[str, str]:
    """A colour for each of several lines: from dark to light where their levels are numbers."""
    if len(names) > 2 and is_numeric(levels):
        shades = matplotlib.colormaps[NUMBERS_MAP]
        order = sorted(set(levels))
        places = {own: 0.88 * nth / (len(order) - 1) for nth, own in enumerate(order)}
        return {name: to_hex(shades(places[own])) for name, own in zip(names, levels, strict=True)}
    return {name: COLOURS[nth % len(COLOURS)] for nth, name in enumerate(names)}


def replicas_text(replicas: Mapping[str, int]) -> str:
    """How many replicas conditions have, e.g. "8 replicas each", but for those that were not run."""
    counts = _counts(replicas)
    if len(counts) == 1:
        return f"{counts[0]} replica{'s' * (counts[0] != 1)} each"
    return f"{counts[0]} to {counts[-1]} replicas each (n)"


def with_counts(names: Mapping[str, str], replicas: Mapping[str, int]) -> dict[str, str]:
    """Names of conditions, with the number of replicas where it is not the same for all."""
    if len(_counts(replicas)) == 1:
        return dict(names)
    return {own: f"{name} (n={replicas[own]})" for own, name in names.items()}


def _counts(replicas: Mapping[str, int]) -> list[int]:
    return sorted({own for own in replicas.values() if own}) or [0]


def levels_note(comparison: Comparison) -> str:
    """What points and intervals are."""
    return f"Means of {comparison.episodes_text}, then over replicas; {comparison.interval_text}."


def is_one(estimates: Iterable[Estimate | None]) -> bool:
    """Whether estimates are one number, but for the rounding of exported tables to float32."""
    values = [own.value for own in estimates if own is not None]
    return not values or isclose(min(values), max(values), rel_tol=1e-6)


def title_of(comparison: Comparison) -> str:
    """A metric with its unit, and in how many episodes it is undefined, which are in no mean."""
    undefined = sum(own.undefined for own in comparison.conditions)
    of = sum(own.episodes for own in comparison.conditions)
    name = metric_title(comparison.metric)
    return f"{name}, undefined in {undefined:,} of {of:,} episodes" if undefined else name


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


def _text(level: Any) -> str:
    return f"{level:,.6g}" if isinstance(level, float) else str(level)


Kind = Literal["levels", "differences"]


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
    choice("kind", kind, ("levels", "differences"))
    design, path = table.design, picture_path(path)
    shown = [own for own in design.conditions if kind == "levels" or own != design.reference]
    if kind == "differences" and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(shown) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(shown)}")
    comparisons = [compare(table, own, part=part, last=last) for own in metrics_of(table, metrics)]
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
        axes.set_title(wrapped(title_of(comparison), 9.5 / len(panels)), fontsize=SMALL_PT)
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
    return save(figure, path)


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
