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
from cprl.terminal.picture_files import PNG_SHADES
from cprl.terminal.style import EMPTY_COLOUR, Width, drawing, wrapped
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
_MOST_HEAT_MAPS: Final = 2
"""The number of metrics that get a heat map."""
_CELL_EM: Final = 4.4
"""The height of a cell in em."""
_LEVEL_CHARACTERS: Final = 24
"""The largest number of characters of a level beside a map."""

Grid = dict[tuple[Any, Any], str]
"""Conditions by the levels of two factors."""


def map_figures(
    table: StudyTable, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> Iterator[StudyFigure]:
    """Yield the maps that fit a study, for `cprl.studies.study_figures.figures_of`."""
    for pair in grids(table.design):
        name = "_".join(map(file_name_of, pair))
        factors_text = " and ".join(pair)
        for metric in compared_metrics(table, metrics)[:_MOST_HEAT_MAPS]:
            draw = partial(heat_map, table, pair, metric=metric)
            file_name = f"map_{name}_{file_name_of(metric)}{suffix}"
            yield StudyFigure(file_name, f"{title(metric)} by {factors_text}", draw)
        if len({next(iter(counts)) for counts in table.endings.values() if counts}) > 1:
            draw = partial(phase_diagram, table, pair)
            subject = f"In which phase most replicas end, by {factors_text}"
            yield StudyFigure(f"phases_{name}{suffix}", subject, draw)


def grids(design: StudyDesign) -> dict[tuple[str, str], Grid]:
    """Return, for each pair of factors, the conditions that share the reference's levels of other factors.

    The result is empty for random draws. A pair is left out if one of its factors has a single level there.
    """
    by_pair: dict[tuple[str, str], Grid] = {}
    if not design.is_grid:
        return by_pair
    reference_levels = design.conditions[design.reference]
    for first, second in combinations(design.factors, 2):
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
        table: the table of a study.
        factors: two of its factors, the first for rows; any others are at the levels of the reference.
        path: the file of the figure; its suffix says the format.
        metric: the metric.
        width: as wide as a page or as a column of a paper.

    Returns:
        The path of the figure.

    Raises:
        ValueError: for factors without a grid of conditions.
    """
    grid = _grid_of(table, factors)
    tested = tuple(dict.fromkeys([*compared_metrics(table), metric]))
    levels = condition_means(table, [metric])
    differences = condition_differences(table, tested)
    maps = [_map_of_means(grid, _estimates_by_levels(grid, metric, levels))]
    shown_differences = _estimates_by_levels(grid, metric, differences)
    if shown_differences:
        maps.append(_map_of_differences(grid, shown_differences, table.design.reference))
    with drawing(path, width=width, colours=PNG_SHADES) as sheet:
        side_by_side = sheet.columns_that_fit(len(maps), 5.5 * len(grid.columns) + 12)
        panels = sheet.panels(len(maps), columns=side_by_side, row_height_em=_CELL_EM * len(grid.rows) + 8)
        for axes, content in zip(panels, maps, strict=True):
            draw_matrix(
                sheet,
                axes,
                grid.rows,
                grid.columns,
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
        if shown_differences:
            sheet.caption += _difference_note(table, shown_differences, differences, len(tested))
        sheet.caption += f"{grid.elsewhere}{missing_note(table)}"
    return Path(path)


class _Map(NamedTuple):
    """The content of a heat map."""

    title: str
    estimates: Mapping[Any, Estimate]
    """The defined estimates, by the levels of two factors."""
    texts: Mapping[Any, str]
    """The text of each cell, also of those without an estimate."""
    is_difference: bool


def _map_of_means(grid: "_Grid", means: Mapping[Any, Estimate]) -> _Map:
    """Return the map of means, with the number of replicas in each cell."""
    texts = dict.fromkeys(grid.conditions, "no run")
    for pair, mean in means.items():
        texts[pair] = f"{mean.value:{number_format(mean.value)}}\nn={mean.replicas}"
    return _Map("mean (n)", means, texts, is_difference=False)


def _map_of_differences(grid: "_Grid", differences: Mapping[Any, Estimate], reference: str) -> _Map:
    """Return the map of differences from the reference, with a star at those that are not 0."""
    texts = dict.fromkeys(grid.conditions, "no run")
    for pair, name in grid.conditions.items():
        if name == reference:
            texts[pair] = "reference"
    for pair, estimate in differences.items():
        texts[pair] = f"{estimate.value:+{number_format(estimate.value)}}{' *' * estimate.differs}"
    return _Map("difference", differences, texts, is_difference=True)


def _difference_note(
    table: StudyTable, shown: Mapping[Any, Estimate], differences: Family, metrics: int
) -> str:
    """Return the sentence of a caption about the differences shown, and about all tests if there are any."""
    note = f" Differences from {table.design.reference}, {pairing_text(table)}"
    if differences.tests:
        star = "*" if any(estimate.differs for estimate in shown.values()) else "none shown to be"
        tests = f"{differences.tests} differences of {metrics} metric{'s' * (metrics > 1)} together"
        note += f"; {star} not 0 by Holm's method for the {tests}"
    return f"{note}."


def _estimates_by_levels(grid: "_Grid", metric: str, family: Family) -> dict[Any, Estimate]:
    """Return the defined estimates of a metric, by the levels of two factors."""
    by_pair = {pair: family.get((name, metric)) for pair, name in grid.conditions.items()}
    return {
        pair: estimate for pair, estimate in by_pair.items() if estimate is not None and estimate.replicas
    }


def phase_diagram(
    table: StudyTable, factors: tuple[str, str], path: Path | str, *, width: Width = "page"
) -> Path:
    """Draw the phase in which most replicas end, by the levels of two factors.

    Args:
        table: the table of a study.
        factors: two of its factors, the first for rows; any others are at the levels of the reference.
        path: the file of the figure; its suffix says the format.
        width: as wide as a page or as a column of a paper.

    Returns:
        The path of the figure.

    Raises:
        ValueError: for factors without a grid of conditions.
    """
    grid = _grid_of(table, factors)
    with drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, row_height_em=_CELL_EM * len(grid.rows) + 6)
        cell_width = width_of_cells(sheet, grid.rows, grid.columns)
        cells = {}
        for pair, name in grid.conditions.items():
            counts = table.endings.get(name)
            cells[pair] = EMPTY_COLOUR, "no run"
            if counts:
                word, number = next(iter(counts.items()))
                text = f"{wrapped(word, cell_width)}\n{number} of {sum(counts.values())}"
                cells[pair] = ENDINGS[word], text
        draw_cells(sheet, axes, grid.rows, grid.columns, cells, upward=True)
        axes.set(xlabel=factor_word(factors[1]), ylabel=factor_word(factors[0]))
        sheet.title = f"{table.design.name}: phases at the end"
        rules = "; ".join(table.ending_rules)
        sheet.caption = figure_caption(table, f"In which phase most replicas end: {rules}.{grid.elsewhere}")
    return Path(path)


class _Grid(NamedTuple):
    """The conditions of a map, by the levels of two factors."""

    conditions: Grid
    rows: dict[Any, str]
    """The texts of the first factor's levels, in the order of the conditions."""
    columns: dict[Any, str]
    """The texts of the second factor's levels."""
    elsewhere: str
    """A sentence about the levels of all other factors; "" without any."""


def _grid_of(table: StudyTable, factors: tuple[str, str]) -> _Grid:
    """Return the grid of two factors; refuse factors that have none.

    A row or column is kept if any of its conditions has run, and all are if none has.
    """
    design = table.design
    by_pair = grids(design)
    if tuple(factors) not in by_pair:
        pairs = "; ".join(map(" and ".join, by_pair))
        raise refusal("factors", factors, pairs or "none, as the conditions are no grid of two factors")
    conditions = by_pair[factors[0], factors[1]]
    has_run = [levels for levels, name in conditions.items() if table.replicas[name]]
    rows = {row: _level_text(row) for row, _ in has_run or conditions}
    columns = {column: _level_text(column) for _, column in has_run or conditions}
    kept = {pair: name for pair, name in conditions.items() if pair[0] in rows and pair[1] in columns}
    reference_levels = design.conditions[design.reference]
    other_factors = [
        f"{factor_word(factor)} {reference_levels[factor]}"
        for factor in design.factors
        if factor not in factors
    ]
    elsewhere = f" Elsewhere: {', '.join(other_factors)}." if other_factors else ""
    return _Grid(kept, rows, columns, elsewhere)


def _level_text(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= _LEVEL_CHARACTERS else f"{text[: _LEVEL_CHARACTERS - 1]}…"
