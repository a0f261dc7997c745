"""Figures of metrics against a factor whose levels are numbers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from cprl.arguments import refusal
from cprl.measuring.statistics import Estimate
from cprl.studies.figures.panels import (
    LEVEL,
    colours_of,
    is_logarithmic,
    is_numeric,
    is_one,
    legend,
    levels_note,
    replicas_text,
    short,
    title_of,
)
from cprl.studies.tables.comparing import LAST, Compared, compare, metrics_of
from cprl.studies.tables.sources import Design
from cprl.studies.tables.table import StudyTable
from cprl.studies.tables.windows import RANDOM, TRAINING
from cprl.terminal.style import RANDOM_LINE, SMALL_PT, head, picture_path, save, wrapped

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
        table: the table.
        factor: one of its factors.
        path: the PNG.
        metrics: by default those of `cprl.studies.tables.comparing.METRICS` that it has.
        part: see `cprl.studies.tables.comparing.compare`.
        last: likewise.

    Raises:
        ValueError: for a factor whose levels are not numbers, another ending than .png, and for what does
            not fit.
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
    axes.plot(
        at,
        means,
        marker="o",
        linestyle=line,
        color=colour,
        linewidth=1.4,
        label=label,
        zorder=4,
    )


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
