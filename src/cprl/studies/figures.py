"""Figures of a study's table: a metric by a factor whose levels are numbers, conditions one below the other,
the course of the training, and maps of two factors. `figures_of` says which of them fit a study.

Points and lines are means over replicas with their 95 % intervals, faint points single replicas, dashes
random play in the worlds of the evaluation.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations
from math import isclose, nan
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.ticker import NullLocator

from cprl.measuring.outcome import DECLINE, HARVESTING, NO_BETTER, RECOVERY, TRAGEDY
from cprl.measuring.registry import COLLECTIVE_RETURN, bounds, title
from cprl.measuring.statistics import Estimate, Family, curve_interval, form_for
from cprl.measuring.table import WINDOWS, by_replica, where
from cprl.measuring.windows import SMOOTHED_EPISODES, running_mean
from cprl.studies.tables.comparing import (
    INTERVALS,
    Kind,
    capitalised,
    differences_of,
    episodes_text,
    levels_of,
    measures_of,
    metrics_of,
    pairing_text,
    values_of,
)
from cprl.studies.tables.table import RANDOM, TRAINING, Design, StudyTable
from cprl.terminal.panels import draw_cells, draw_dots, draw_line, draw_matrix, width_of_cells
from cprl.terminal.style import CHARACTER, DASHES, EMPTY, MEAN, RANDOM_LINE, SHADES, Width, drawing, wrapped
from cprl.values import refusal
from cprl.values.arrays import Float64

MOST_CONDITIONS: Final = 60
"""A figure with a row or panel for each condition has at most so many."""
COLOURS: Final = ("#08519c", "#d95f02", "#1b9e77", "#7b3294", "#a50f15", "#8c6d31", "#e7298a", "#555555")
"""Of conditions or lines that have names; numbers get a scale from dark to light."""
_NAME: Final = 16
"""The largest width of a condition's name in em, and at most 0.3 of the figure's; then it wraps."""
CHANCE: Final = "random play (in the colour of its conditions where they differ)"
_LINE: Final = 1.25
"""The height of a line of text in em."""
_MAPPED: Final = 2
"""Metrics that have a heat map."""


def figures_of(
    table: StudyTable, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> Iterator[tuple[str, str, Callable[[Path], Path]]]:
    """Yield what fits a study: the name of each figure's file, what it shows, and what draws it."""
    if not table.metrics:
        return
    design = table.design
    conditions = finished(table)
    for factor in design.factors:
        if is_numeric([design.conditions[name][factor] for name in conditions]):
            draw = partial(by_factor, table, factor, metrics=metrics)
            yield f"by_{_file_name(factor)}{suffix}", f"Outcome by {factor}", draw
    if len(conditions) <= MOST_CONDITIONS:
        levels = partial(by_condition, table, metrics=metrics)
        yield f"levels{suffix}", "Outcome by condition", levels
        yield f"courses{suffix}", "The course of the training", partial(courses, table, metrics=metrics)
        if len(conditions) > 1 and table.replicas[design.reference]:
            differences = partial(by_condition, table, kind="differences", metrics=metrics)
            yield f"differences{suffix}", f"Differences from {design.reference}", differences
    for pair in grids(design):
        words = "_".join(map(_file_name, pair))
        what = " and ".join(pair)
        for metric in metrics_of(table, metrics)[:_MAPPED]:
            draw = partial(heat_map, table, pair, metric=metric)
            yield f"map_{words}_{_file_name(metric)}{suffix}", f"{title(metric)} by {what}", draw
        if len({next(iter(counts)) for counts in table.endings.values()}) > 1:
            what = f"In which phase most replicas end, by {what}"
            yield f"phases_{words}{suffix}", what, partial(phase_diagram, table, pair)


DRAWN: Final = re.compile(r"(by_|map_|phases|levels|differences|courses).*\.(png|pdf|svg)")
"""The names of these files."""


