"""Figures of a study's table: a metric by a factor whose levels are numbers, conditions one below the other,
the course of the training, and maps of two factors. `figures_of` says which of them fit a study.

Points and lines are means over replicas with their 95 % intervals, faint points single replicas, dashes
random play in the worlds of the evaluation.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations
from math import isclose, nan
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_hex
from matplotlib.ticker import NullLocator

from cprl.measuring.registry import bounds
from cprl.measuring.statistics import Estimate, curve_interval, form_for
from cprl.measuring.windows import SMOOTHED_EPISODES, running_mean
from cprl.studies.tables.comparing import (
    INTERVALS,
    Compared,
    Comparison,
    Kind,
    Place,
    compare,
    differences_in,
    family_of,
    measures_of,
    metric_title,
    metrics_of,
)
from cprl.studies.tables.sources import DECLINE, HARVESTING, NO_BETTER, RECOVERY
from cprl.studies.tables.table import RANDOM, TRAINING, Design, StudyTable
from cprl.system.defaults import LAST
from cprl.terminal.figures import COLOURS as PHASE_COLOURS
from cprl.terminal.style import (
    CHARACTER,
    DASHES,
    EMPTY,
    MEAN,
    RANDOM_LINE,
    SHADES,
    Sheet,
    Width,
    draw_cell,
    drawing,
    wrapped,
)
from cprl.values import refusal

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
    table: StudyTable, last: int, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> Iterator[tuple[str, str, Callable[[Path], Path]]]:
    """Yield what fits a study: the name of each figure's file, what it shows, and what draws it."""
    if not table.metrics:
        return
    design, conditions = table.design, finished(table)
    for factor in design.factors:
        if is_numeric([design.conditions[name][factor] for name in conditions]):
            draw = partial(by_factor, table, factor, metrics=metrics, last=last)
            yield f"by_{_file_name(factor)}{suffix}", f"Outcome by {factor}", draw
    if len(conditions) <= MOST_CONDITIONS:
        levels = partial(by_condition, table, metrics=metrics, last=last)
        yield f"levels{suffix}", "Outcome by condition", levels
        yield f"courses{suffix}", "The course of the training", partial(courses, table, metrics=metrics)
        if len(conditions) > 1 and table.replicas[design.reference]:
            differences = partial(by_condition, table, kind="differences", metrics=metrics, last=last)
            yield f"differences{suffix}", f"Differences from {design.reference}", differences
    for pair in grids(design):
        words, what = "_".join(map(_file_name, pair)), " and ".join(pair)
        for metric in metrics_of(table, metrics)[:_MAPPED]:
            draw = partial(heat_map, table, pair, metric=metric, last=last)
            yield f"map_{words}_{_file_name(metric)}{suffix}", f"{metric_title(metric)} by {what}", draw
        if len({next(iter(counts)) for counts in table.endings.values()}) > 1:
            title = f"In which phase most replicas end, by {what}"
            yield f"phases_{words}{suffix}", title, partial(phase_diagram, table, pair)


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
    last: int = LAST,
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
    comparisons = [compare(table, metric, last=last) for metric in _chosen(table, metrics)]
    lines, others = _lines(table, factor), [name for name in design.factors if name != factor]
    only = [design.conditions[names[0]][others[0]] for names in lines.values()] if len(others) == 1 else []
    colours = colours_of(list(lines), only or range(len(lines)))
    level_of = {name: design.conditions[name][factor] for name in finished(table)}
    places, is_even = places_of(level_of.values())
    with drawing(path, width=width) as sheet:
        columns = sheet.fitting(min(len(comparisons), 3), 16)
        panels = sheet.panels(len(comparisons), columns=columns, high=19, sharex=True)
        for axes, comparison in zip(panels, comparisons, strict=True):
            _draw_levels(axes, table, comparison, lines, colours, {n: places[level_of[n]] for n in level_of})
            _scale(axes, places, _replicas_by_level(table, factor), is_even=is_even)
            axes.set_title(title_of(comparison))
        for axes in panels[-columns:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(f"{short(factor)}, at equal distances" if is_even else short(factor))
        sheet.title = f"{design.name}: outcome by {short(factor)}"
        sheet.caption = (
            f"{replicas_text(table.replicas)}. {levels_note(comparisons[0])} Faint: single replicas."
            f"{_not_run(table)}"
        )
        if others and list(lines) == [""]:
            sheet.caption += f" Conditions differ in {', '.join(map(short, others))} too."
    return Path(path)


def _draw_levels(
    axes: Axes,
    table: StudyTable,
    comparison: Comparison,
    lines: Mapping[str, Sequence[str]],
    colours: Mapping[str, str],
    places: Mapping[str, float],
) -> None:
    """Draw a metric of conditions at their places, those of a line joined, and random play."""
    chance = _chance(table, comparison.metric)
    by_place: dict[float, list[float]] = {}
    for name in chance:
        by_place.setdefault(places[name], []).append(chance[name])
    is_same = all(map(is_one, by_place.values()))
    for label, names in lines.items():
        at = [places[name] for name in names]
        style = "-" if table.design.is_grid and len(set(at)) == len(at) else "none"
        for place, name in zip(at, names, strict=True):
            compared = comparison.by_name[name]
            _draw_spread(axes, place, compared.defined, compared.estimate, colours[label])
        estimates = [comparison.by_name[name].estimate for name in names]
        means = [nan if estimate is None else estimate.value for estimate in estimates]
        look: dict[str, Any] = {"marker": "o", "linestyle": style, "linewidth": 1.4, "zorder": 4}
        axes.plot(at, means, color=colours[label], label=label or "mean and interval", **look)
        if is_same or len(lines) > 1:
            look = RANDOM_LINE if is_same else {**RANDOM_LINE, "color": colours[label]}
            look = look if style == "-" else {**look, "linestyle": "none"}
            axes.plot(at, [chance.get(name, nan) for name in names], marker="_", markersize=9, **look)
    if chance and (is_same or len(lines) > 1):
        axes.plot([], [], label=CHANCE, **RANDOM_LINE)
    bottom, top = axes.get_ylim()
    if bounds(comparison.metric)[0] == 0 and bottom < top / 2:
        axes.set_ylim(0, None)


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
    """Conditions that are equal but for a factor, in the order of its levels, by what they have in common."""
    design, names = table.design, finished(table)
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
    """Whether levels stand on an axis of numbers: at least two, all numbers."""
    return len(set(levels)) > 1 and all(
        isinstance(level, int | float) and not isinstance(level, bool) for level in levels
    )


def is_logarithmic(levels: Sequence[float]) -> bool:
    """Whether that axis is logarithmic."""
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
    last: int = LAST,
    width: Width = "page",
) -> Path:
    """Draw conditions one below the other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `MOST_CONDITIONS` conditions that were run; the others are left out.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
        metrics: by default those that are compared, and of levels what institutions took and found.
    """
    design, is_levels = table.design, kind == "levels"
    conditions = [name for name in finished(table) if is_levels or name != design.reference]
    if not is_levels and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(conditions) <= MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {MOST_CONDITIONS} conditions, not {len(conditions)}")
    chosen = _chosen(table, metrics) if is_levels else metrics_of(table, metrics)
    comparisons = [compare(table, metric, last=last) for metric in chosen]
    first = comparisons[0]
    with drawing(path, width=width) as sheet:
        names = {
            name: wrapped(word, min(_NAME, 0.3 * sheet.width_em)) for name, word in names_of(table).items()
        }
        lines = [names[name].count("\n") + 1 for name in conditions]
        row = _LINE * max(*lines, 1) + 0.8
        columns = sheet.fitting(len(comparisons), 12.5)
        high = row * len(conditions) + 7
        beside = CHARACTER * max(len(line) for name in conditions for line in names[name].splitlines())
        panels = sheet.panels(len(comparisons), columns=columns, high=high, beside=beside, sharey=True)
        for axes, comparison in zip(panels, comparisons, strict=True):
            chance = _chance(table, comparison.metric) if is_levels else {}
            for place, name in enumerate(conditions):
                _draw_row(axes, place, comparison.by_name[name], kind)
                if name in chance:
                    look = {**RANDOM_LINE, "linestyle": (0, (2, 1))}
                    axes.plot([chance[name]] * 2, [place - 0.42, place + 0.42], **look)
            if not is_levels:
                axes.axvline(0, **RANDOM_LINE)
                if axes.dataLim.width < _NO_WIDTH:
                    axes.set_xlim(-1, 1)
            axes.set_title(title_of(comparison))
            axes.set_yticks(range(len(conditions)), [names[name] for name in conditions])
            axes.locator_params(axis="x", nbins=3)
            axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        panels[0].set_ylim(len(conditions) - 0.4, -0.6)
        by = short(design.factors[0]) if len(design.factors) == 1 else "condition"
        sheet.title, note = f"{design.name}: outcome by {by}", levels_note(first)
        note += " Faint: single replicas. Dashed: random play."
        if not is_levels:
            sheet.title = f"{design.name}: difference from {' '.join(design.reference.splitlines())}"
            pairing = f"{first.pairing_text[0].upper()}{first.pairing_text[1:]}"
            note = f"{pairing}; means of {first.episodes_text}; {INTERVALS}."
        sheet.caption = f"{replicas_text(table.replicas)}. {note}{_not_run(table)}"
    return Path(path)


