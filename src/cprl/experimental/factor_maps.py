"""Maps of two factors of a study: heat maps of a metric, and the phase in which most replicas end."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, Final, NamedTuple

from cprl.measuring.outcome import DECLINE, HARVESTING, NO_BETTER, RECOVERY, TRAGEDY
from cprl.measuring.registry import COLLECTIVE_RETURN, title
from cprl.measuring.statistics import Estimate, Family, number_format
from cprl.studies.study_figures import (
    StudyFigure,
    factor_word,
    figure_caption,
    file_name_of,
    metric_title,
    missing_note,
)
from cprl.studies.tables.comparing import (
    compared_metrics,
    condition_differences,
    condition_means,
    episodes_text,
    pairing_text,
)
from cprl.studies.tables.tidy_table import StudyDesign, StudyTable
from cprl.terminal.panels import draw_cells, draw_matrix, width_of_cells
from cprl.terminal.style import EMPTY, PNG_SHADES, Width, drawing, wrapped
from cprl.values import refusal

ENDINGS: Final = {
    TRAGEDY: "#f9cdbf",
    HARVESTING: "#c7e9c0",
    RECOVERY: "#c6dbef",
    DECLINE: "#d9c9b6",
    NO_BETTER: "#cfcfcf",
    "exploration": "#e4e4e4",
    "combat": "#faecb4",
    "cultivation": "#e0d4f0",
    "none of the four patterns": "#ffffff",
}
"""The colours of phases, light enough for text on them. The last four occur in tables of the 2019 study."""
_MAPPED: Final = 2
"""The number of metrics that get a heat map."""
_CELL: Final = 4.4
"""The height of a cell in em."""
_WORD_CHARACTERS: Final = 24

Grid = dict[tuple[Any, Any], str]
"""Conditions by the levels of two factors."""


def map_figures(
    table: StudyTable, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> Iterator[StudyFigure]:
    """Yield the maps that fit a study, for `cprl.studies.study_figures.figures_of`."""
    for pair in grids(table.design):
        name = "_".join(map(file_name_of, pair))
        what = " and ".join(pair)
        for metric in compared_metrics(table, metrics)[:_MAPPED]:
            draw = partial(heat_map, table, pair, metric=metric)
            file_name = f"map_{name}_{file_name_of(metric)}{suffix}"
            yield StudyFigure(file_name, f"{title(metric)} by {what}", draw)
        if len({next(iter(counts)) for counts in table.endings.values() if counts}) > 1:
            what = f"In which phase most replicas end, by {what}"
            draw = partial(phase_diagram, table, pair)
            yield StudyFigure(f"phases_{name}{suffix}", what, draw)


def grids(design: StudyDesign) -> dict[tuple[str, str], Grid]:
    """Return, for each pair of factors, the conditions that share the reference's levels of other factors.

    There are none for random draws, and for pairs of which a factor has a single level left.
    """
    by_pair: dict[tuple[str, str], Grid] = {}
    reference_levels = design.conditions[design.reference]
    for first, second in combinations(design.factors, 2) if design.is_grid else ():
        other_factors = [factor for factor in design.factors if factor not in (first, second)]
        grid = {}
        for name, levels in design.conditions.items():
            if all(levels[factor] == reference_levels[factor] for factor in other_factors):
                grid[levels[first], levels[second]] = name
        if all(len(set(levels)) > 1 for levels in zip(*grid, strict=True)):
            by_pair[first, second] = grid
    return by_pair


def heat_map(
    table: StudyTable,
    factors: tuple[str, str],
    path: Path | str,
    *,
    metric: str = COLLECTIVE_RETURN,
    width: Width = "page",
) -> Path:
    """Draw heat maps of a metric over two factors: its mean, and its difference from the reference.

    Levels are in the order of the conditions. Differences are from the reference; those that are not 0 by
    Holm's method for all that the table's summary tests have a star.

    Args:
        factors: two of its factors; any others are at the levels of the reference.
    """
    grid, elsewhere = _grid_of(table, factors)
    rows, columns = _levels_of(grid)
    tested = tuple(dict.fromkeys([*compared_metrics(table), metric]))
    levels = condition_means(table, [metric])
    differences = condition_differences(table, tested)
    maps = [_map_of_means(grid, _estimates_by_levels(grid, metric, levels))]
    changes = _estimates_by_levels(grid, metric, differences)
    if changes:
        maps.append(_map_of_differences(grid, changes, table.design.reference))
    with drawing(path, width=width, colours=PNG_SHADES) as sheet:
        side_by_side = sheet.fitting(len(maps), 5.5 * len(columns) + 12)
        panels = sheet.panels(len(maps), columns=side_by_side, high=_CELL * len(rows) + 8)
        for axes, content in zip(panels, maps, strict=True):
            draw_matrix(
                sheet,
                axes,
                rows,
                columns,
                {pair: estimate.value for pair, estimate in content.estimates.items()},
                content.texts,
                is_difference=content.is_difference,
                share=1 / side_by_side,
                upward=True,
            )
            axes.set(xlabel=factor_word(factors[1]), ylabel=factor_word(factors[0]))
            axes.set_title(content.title)
        sheet.title = f"{table.design.name}: {metric_title(metric, levels)}"
        sheet.caption = f"Means of {episodes_text(table)}, then over n replicas."
        if changes:
            sheet.caption += _difference_note(table, changes, differences, len(tested))
        sheet.caption += f"{elsewhere}{missing_note(table)}"
    return Path(path)


class _Map(NamedTuple):
    """The content of a heat map."""

    title: str
    estimates: Mapping[Any, Estimate]
    """The defined estimates, by the levels of two factors."""
    texts: Mapping[Any, str]
    """The text of each cell, also of those without an estimate."""
    is_difference: bool


def _map_of_means(grid: Grid, means: Mapping[Any, Estimate]) -> _Map:
    """Return the map of means, with the number of replicas in each cell."""
    texts = dict.fromkeys(grid, "no run")
    for pair, mean in means.items():
        texts[pair] = f"{mean.value:{number_format(mean.value)}}\nn={mean.replicas}"
    return _Map("mean (n)", means, texts, is_difference=False)


def _map_of_differences(grid: Grid, changes: Mapping[Any, Estimate], reference: str) -> _Map:
    """Return the map of differences from the reference, with a star at those that are not 0."""
    texts = dict.fromkeys(grid, "no run")
    for pair, name in grid.items():
        if name == reference:
            texts[pair] = "reference"
    for pair, change in changes.items():
        texts[pair] = f"{change.value:+{number_format(change.value)}}{' *' * change.differs}"
    return _Map("difference", changes, texts, is_difference=True)


def _difference_note(
    table: StudyTable, changes: Mapping[Any, Estimate], differences: Family, metrics: int
) -> str:
    """Return the sentence of a caption about differences, and about their tests if there are any."""
    note = f" Differences from {table.design.reference}, {pairing_text(table)}"
    if differences.tests:
        star = "*" if any(change.differs for change in changes.values()) else "none shown to be"
        tests = f"{differences.tests} differences of {metrics} metric{'s' * (metrics > 1)} together"
        note += f"; {star} not 0 by Holm's method for the {tests}"
    return f"{note}."


def _estimates_by_levels(grid: Grid, metric: str, family: Family) -> dict[Any, Estimate]:
    """Return the defined estimates of a metric, by the levels of two factors."""
    by_pair = {pair: family.get((name, metric)) for pair, name in grid.items()}
    return {
        pair: estimate for pair, estimate in by_pair.items() if estimate is not None and estimate.replicas
    }


def phase_diagram(
    table: StudyTable, factors: tuple[str, str], path: Path | str, *, width: Width = "page"
) -> Path:
    """Draw the phase in which most replicas end, by the levels of two factors."""
    grid, elsewhere = _grid_of(table, factors)
    rows, columns = _levels_of(grid)
    with drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, high=_CELL * len(rows) + 6)
        wide = width_of_cells(sheet, rows, columns)
        cells = {}
        for pair, name in grid.items():
            counts = table.endings.get(name)
            cells[pair] = EMPTY, "no run"
            if counts:
                word, number = next(iter(counts.items()))
                text = f"{wrapped(word, wide)}\n{number} of {sum(counts.values())}"
                cells[pair] = ENDINGS[word], text
        draw_cells(sheet, axes, rows, columns, cells, upward=True)
        axes.set(xlabel=factor_word(factors[1]), ylabel=factor_word(factors[0]))
        sheet.title = f"{table.design.name}: phases at the end"
        rules = "; ".join(table.ending_rules)
        sheet.caption = figure_caption(table, f"In which phase most replicas end: {rules}.{elsewhere}")
    return Path(path)


def _grid_of(table: StudyTable, factors: tuple[str, str]) -> tuple[Grid, str]:
    """Return the grid of two factors without levels that were not run, and a sentence on other factors."""
    design = table.design
    by_pair = grids(table.design)
    if tuple(factors) not in by_pair:
        pairs = "; ".join(map(" and ".join, by_pair))
        raise refusal("factors", factors, pairs or "none, as the conditions are no grid of two factors")
    reference_levels = design.conditions[design.reference]
    held = [
        f"{factor_word(factor)} {reference_levels[factor]}"
        for factor in design.factors
        if factor not in factors
    ]
    grid = by_pair[factors[0], factors[1]]
    finished_only = {levels: name for levels, name in grid.items() if table.replicas[name]}
    rows, columns = _levels_of(finished_only or grid)
    grid = {pair: name for pair, name in grid.items() if pair[0] in rows and pair[1] in columns}
    return grid, f" Elsewhere: {', '.join(held)}." if held else ""


def _levels_of(grid: Grid) -> tuple[dict[Any, str], dict[Any, str]]:
    """Return the levels of both factors, ordered, with their texts."""
    rows = {row: _word(row) for row, _ in grid}
    columns = {column: _word(column) for _, column in grid}
    return rows, columns


def _word(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= _WORD_CHARACTERS else f"{text[: _WORD_CHARACTERS - 1]}…"