def _file_name(factor: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", factor.replace("*", "all")).strip("_")


# A metric by a factor

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
    width: Width = "page",
) -> Path:
    """Draw metrics against a factor whose levels are numbers.

    The axis is logarithmic where the largest level is more than 30 times the smallest. Up to eight levels,
    some of which would then be too close to be told apart, stand at equal distances, which the axis says.
    Conditions that are equal but for this factor are joined by a line, which has a colour of its own if there
    are several. In random draws, where hardly any are, points stand alone: the other factors vary too. There
    are no dashes where random play differs and points stand alone that have the same level.
    """
    design = table.design
    numeric = [name for name in design.factors if is_numeric(design.levels(name))]
    if factor not in numeric:
        allowed = ", ".join(numeric) or "none, as no factor has levels that are numbers"
        raise refusal("factor", factor, allowed)
    chosen = _chosen(table, metrics)
    levels = levels_of(table, chosen)
    rows = table.windows()
    lines = _lines(table, factor)
    others = [name for name in design.factors if name != factor]
    only = [design.conditions[names[0]][others[0]] for names in lines.values()] if len(others) == 1 else []
    colours = colours_of(list(lines), only or range(len(lines)))
    level_of = {name: design.conditions[name][factor] for name in finished(table)}
    places, is_even = places_of(level_of.values())
    at = {name: places[level] for name, level in level_of.items()}
    with drawing(path, width=width) as sheet:
        columns = sheet.fitting(min(len(chosen), 3), 16)
        panels = sheet.panels(len(chosen), columns=columns, high=19, sharex=True)
        for axes, metric in zip(panels, chosen, strict=True):
            values = values_of(rows, metric)
            chance = _chance(table, metric)
            is_same = _depends_on_place(chance, at)
            for label, names in lines.items():
                drawn = [name for name in names if (name, metric) in levels]
                is_joined = design.is_grid and len({at[name] for name in names}) == len(names)
                style = "-" if is_joined else "none"
                draw_dots(
                    axes,
                    [at[name] for name in drawn],
                    [levels[name, metric] for name in drawn],
                    replicas=[list(values[name].values()) for name in drawn],
                    color=colours[label],
                    label=label or "mean and interval",
                    linestyle=style,
                )
                if chance and (is_same or len(lines) > 1):
                    look = {**RANDOM_LINE, "marker": "_", "markersize": 9}
                    look |= {} if is_same else {"color": colours[label]}
                    look |= {} if is_joined else {"linestyle": style}
                    dashes = [chance.get(name, nan) for name in names]
                    axes.plot([at[name] for name in names], dashes, **look)
            if chance and (is_same or len(lines) > 1):
                axes.plot([], [], label=CHANCE, **RANDOM_LINE)
            bottom, top = axes.get_ylim()
            if bounds(metric)[0] == 0 and bottom < top / 2:
                axes.set_ylim(0, None)
            _scale(axes, places, _replicas_by_level(table, factor), is_even=is_even)
            axes.set_title(_title_of(metric, levels))
        for axes in panels[-columns:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(f"{short(factor)}, at equal distances" if is_even else short(factor))
        sheet.title = f"{design.name}: outcome by {short(factor)}"
        sheet.caption = _caption(table, f"{_levels_note(table)} Faint: single replicas.")
        if others and list(lines) == [""]:
            sheet.caption += f" Conditions differ in {', '.join(map(short, others))} too."
    return Path(path)


def _depends_on_place(chance: Mapping[str, float], at: Mapping[str, float]) -> bool:
    """Return whether random play is the same under all conditions that stand at the same place."""
    by_place: dict[float, list[float]] = {}
    for name, value in chance.items():
        by_place.setdefault(at[name], []).append(value)
    return all(map(is_one, by_place.values()))


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
    for name in finished(table):
        level = table.design.conditions[name][factor]
        counts[level] = counts.get(level, 0) + table.replicas[name]
    return counts


def _scale(
    axes: Axes, places: Mapping[float, float], replicas: Mapping[float, int], *, is_even: bool
) -> None:
    """Set a tick for each level where there are few, with the number of replicas where it differs."""
    if not is_even and is_logarithmic(list(places)):
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")  # of matplotlib's own, formulas are texts like names
        axes.xaxis.set_minor_locator(NullLocator())
    if len(places) <= _MOST_LINES:
        is_same = len(set(replicas.values())) == 1
        texts = [f"{level:g}" + ("" if is_same else f"\nn={replicas[level]}") for level in places]
        axes.set_xticks(list(places.values()), texts)


def _lines(table: StudyTable, factor: str) -> dict[str, list[str]]:
    """Return conditions that are equal but for a factor, in the order of its levels, by what they have in
    common."""
    design = table.design
    names = finished(table)
    others = [name for name in design.factors if name != factor]
    lines: dict[str, list[str]] = {}
    for name in names:  # lines are in the order of the conditions
        levels = design.conditions[name]
        common = ", ".join(f"{short(other)} {levels[other]}" for other in others) if design.is_grid else ""
        lines.setdefault(common, []).append(name)
    if len(lines) > _MOST_LINES:
        lines = {"": names}
    level_of = {name: float(design.conditions[name][factor]) for name in names}
    return {common: sorted(names, key=lambda name: level_of[name]) for common, names in lines.items()}


def is_numeric(levels: Sequence[Any]) -> bool:
    """Return whether levels stand on an axis of numbers: at least two, all numbers."""
    return len(set(levels)) > 1 and all(
        isinstance(level, int | float) and not isinstance(level, bool) for level in levels
    )


def is_logarithmic(levels: Sequence[float]) -> bool:
    """Return whether that axis is logarithmic."""
    return min(levels) > 0 and max(levels) > _APART * min(levels)


# Conditions one below the other


_NO_WIDTH: Final = 1e-12
"""Of an axis on which all differences are 0."""


def by_condition(
    table: StudyTable,
    path: Path | str,
    *,
    kind: Kind = "levels",
    metrics: Sequence[str] = (),
    width: Width = "page",
) -> Path:
    """Draw conditions one below the other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `MOST_CONDITIONS` conditions that were run; the others are left out.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
        metrics: by default those that are compared, and of levels what institutions took and found.
    """
    design = table.design
    is_levels = kind == "levels"
    conditions = [name for name in finished(table) if is_levels or name != design.reference]
    if not is_levels and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(conditions) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(conditions)}")
    chosen = _chosen(table, metrics) if is_levels else metrics_of(table, metrics)
    family = (levels_of if is_levels else differences_of)(table, chosen)
    levels = family if is_levels else levels_of(table, chosen)
    rows = table.windows()
    with drawing(path, width=width) as sheet:
        wide = min(_NAME, 0.3 * sheet.width_em)
        words = names_of(table)
        names = {name: wrapped(words[name], wide) for name in conditions}
        lines = [name.splitlines() for name in names.values()]
        high = (_LINE * max(map(len, lines)) + 0.8) * len(conditions) + 7
        beside = CHARACTER * max(len(line) for name in lines for line in name)
        columns = sheet.fitting(len(chosen), 12.5)
        panels = sheet.panels(len(chosen), columns=columns, high=high, beside=beside, sharey=True)
        for axes, metric in zip(panels, chosen, strict=True):
            values = values_of(rows, metric) if is_levels else {}
            chance = _chance(table, metric) if is_levels else {}
            for place, name in enumerate(conditions):
                _draw_row(axes, place, family.get((name, metric)), values.get(name, {}))
                if name in chance:
                    look = {**RANDOM_LINE, "linestyle": (0, (2, 1))}
                    axes.plot([chance[name]] * 2, [place - 0.42, place + 0.42], **look)
            if not is_levels:
                axes.axvline(0, **RANDOM_LINE)
                if axes.dataLim.width < _NO_WIDTH:
                    axes.set_xlim(-1, 1)
            axes.set_title(_title_of(metric, levels))
            axes.set_yticks(range(len(conditions)), list(names.values()))
            axes.locator_params(axis="x", nbins=3)
            axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        panels[0].set_ylim(len(conditions) - 0.4, -0.6)
        by = short(design.factors[0]) if len(design.factors) == 1 else "condition"
        sheet.title = f"{design.name}: outcome by {by}"
        note = f"{_levels_note(table)} Faint: single replicas. Dashed: random play."
        if not is_levels:
            sheet.title = f"{design.name}: difference from {' '.join(design.reference.splitlines())}"
            pairing = capitalised(pairing_text(table))
            note = f"{pairing}; means of {episodes_text(table)}; {INTERVALS}."
        sheet.caption = _caption(table, note)
    return Path(path)