def _draw_row(axes: Axes, place: int, compared: Compared, kind: Kind) -> None:
    mean = compared.estimate if kind == "levels" else compared.difference
    if mean is None:
        why = "undefined" if compared.estimate is None else "no pairs"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
        middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.get_yaxis_transform()}
        axes.text(0.5, place, why, bbox=box, **middle)
        return
    _draw_spread(axes, place, compared.defined if kind == "levels" else [], mean, MEAN, across=True)
    axes.plot([mean.value], [place], "o", color=MEAN, markersize=6, zorder=4)


# Courses

_USUAL: Final = ("collective_return", "survival_steps")
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
    design, conditions = table.design, finished(table)
    usual = [metric for metric in _USUAL if metric in table.metrics]
    chosen = metrics_of(table, metrics or usual)[: len(metrics) or 2]
    if len(conditions) > MOST_CONDITIONS:
        raise ValueError(f"the table has {len(conditions)} conditions; allowed: up to {MOST_CONDITIONS}")
    names, factor = names_of(table), design.factors[0] if len(design.factors) == 1 else None
    is_together = len(conditions) <= _MOST_TOGETHER
    views: list[tuple[str, list[str], dict[str, tuple[str, str]]]]
    if is_together:
        levels = [name if factor is None else design.conditions[name][factor] for name in conditions]
        colours = colours_of(conditions, levels)
        lines = {name: (colours[name], names[name]) for name in conditions}
        views = [(metric, conditions, lines) for metric in chosen]
    else:
        reference, alone = design.reference, ("#08519c", "the condition of the panel")
        beside = {reference: ("#777777", f"reference: {names[reference]}")} if reference in conditions else {}
        others = [name for name in conditions if name != reference]
        views = [(chosen[0], [name], {**beside, name: alone}) for name in others]
    windows: set[int] = set()
    is_dashed = factor is None or not is_numeric(design.levels(factor))
    with drawing(path, width=width) as sheet:
        columns = 1 if is_together else sheet.fitting(4, 14)
        shared = {"sharex": True, "sharey": not is_together}
        panels = sheet.panels(len(views), columns=columns, high=21 if is_together else 15, **shared)
        for axes, (metric, of_panel, lines) in zip(panels, views, strict=True):
            windows |= _draw_courses(axes, table, metric, lines, is_dashed=is_dashed)
            _draw_chance(axes, table, metric, {name: lines[name][0] for name in of_panel}, is_together)
            axes.set_title(metric_title(metric) if is_together else names[of_panel[0]])
        for axes in panels[-columns:]:
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("episode")
        for group in [[axes] for axes in panels] if is_together else [panels]:
            if all(axes.dataLim.y0 >= 0 for axes in group):
                group[0].set_ylim(0, None)
        sheet.legend_title = short(factor) if factor is not None and is_together else ""
        what = "course of the training" if is_together else metric_title(chosen[0])
        sheet.title = f"{design.name}: {what}"
        over = f"{min(windows)} to {max(windows)}" if len(windows) > 1 else f"{max(windows)}"
        smoothed = (
            f"Centred running means over {over} episodes" if max(windows) > 1 else "Nothing is smoothed"
        )
        sheet.caption = (
            f"{replicas_text(table.replicas)}. {smoothed}, then over replicas; bands: 95% intervals over "
            f"replicas by Student's t.{_not_run(table)}"
        )
    return Path(path)


