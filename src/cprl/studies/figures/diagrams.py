"""Figures of two factors: heat maps of a metric, and in which phase replicas end."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from cprl.measuring.now import DECLINE, HARVESTING, RECOVERY
from cprl.studies.figures.levels import levels_note, replicas_text, short, title_of
from cprl.studies.tables.comparing import LAST, Comparison, compare, differing, digits_for
from cprl.studies.tables.sources import NO_BETTER
from cprl.studies.tables.table import TRAINING, Design, StudyTable
from cprl.terminal.figures import COLOURS as PHASE_COLOURS
from cprl.terminal.style import EMPTY, SHADES, SMALL_PT, draw_cell, head, picture_path, save, wrapped
from cprl.values import refusal

COLOURS: Final = {
    **PHASE_COLOURS,
    HARVESTING: "#c7e9c0",
    RECOVERY: "#c6dbef",
    DECLINE: "#d9c9b6",
    NO_BETTER: "#cfcfcf",
}
"""Of phases, light enough for text before them."""
_CELL_IN: Final = (1.05, 0.55)
_WORD_CHARACTERS: Final = 24

Grid = dict[tuple[Any, Any], str]
"""Conditions by the levels of two factors."""


def grids(design: Design) -> dict[tuple[str, str], Grid]:
    """The conditions by each pair of factors, where the others are at the levels of the reference.

    None for random draws, and pairs of which a factor has a single level left.
    """
    by_pair: dict[tuple[str, str], Grid] = {}
    at = design.conditions[design.reference]
    for one, other in combinations(design.factors, 2) if design.is_grid else ():
        rest = [factor for factor in design.factors if factor not in (one, other)]
        grid = {
            (levels[one], levels[other]): name
            for name, levels in design.conditions.items()
            if all(levels[factor] == at[factor] for factor in rest)
        }
        if all(len(set(levels)) > 1 for levels in zip(*grid, strict=True)):
            by_pair[one, other] = grid
    return by_pair


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

    Levels are in the order of the conditions. Differences are from the reference; those that are not 0 by
    Holm's method for all of the table have a star.

    Args:
        factors: two of its factors; any others are at the levels of the reference.
    """
    path, design = picture_path(path), table.design
    grid, elsewhere = _checked(design, factors)
    comparison = compare(table, metric, part=part, last=last)
    rows, columns = _levels_of(grid)
    width_in = max(2 * _CELL_IN[0] * len(columns) + 3.4, 8.0)
    figure = Figure((width_in, _CELL_IN[1] * len(rows) + 2.3), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    levels, differences = _numbers(comparison, grid)
    means = [value for value, _ in levels.values()]
    reach = max((abs(value) for value, _ in differences.values()), default=1.0) or 1.0
    scales = Normalize(min(means, default=0), max(means, default=1)), Normalize(-reach, reach)
    for axes, numbers, scale, name in zip(
        panels, (levels, differences), scales, ("viridis", "RdBu"), strict=True
    ):
        shades = matplotlib.colormaps[name]
        drawn = {at: (shades(scale(value)), text) for at, (value, text) in numbers.items()}
        _draw_grid(axes, grid, factors, drawn)
        bar = matplotlib.cm.ScalarMappable(scale, name)
        figure.colorbar(bar, ax=axes).ax.tick_params(labelsize=SMALL_PT)
    panels[0].set_ylabel(factors[0], fontsize=SMALL_PT)
    panels[0].set_title("mean over replicas (n)", fontsize=SMALL_PT + 1)
    panels[1].set_title("difference (* not 0 by Holm's method)", fontsize=SMALL_PT + 1)
    pairing = f"Differences from {design.reference}, {comparison.pairing_text}."
    head(figure, f"{design.name}: {title_of(comparison)}", f"{levels_note(comparison)} {pairing}{elsewhere}")
    return save(figure, path, colours=SHADES)


def phase_diagram(table: StudyTable, factors: tuple[str, str], path: Path | str) -> Path:
    """Draws in which phase most replicas end over two factors."""
    path, design = picture_path(path), table.design
    grid, elsewhere = _checked(design, factors)
    rows, columns = _levels_of(grid)
    figure = Figure((max(1.3 * len(columns) + 2.5, 7.0), 0.6 * len(rows) + 2.2), layout="constrained")
    axes = figure.add_subplot()
    phases = {}
    for name, counts in table.endings.items():
        label, number = next(iter(counts.items()))
        phases[name] = COLOURS[label], f"{wrapped(label, 1.1)}\n{number} of {sum(counts.values())}"
    _draw_grid(axes, grid, factors, phases)
    axes.set_ylabel(factors[0], fontsize=SMALL_PT)
    rules = "; ".join(table.ending_rules)
    note = f"{replicas_text(table.replicas)}. In which phase a replica ends: {rules}.{elsewhere}"
    head(figure, f"{design.name}: phases at the end of the training", note)
    return save(figure, path)


def _checked(design: Design, factors: tuple[str, str]) -> tuple[Grid, str]:
    """The conditions of two factors, and a sentence on the others."""
    by_pair = grids(design)
    if tuple(factors) not in by_pair:
        allowed = (
            "; ".join(map(" and ".join, by_pair)) or "none, as the conditions are no grid of two factors"
        )
        raise refusal("factors", factors, allowed)
    at = design.conditions[design.reference]
    rest = [f"{short(factor)} {at[factor]}" for factor in design.factors if factor not in factors]
    return by_pair[factors[0], factors[1]], f" Elsewhere: {', '.join(rest)}." if rest else ""


def _levels_of(grid: Grid) -> tuple[Sequence[Any], Sequence[Any]]:
    """The levels of both factors, rows and columns, in the order of the conditions."""
    rows, columns = zip(*grid, strict=True)
    return list(dict.fromkeys(rows)), list(dict.fromkeys(columns))


def _numbers(
    comparison: Comparison, grid: Grid
) -> tuple[dict[str, tuple[float, str]], dict[str, tuple[float, str]]]:
    """The number and the text of each cell, of means and of differences, by condition."""
    levels, differences = {}, {}
    marked = differing([comparison])
    for name in grid.values():
        compared = comparison.by_name[name]
        if compared.estimate is not None:
            value = compared.estimate.value
            levels[name] = value, f"{value:,.{digits_for(abs(value))}f}\nn={len(compared.defined)}"
            if name == comparison.reference:
                differences[name] = 0.0, "reference"
        if compared.difference is not None:
            value = compared.difference.value
            star = " *" if (comparison.metric, name) in marked else ""
            differences[name] = value, f"{value:+,.{digits_for(abs(value))}f}{star}"
    return levels, differences


def _draw_grid(
    axes: Axes, grid: Grid, factors: tuple[str, str], drawn: Mapping[str, tuple[Any, str]]
) -> None:
    """Draws a cell for each condition, of a colour and with a text by its name, over two factors."""
    rows, columns = _levels_of(grid)
    for (row, column), name in grid.items():
        colour, text = drawn.get(name, (EMPTY, "no run"))
        draw_cell(axes, columns.index(column), rows.index(row), colour, text)
    axes.set_xticks(range(len(columns)), [wrapped(_word(level), _CELL_IN[0]) for level in columns])
    axes.set_yticks(range(len(rows)), [_word(level) for level in rows])
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-0.5, len(rows) - 0.5))
    axes.set_xlabel(factors[1], fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT, length=0)


def _word(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= _WORD_CHARACTERS else f"{text[: _WORD_CHARACTERS - 1]}…"