def _draw_row(axes: Axes, place: int, one: Estimate | None, values: Mapping[int, float]) -> None:
    """Draw a number of a condition, or why it has none."""
    if one is not None and one.replicas:
        draw_dots(axes, [place], [one], replicas=[list(values.values())], across=True)
        return
    why = "no pairs" if one is None else "undefined"
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
    middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.get_yaxis_transform()}
    axes.text(0.5, place, why, bbox=box, **middle)


# Courses

_USUAL: Final = (COLLECTIVE_RETURN, "survival_steps")
"""Metrics whose courses are drawn unless something else is asked for."""
_PART: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
_MOST_TOGETHER: Final = 6
"""Conditions that one panel shows; more have a panel each, beside the reference."""


def courses(
    table: StudyTable, path: Path | str, *, metrics: Sequence[str] = (), width: Width = "page"
) -> Path:
    """Draw the mean over replicas in the course of the training, its 95 % interval, and random play.

    Up to six conditions share panels, one for each metric; more have a panel each, of the first metric, with
    the reference beside it in grey. Running means are over whole windows of the table and centred.

    Args:
        metrics: by default the collective return and survival; else the first that the table has.
    """
    design = table.design
    conditions = finished(table)
    usual = [metric for metric in _USUAL if metric in table.metrics]
    chosen = metrics_of(table, metrics or usual)[: len(metrics) or 2]
    if len(conditions) > MOST_CONDITIONS:
        raise ValueError(f"the table has {len(conditions)} conditions; allowed: up to {MOST_CONDITIONS}")
    names = names_of(table)
    factor = design.factors[0] if len(design.factors) == 1 else None
    is_together = len(conditions) <= _MOST_TOGETHER
    views: list[tuple[str, dict[str, tuple[str, str]]]]
    if is_together:
        levels = [name if factor is None else design.conditions[name][factor] for name in conditions]
        colours = colours_of(conditions, levels)
        lines = {name: (colours[name], names[name]) for name in conditions}
        views = [(metric, lines) for metric in chosen]
    else:
        reference = design.reference
        beside = {reference: ("#777777", f"reference: {names[reference]}")} if reference in conditions else {}
        alone = (MEAN, "the condition of the panel")
        views = [(chosen[0], {**beside, name: alone}) for name in conditions if name != reference]
    windows: set[int] = set()
    is_dashed = factor is None or not is_numeric(design.levels(factor))
    with drawing(path, width=width) as sheet:
        columns = 1 if is_together else sheet.fitting(4, 14)
        high = 21 if is_together else 15
        panels = sheet.panels(len(views), columns=columns, high=high, sharex=True, sharey=not is_together)
        for axes, (metric, lines) in zip(panels, views, strict=True):
            windows |= _draw_courses(axes, table, metric, lines, is_dashed=is_dashed)
            _draw_chance(axes, _chance(table, metric), lines)
            *_, last = lines
            axes.set_title(title(metric) if is_together else names[last])
        for axes in panels[-columns:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("episode")
        for group in [[axes] for axes in panels] if is_together else [panels]:
            if all(axes.dataLim.y0 >= 0 for axes in group):
                group[0].set_ylim(0, None)
        sheet.legend_title = short(factor) if factor is not None and is_together else ""
        sheet.title = f"{design.name}: {'course of the training' if is_together else title(chosen[0])}"
        over = " to ".join(map(str, dict.fromkeys((min(windows), max(windows)))))
        smoothed = (
            f"Centred running means over {over} episodes" if max(windows) > 1 else "Nothing is smoothed"
        )
        note = f"{smoothed}, then over replicas; bands: 95% intervals over replicas by Student's t."
        sheet.caption = _caption(table, note)
    return Path(path)


def _draw_chance(axes: Axes, chance: Mapping[str, float], lines: Mapping[str, tuple[str, str]]) -> None:
    """Draw random play under the conditions of a panel, a line for all where it is the same."""
    values = {name: chance[name] for name in lines if name in chance}
    is_same = is_one(values.values())
    for name, value in list(values.items())[: 1 if is_same else None]:
        look = {} if is_same else {"color": lines[name][0], "linewidth": 1.0}
        axes.axhline(value, **{**RANDOM_LINE, **look})
    if values:
        axes.plot([], [], **RANDOM_LINE, label=CHANCE)


def _draw_courses(
    axes: Axes, table: StudyTable, metric: str, lines: Mapping[str, tuple[str, str]], *, is_dashed: bool
) -> set[int]:
    """Draw the courses of conditions, each of a colour and with a label, and return over how many episodes
    their running means are."""
    windows = set()
    training = where(table.rows, part=TRAINING)
    for place, (name, (colour, label)) in enumerate(lines.items()):
        rows = where(training, condition=name, metric=metric)
        if not len(rows):
            continue
        lengths = _windows_of(rows, WINDOWS)
        length = int(lengths.max())
        episodes = pc.min(by_replica(rows, metric)["episodes"]).as_py()
        is_whole = (lengths == length).all(0)  # those that all replicas have
        count = max(1, min(SMOOTHED_EPISODES, episodes // _PART) // length)
        at = running_mean(_windows_of(rows, "episode")[0, is_whole] + (length - 1) / 2, count)
        curve = curve_interval(running_mean(_windows_of(rows, "value")[:, is_whole], count))
        label = " ".join(label.splitlines())
        label = f"\N{ZERO WIDTH SPACE}{label}" if label.startswith("_") else label  # matplotlib would hide it
        dash = DASHES[place % len(DASHES)] if is_dashed and len(lines) > 2 else "-"
        dot = "." if len(at) < 3 else None
        draw_line(axes, at, curve, color=colour, linestyle=dash, marker=dot, label=label)
        windows.add(min(count, int(is_whole.sum())) * length)
    return windows or {1}


def _windows_of(rows: pa.Table, number: str) -> Float64:
    """Return a column of the windows that all replicas of a condition have, [R, W]."""
    replicas = [
        where(rows, replica=replica)[number].to_numpy() for replica in rows["replica"].unique().to_pylist()
    ]
    return np.array([of_replica[: min(map(len, replicas))] for of_replica in replicas])


# Maps of two factors

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
"""Colours of how trainings went, light enough for text before them; the last four are phases of 2019 in
committed tables."""
_CELL: Final = 4.4
"""The height of a cell in em."""
_WORD_CHARACTERS: Final = 24

Grid = dict[tuple[Any, Any], str]
"""Conditions by the levels of two factors."""


def grids(design: Design) -> dict[tuple[str, str], Grid]:
    """Return the conditions by each pair of factors, where the others are at the levels of the reference.

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
    metric: str = COLLECTIVE_RETURN,
    width: Width = "page",
) -> Path:
    """Draw a metric over two factors: its mean with the number of replicas, and its difference.

    Levels are in the order of the conditions. Differences are from the reference; those that are not 0 by
    Holm's method for all that the table's summary tests have a star.

    Args:
        factors: two of its factors; any others are at the levels of the reference.
    """
    grid, elsewhere = _grid_of(table, factors)
    rows, columns = _levels_of(grid)
    tested = tuple(dict.fromkeys([*metrics_of(table), metric]))
    levels = levels_of(table, [metric])
    differences = differences_of(table, tested)
    means = _at(grid, metric, levels)
    changes = _at(grid, metric, differences)
    absent = dict.fromkeys(grid, "no run")
    maps: list[tuple[str, dict[Any, Estimate], dict[Any, str], dict[str, Any]]] = []
    texts = {pair: f"{one.value:{form_for(one.value)}}\nn={one.replicas}" for pair, one in means.items()}
    maps.append(("mean (n)", means, absent | texts, {"colours": "viridis", "is_about_0": False}))
    if changes:
        texts = {pair: "reference" for pair, name in grid.items() if name == table.design.reference}
        texts |= {
            pair: f"{one.value:+{form_for(one.value)}}{' *' * one.differs}" for pair, one in changes.items()
        }
        maps.append(("difference", changes, absent | texts, {}))
    with drawing(path, width=width, colours=SHADES) as sheet:
        side_by_side = sheet.fitting(len(maps), 5.5 * len(columns) + 12)
        panels = sheet.panels(len(maps), columns=side_by_side, high=_CELL * len(rows) + 8)
        for axes, (what, numbers, texts, look) in zip(panels, maps, strict=True):
            values = {pair: one.value for pair, one in numbers.items()}
            share = 1 / side_by_side
            draw_matrix(sheet, axes, rows, columns, values, texts, share=share, upward=True, **look)
            axes.set(xlabel=short(factors[1]), ylabel=short(factors[0]))
            axes.set_title(what)
        sheet.title = f"{table.design.name}: {_title_of(metric, levels)}"
        sheet.caption = f"Means of {episodes_text(table)}, then over n replicas."
        if changes:
            star = "*" if any(one.differs for one in changes.values()) else "none shown to be"
            metrics = f"{len(tested)} metric{'s' * (len(tested) > 1)}"
            tests = f"{differences.tests} differences of {metrics} together"
            judged = f"; {star} not 0 by Holm's method for the {tests}"
            paired = f" Differences from {table.design.reference}, {pairing_text(table)}"
            sheet.caption += f"{paired}{judged if differences.tests else ''}."
        sheet.caption += f"{elsewhere}{_not_run(table)}"
    return Path(path)


def _at(grid: Grid, metric: str, family: Family) -> dict[Any, Estimate]:
    """Return the estimates of a metric that are defined, by the levels of two factors."""
    by_pair = {pair: family.get((name, metric)) for pair, name in grid.items()}
    return {pair: one for pair, one in by_pair.items() if one is not None and one.replicas}


def phase_diagram(
    table: StudyTable, factors: tuple[str, str], path: Path | str, *, width: Width = "page"
) -> Path:
    """Draw in which phase most replicas end over two factors."""
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
        axes.set(xlabel=short(factors[1]), ylabel=short(factors[0]))
        sheet.title = f"{table.design.name}: phases at the end"
        rules = "; ".join(table.ending_rules)
        sheet.caption = _caption(table, f"In which phase most replicas end: {rules}.{elsewhere}")
    return Path(path)


def _grid_of(table: StudyTable, factors: tuple[str, str]) -> tuple[Grid, str]:
    """Return the conditions of two factors, of levels that were run, and a sentence on the others."""
    design = table.design
    by_pair = grids(table.design)
    if tuple(factors) not in by_pair:
        pairs = "; ".join(map(" and ".join, by_pair))
        raise refusal("factors", factors, pairs or "none, as the conditions are no grid of two factors")
    at = design.conditions[design.reference]
    rest = [f"{short(factor)} {at[factor]}" for factor in design.factors if factor not in factors]
    grid = by_pair[factors[0], factors[1]]
    finished_only = {levels: name for levels, name in grid.items() if table.replicas[name]}
    rows, columns = _levels_of(finished_only or grid)
    grid = {pair: name for pair, name in grid.items() if pair[0] in rows and pair[1] in columns}
    return grid, f" Elsewhere: {', '.join(rest)}." if rest else ""


def _levels_of(grid: Grid) -> tuple[dict[Any, str], dict[Any, str]]:
    """Return the levels of both factors with their words, in order."""
    rows, columns = zip(*grid, strict=True)
    return {level: _word(level) for level in rows}, {level: _word(level) for level in columns}


def _word(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= _WORD_CHARACTERS else f"{text[: _WORD_CHARACTERS - 1]}…"


# What all of them share


def finished(table: StudyTable) -> list[str]:
    """Return the conditions that have a finished run; figures show no others."""
    return [name for name in table.design.conditions if table.replicas[name]]


def _not_run(table: StudyTable) -> str:
    """Return a sentence on the conditions that a figure leaves out."""
    count = len(table.design.conditions) - len(finished(table))
    return f" Not run: {count} of {len(table.design.conditions)} conditions." if count else ""


def _chance(table: StudyTable, metric: str) -> dict[str, float]:
    """Return random play under each condition in which it was played and the metric is defined."""
    levels = levels_of(table, [metric], part=RANDOM)
    return {name: level.value for (name, _), level in levels.items() if level.replicas}


def is_one(values: Iterable[float]) -> bool:
    """Return whether values are one number, but for the rounding of exported tables to float32."""
    values = list(values)
    return not values or isclose(min(values), max(values), rel_tol=1e-6)


def short(factor: str) -> str:
    """Return a factor in a word, e.g. "freeze steps"."""
    return factor.rpartition(".")[2].replace("_", " ")


def names_of(table: StudyTable) -> dict[str, str]:
    """Return what figures call each condition: the level alone where there is one factor, else its name; with
    the number of replicas where that is not the same for all."""
    design = table.design
    names = list(table.design.conditions)
    words = names
    if len(design.factors) == 1:
        levels = design.levels(design.factors[0])
        words = [f"{level:,.6g}" if isinstance(level, float) else str(level) for level in levels]
        words = words if len(set(words)) == len(words) else names
    is_same = len(_counts(table.replicas)) == 1
    counts = ["" if is_same else f" (n={table.replicas[name]})" for name in names]
    return {name: f"{word}{count}" for name, word, count in zip(names, words, counts, strict=True)}


def colours_of(names: Sequence[str], levels: Sequence[Any]) -> dict[str, str]:
    """Return a colour for each of several lines: from dark to light where their levels are numbers."""
    if len(names) > 2 and is_numeric(levels):
        order = sorted(set(levels))
        shades = matplotlib.colormaps["viridis"]
        places = {level: 0.88 * place / (len(order) - 1) for place, level in enumerate(order)}
        return {name: to_hex(shades(places[level])) for name, level in zip(names, levels, strict=True)}
    return {name: COLOURS[place % len(COLOURS)] for place, name in enumerate(names)}


def _chosen(table: StudyTable, metrics: Sequence[str]) -> tuple[str, ...]:
    """Return the metrics whose levels are drawn."""
    return metrics_of(table, metrics) + (() if metrics else measures_of(table))


def replicas_text(replicas: Mapping[str, int]) -> str:
    """Return how many replicas conditions have, e.g. "8 replicas each", but for those that were not run."""
    counts = _counts(replicas)
    if len(counts) == 1:
        return f"{counts[0]} replica{'s' * (counts[0] != 1)} each"
    return f"{counts[0]} to {counts[-1]} replicas each (n)"


def _counts(replicas: Mapping[str, int]) -> list[int]:
    return sorted({number for number in replicas.values() if number}) or [0]


def _caption(table: StudyTable, note: str) -> str:
    return f"{replicas_text(table.replicas)}. {note}{_not_run(table)}"


def _levels_note(table: StudyTable) -> str:
    """Return what points and intervals are."""
    return f"Means of {episodes_text(table)}, then over replicas; {INTERVALS}."


def _title_of(metric: str, levels: Family) -> str:
    """Return a metric with its unit, and in how many episodes it is undefined, which are in no mean."""
    of_metric = [one for (_, number), one in levels.items() if number == metric]
    undefined = sum(one.undefined for one in of_metric)
    episodes = sum(one.episodes for one in of_metric)
    name = title(metric)
    return f"{name}, undefined in {undefined:,} of {episodes:,} episodes" if undefined else name