def _draw_chance(
    axes: Axes, table: StudyTable, metric: str, colours: Mapping[str, str], is_together: bool
) -> None:
    """Draw random play under some conditions, a line for all where it is the same."""
    chance = {name: value for name, value in _chance(table, metric).items() if name in colours}
    is_same = is_one(chance.values())
    for name, value in list(chance.items())[: 1 if is_same else None]:
        look = {} if is_same else {"color": colours[name], "linewidth": 1.0}
        axes.axhline(value, **{**RANDOM_LINE, **look})
    if chance:
        axes.plot([], [], **RANDOM_LINE, label=CHANCE if is_together else "random play under it")


def _draw_courses(
    axes: Axes, table: StudyTable, metric: str, lines: Mapping[str, tuple[str, str]], *, is_dashed: bool
) -> set[int]:
    """Draw the courses of conditions, each of a colour and with a label, and return over how many episodes
    their running means are."""
    windows = set()
    for place, (name, (colour, label)) in enumerate(lines.items()):
        grid = table.values(name, metric, TRAINING)
        if grid is None:
            continue
        lengths = grid["window_episodes"]
        length, episodes = int(lengths.max()), int(lengths.sum(1).min())
        is_whole = (lengths == length).all(0)  # those that all replicas have
        count = max(1, min(SMOOTHED_EPISODES, episodes // _PART) // length)
        middles = (grid["episode"][0, is_whole] + (length - 1) / 2).astype(np.float64)
        at = running_mean(middles, count)
        middle, low, high = curve_interval(running_mean(grid["value"][:, is_whole], count))
        axes.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
        label = " ".join(label.splitlines())
        label = f"\N{ZERO WIDTH SPACE}{label}" if label.startswith("_") else label  # matplotlib would hide it
        dash = DASHES[place % len(DASHES)] if is_dashed and len(lines) > 2 else "-"
        dot = "." if len(at) < 3 else None
        axes.plot(at, middle, color=colour, linewidth=2, linestyle=dash, marker=dot, label=label)
        windows.add(min(count, int(is_whole.sum())) * length)
    return windows or {1}


# Maps of two factors

PHASES: Final = {
    **PHASE_COLOURS,
    HARVESTING: "#c7e9c0",
    RECOVERY: "#c6dbef",
    DECLINE: "#d9c9b6",
    NO_BETTER: "#cfcfcf",
}
"""Colours of phases, light enough for text before them."""
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
    metric: str = "collective_return",
    last: int = LAST,
    width: Width = "page",
) -> Path:
    """Draw a metric over two factors: its mean with the number of replicas, and its difference.

    Levels are in the order of the conditions. Differences are from the reference; those that are not 0 by
    Holm's method for all that the table's summary tests have a star.

    Args:
        factors: two of its factors; any others are at the levels of the reference.
    """
    comparison = compare(table, metric, last=last)
    grid, elsewhere = _grid_of(table, factors)
    rows, columns = _levels_of(grid)
    tested = dict.fromkeys([*metrics_of(table), metric])
    comparisons = [compare(table, other, last=last) for other in tested]
    family = family_of(differences_in(comparisons))
    levels, differences = _numbers(comparison, grid, family.marked)
    means = [value for value, _ in levels.values()]
    reach = max((abs(value) for value, _ in differences.values()), default=1.0) or 1.0
    maps = [(levels, Normalize(min(means, default=0), max(means, default=1)), "viridis", "mean (n)")]
    if differences:
        maps.append((differences, Normalize(-reach, reach), "RdBu", "difference"))
    with drawing(path, width=width, colours=SHADES) as sheet:
        side_by_side = sheet.fitting(len(maps), 5.5 * len(columns) + 12)
        panels = sheet.panels(len(maps), columns=side_by_side, high=_CELL * len(rows) + 8)
        for axes, (numbers, scale, name, title) in zip(panels, maps, strict=True):
            shades = matplotlib.colormaps[name]
            drawn = {at: (shades(scale(value)), text) for at, (value, text) in numbers.items()}
            _draw_grid(sheet, axes, grid, factors, drawn, side_by_side)
            axes.set_title(title)
            sheet.figure.colorbar(matplotlib.cm.ScalarMappable(scale, name), ax=axes)
        sheet.title = f"{table.design.name}: {title_of(comparison)}"
        what = f"Means of {comparison.episodes_text}, then over n replicas."
        differ = f" Differences from {table.design.reference}, {comparison.pairing_text}"
        metrics = f"{len(tested)} metric{'s' * (len(tested) > 1)}"
        has_star = any((metric, name) in family.marked for name in grid.values())
        star = f"; {'*' if has_star else 'none shown to be'} not 0 by Holm's method for the {family.tests} "
        star += f"differences of {metrics} together."
        differ += star if family.tests else "."
        sheet.caption = f"{what}{differ if differences else ''}{elsewhere}{_not_run(table)}"
    return Path(path)


def phase_diagram(
    table: StudyTable, factors: tuple[str, str], path: Path | str, *, width: Width = "page"
) -> Path:
    """Draw in which phase most replicas end over two factors."""
    grid, elsewhere = _grid_of(table, factors)
    phases = {}
    with drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, high=_CELL * len(_levels_of(grid)[0]) + 6)
        wide = (sheet.width_em - 10) / len(_levels_of(grid)[1])
        for name, counts in table.endings.items():
            label, number = next(iter(counts.items()))
            phases[name] = PHASES[label], f"{wrapped(label, wide)}\n{number} of {sum(counts.values())}"
        _draw_grid(sheet, axes, grid, factors, phases)
        sheet.title = f"{table.design.name}: phases at the end"
        rules = "; ".join(table.ending_rules)
        sheet.caption = (
            f"{replicas_text(table.replicas)}. In which phase most replicas end: {rules}.{elsewhere}"
            f"{_not_run(table)}"
        )
    return Path(path)


