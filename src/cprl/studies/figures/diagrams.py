"""Figures of two factors: heat maps of a metric, and phase diagrams; of one factor, phases as bars."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from cprl.arguments import refusal
from cprl.studies.figures.levels import (
    MOST_CONDITIONS,
    legend,
    levels_note,
    names_of,
    replicas_text,
    short,
    title_of,
    with_counts,
)
from cprl.studies.tables.comparing import LAST, Comparison, compare, digits_for
from cprl.studies.tables.sources import COLOURS, TRAINING, Design, Endings
from cprl.studies.tables.table import StudyTable
from cprl.terminal.style import EMPTY, SHADES, SMALL_PT, draw_cell, head, picture_path, save, wrapped

_VALUES, _DIFFERENCES = "viridis", "RdBu"
_CELL_IN: Final = (1.05, 0.55)
_WORD_CHARACTERS: Final = 12

Grid = dict[tuple[Any, Any], str]
"""Conditions by the levels of two factors."""


def grids(design: Design) -> dict[tuple[str, str], Grid]:
    """The conditions by each pair of factors, where the others are at the levels of the reference.

    None for random draws, and pairs of which a factor has a single level left.
    """
    found: dict[tuple[str, str], Grid] = {}
    at = design.conditions[design.reference]
    for one, other in combinations(design.factors, 2) if design.is_grid else ():
        rest = [own for own in design.factors if own not in (one, other)]
        grid = {
            (levels[one], levels[other]): name
            for name, levels in design.conditions.items()
            if all(levels[own] == at[own] for own in rest)
        }
        if all(len({pair[nth] for pair in grid}) > 1 for nth in (0, 1)):
            found[one, other] = grid
    return found


def heat_map(
    table: StudyTable,
    factors: tuple[str, str],
    path: Path | str,
    *,
    metric: str = "collective_return",
    part: str = TRAINING,
    last: int = LAST,
) -> Path:
    """Draws a metric over two factors: its mean with the number of replicas, and its difference.

    Levels are in the order of the conditions. Differences are from the reference; those whose interval
    excludes 0 have a star.

    Args:
        factors: two of its factors; any others are at the levels of the reference.
    """
    path, design = picture_path(path), table.design
    grid, fixed = _checked(design, factors)
    comparison = compare(table, metric, part=part, last=last)
    rows, columns = ([*dict.fromkeys(pair[nth] for pair in grid)] for nth in (0, 1))
    figure = Figure(
        (max(2 * _CELL_IN[0] * len(columns) + 3.4, 8.0), _CELL_IN[1] * len(rows) + 2.3), layout="constrained"
    )
    panels = figure.subplots(1, 2, sharey=True)
    levels, differences = _numbers(comparison, grid)
    for axes, numbers, name in zip(panels, (levels, differences), (_VALUES, _DIFFERENCES), strict=True):
        found = [own for own, _ in numbers.values()]
        reach = max(map(abs, found), default=1.0) or 1.0
        scale = (
            Normalize(-reach, reach)
            if name == _DIFFERENCES
            else Normalize(min(found, default=0), max(found, default=1))
        )
        _draw_cells(axes, grid, rows, columns, numbers, scale, matplotlib.colormaps[name])
        bar = matplotlib.cm.ScalarMappable(scale, name)
        figure.colorbar(bar, ax=axes).ax.tick_params(labelsize=SMALL_PT)
        _label_axes(axes, rows, columns, factors)
    panels[0].set_ylabel(factors[0], fontsize=SMALL_PT)
    panels[0].set_title("mean over replicas (n)", fontsize=SMALL_PT + 1)
    panels[1].set_title("difference (* interval excludes 0)", fontsize=SMALL_PT + 1)
    how = "paired by replica" if comparison.is_paired else "not paired"
    note = f"{levels_note(comparison)} Differences from {design.reference}, {how}.{fixed}"
    head(figure, f"{design.name}: {title_of(comparison)}", note)
    return save(figure, path, colours=SHADES)


def phase_diagram(
    table: StudyTable, found: Endings, path: Path | str, *, factors: tuple[str, str] | None = None
) -> Path:
    """Draws in which phase most replicas end: over two factors, or a bar for each condition.

    Args:
        factors: two factors; None for bars, of at most `MOST_CONDITIONS` conditions.
    """
    path, design = picture_path(path), table.design
    if factors is None:
        figure, fixed = _bars(table, found), ""
    else:
        grid, fixed = _checked(design, factors)
        figure = _squares(found, grid, factors)
    rules = "; ".join(found.rules)
    note = f"{replicas_text(table.replicas)}. In which phase a replica ends: {rules}.{fixed}"
    head(figure, f"{design.name}: phases at the end of the training", note)
    return save(figure, path)


def _checked(design: Design, factors: tuple[str, str]) -> tuple[Grid, str]:
    """The conditions of two factors, and a sentence on the others."""
    every = grids(design)
    if tuple(factors) not in every:
        allowed = "; ".join(map(" and ".join, every)) or "none, as the conditions are no grid of two factors"
        raise refusal("factors", factors, allowed)
    at = design.conditions[design.reference]
    rest = [f"{short(own)} {at[own]}" for own in design.factors if own not in factors]
    return every[factors[0], factors[1]], f" Elsewhere: {', '.join(rest)}." if rest else ""


def _numbers(
    comparison: Comparison, grid: Grid
) -> tuple[dict[str, tuple[float, str]], dict[str, tuple[float, str]]]:
    """The number and the text of each cell, of means and of differences, by condition."""
    levels, differences = {}, {}
    for name in grid.values():
        own = comparison.by_name[name]
        if own.estimate is not None:
            value = own.estimate.value
            levels[name] = value, f"{value:,.{digits_for(abs(value))}f}\nn={len(own.defined)}"
        if name == comparison.reference and own.estimate is not None:
            differences[name] = 0.0, "reference"
        elif own.difference is not None:
            value = own.difference.value
            star = " *" if own.difference.low > 0 or own.difference.high < 0 else ""
            differences[name] = value, f"{value:+,.{digits_for(abs(value))}f}{star}"
    return levels, differences


def _draw_cells(
    axes: Axes,
    grid: Grid,
    rows: Sequence[Any],
    columns: Sequence[Any],
    numbers: Mapping[str, tuple[float, str]],
    scale: Normalize,
    colours: Any,
) -> None:
    for (row, column), name in grid.items():
        x, y = columns.index(column), rows.index(row)
        colour, text = EMPTY, "no run"
        if name in numbers:
            value, text = numbers[name]
            colour = colours(scale(value))
        draw_cell(axes, x, y, colour, text)


def _label_axes(axes: Axes, rows: Sequence[Any], columns: Sequence[Any], factors: tuple[str, str]) -> None:
    axes.set_xticks(range(len(columns)), [wrapped(_word(own), _CELL_IN[0]) for own in columns])
    axes.set_yticks(range(len(rows)), [_word(own) for own in rows])
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-0.5, len(rows) - 0.5))
    axes.set_xlabel(factors[1], fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT, length=0)


def _squares(found: Endings, grid: Grid, factors: tuple[str, str]) -> Figure:
    """The most frequent phase over two factors."""
    rows, columns = ([*dict.fromkeys(pair[nth] for pair in grid)] for nth in (0, 1))
    figure = Figure((max(1.3 * len(columns) + 2.5, 7.0), 0.6 * len(rows) + 2.2), layout="constrained")
    axes = figure.add_subplot()
    for (row, column), name in grid.items():
        x, y, most = columns.index(column), rows.index(row), found.most_frequent(name)
        colour, text = EMPTY, "no run"
        if most is not None:
            label, number, of = most
            colour, text = COLOURS[label], f"{wrapped(label, 1.1)}\n{number} of {of}"
        draw_cell(axes, x, y, colour, text)
    _label_axes(axes, rows, columns, factors)
    axes.set_ylabel(factors[0], fontsize=SMALL_PT)
    return figure


def _bars(table: StudyTable, found: Endings) -> Figure:
    """How many replicas of each condition end in each phase."""
    design = table.design
    if len(design.conditions) > MOST_CONDITIONS:
        raise refusal("table", table, f"up to {MOST_CONDITIONS} conditions, not {len(design.conditions)}")
    names = with_counts(names_of(design), table.replicas)
    figure = Figure((8.0, 0.4 * len(names) + 2.0), layout="constrained")
    axes = figure.add_subplot()
    labels = sorted({own for by in found.labels.values() for own in by.values()}, key=list(COLOURS).index)
    for label in labels:
        axes.add_patch(Rectangle((0, 0), 0, 0, facecolor=COLOURS[label], edgecolor="#777777", label=label))
    for place, name in enumerate(names):
        left, counts = 0, found.counts(name)
        for label in labels:
            if counts[label]:
                axes.barh(place, counts[label], left=left, color=COLOURS[label], edgecolor="#777777")
                axes.text(
                    left + counts[label] / 2,
                    place,
                    str(counts[label]),
                    ha="center",
                    va="center",
                    fontsize=SMALL_PT,
                )
            left += counts[label]
        if not left:
            axes.text(0.1, place, "no run", va="center", fontsize=SMALL_PT)
    axes.set_yticks(range(len(names)), list(names.values()))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("replicas", fontsize=SMALL_PT)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.tick_params(labelsize=SMALL_PT)
    if len(design.factors) == 1:
        axes.set_ylabel(short(design.factors[0]), fontsize=SMALL_PT)
    legend(figure, axes)
    return figure


def _word(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= 2 * _WORD_CHARACTERS else f"{text[: 2 * _WORD_CHARACTERS - 1]}…"