def _grid_of(table: StudyTable, factors: tuple[str, str]) -> tuple[Grid, str]:
    """The conditions of two factors, of levels that were run, and a sentence on the others."""
    design, by_pair = table.design, grids(table.design)
    if tuple(factors) not in by_pair:
        pairs = "; ".join(map(" and ".join, by_pair))
        raise refusal("factors", factors, pairs or "none, as the conditions are no grid of two factors")
    at = design.conditions[design.reference]
    rest = [f"{short(factor)} {at[factor]}" for factor in design.factors if factor not in factors]
    grid = by_pair[factors[0], factors[1]]
    rows, columns = _levels_of(
        {levels: name for levels, name in grid.items() if table.replicas[name]} or grid
    )
    grid = {pair: name for pair, name in grid.items() if pair[0] in rows and pair[1] in columns}
    return grid, f" Elsewhere: {', '.join(rest)}." if rest else ""


def _levels_of(grid: Grid) -> tuple[Sequence[Any], Sequence[Any]]:
    rows, columns = zip(*grid, strict=True)
    return list(dict.fromkeys(rows)), list(dict.fromkeys(columns))


Numbers = dict[str, tuple[float, str]]
"""The number and the text of a cell, by condition."""


def _numbers(comparison: Comparison, grid: Grid, marked: Collection[Place]) -> tuple[Numbers, Numbers]:
    """Return the means and the differences of a map, with a star where they are marked."""
    levels = {}
    differences = {}
    for name in grid.values():
        compared = comparison.by_name[name]
        if compared.estimate is not None:
            value = compared.estimate.value
            levels[name] = value, f"{value:{form_for(value)}}\nn={len(compared.defined)}"
            if name == comparison.reference:
                differences[name] = 0.0, "reference"
        if compared.difference is not None:
            value = compared.difference.value
            star = " *" if (comparison.metric, name) in marked else ""
            differences[name] = value, f"{value:+{form_for(value)}}{star}"
    return levels, differences


def _draw_grid(
    sheet: Sheet,
    axes: Axes,
    grid: Grid,
    factors: tuple[str, str],
    drawn: Mapping[str, tuple[Any, str]],
    side_by_side: int = 1,
) -> None:
    rows, columns = _levels_of(grid)
    for (row, column), name in grid.items():
        draw_cell(axes, columns.index(column), rows.index(row), *drawn.get(name, (EMPTY, "no run")))
    wide = (sheet.width_em / side_by_side - 12) / len(columns)
    axes.set_xticks(range(len(columns)), [wrapped(_word(level), wide) for level in columns])
    axes.set_yticks(range(len(rows)), [wrapped(_word(level), 7) for level in rows])
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-0.5, len(rows) - 0.5))
    axes.set(xlabel=short(factors[1]), ylabel=short(factors[0]))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def _word(level: Any) -> str:
    text = f"{level:g}" if isinstance(level, float) else str(level)
    return text if len(text) <= _WORD_CHARACTERS else f"{text[: _WORD_CHARACTERS - 1]}…"


# What all of them share


def finished(table: StudyTable) -> list[str]:
    """Return the conditions that have a finished run; figures show no others."""
    return [name for name in table.design.conditions if table.replicas[name]]


def _not_run(table: StudyTable) -> str:
    """A sentence on the conditions that a figure leaves out."""
    count = len(table.design.conditions) - len(finished(table))
    return f" Not run: {count} of {len(table.design.conditions)} conditions." if count else ""


def _chance(table: StudyTable, metric: str) -> dict[str, float]:
    """Random play under each condition in which it was played and the metric is defined."""
    compared = compare(table, metric, part=RANDOM).by_name.items()
    return {name: level.estimate.value for name, level in compared if level.estimate is not None}


def is_one(values: Iterable[float]) -> bool:
    """Whether values are one number, but for the rounding of exported tables to float32."""
    values = list(values)
    return not values or isclose(min(values), max(values), rel_tol=1e-6)


def _draw_spread(
    axes: Axes,
    place: float,
    replicas: Iterable[float],
    mean: Estimate | None,
    colour: str,
    *,
    across: bool = False,
) -> None:
    """Draw each replica and the interval of their mean at a place: upright, or `across` as a row."""
    values = list(replicas)
    points, bounds = [place + 0.16 * across] * len(values), [] if mean is None else [mean.low, mean.high]
    dots: dict[str, Any] = {"color": colour, "alpha": 0.25, "markersize": 5, "zorder": 2}
    line: dict[str, Any] = {"color": colour, "linewidth": 2.3, "alpha": 0.7, "zorder": 3}
    axes.plot(*((values, points) if across else (points, values)), ".", **dots)
    axes.plot(*((bounds, [place] * len(bounds)) if across else ([place] * len(bounds), bounds)), **line)


def short(factor: str) -> str:
    """A factor in a word, e.g. "freeze steps"."""
    return factor.rpartition(".")[2].replace("_", " ")


def names_of(table: StudyTable) -> dict[str, str]:
    """What figures call each condition: the level alone where there is one factor, else its name; with
    the number of replicas where that is not the same for all.
    """
    design, names = table.design, list(table.design.conditions)
    words = names
    if len(design.factors) == 1:
        levels = design.levels(design.factors[0])
        words = [f"{level:,.6g}" if isinstance(level, float) else str(level) for level in levels]
        words = words if len(set(words)) == len(words) else names
    is_same = len(_counts(table.replicas)) == 1
    counts = ["" if is_same else f" (n={table.replicas[name]})" for name in names]
    return {name: f"{word}{count}" for name, word, count in zip(names, words, counts, strict=True)}


def colours_of(names: Sequence[str], levels: Sequence[Any]) -> dict[str, str]:
    """A colour for each of several lines: from dark to light where their levels are numbers."""
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


def title_of(comparison: Comparison) -> str:
    """A metric with its unit, and in how many episodes it is undefined, which are in no mean."""
    undefined = sum(compared.undefined for compared in comparison.conditions)
    episodes = sum(compared.episodes for compared in comparison.conditions)
    name = metric_title(comparison.metric)
    return f"{name}, undefined in {undefined:,} of {episodes:,} episodes" if undefined else name
