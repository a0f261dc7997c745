"""Figures of a study, drawn from its table alone. `figures_of` lists those that fit a study.

There are three kinds: metrics over a numeric factor (`by_factor`), conditions below each other
(`by_condition`), and metrics during the training (`courses`). Points and lines are means over replicas with
95 % intervals; faint points are single replicas; dashes are random play in the worlds of the evaluation.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import isclose, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.ticker import NullLocator

from cprl.measuring.registry import COLLECTIVE_RETURN, bounds, title
from cprl.measuring.statistics import Estimate, Family, curve_interval
from cprl.measuring.table import WINDOWS, by_replica, where
from cprl.measuring.windows import running_mean, smoothed_episodes
from cprl.pictures.readable import capitalised
from cprl.studies.tables.comparing import (
    INTERVALS,
    Comparison,
    compared_metrics,
    condition_differences,
    condition_means,
    episodes_text,
    institution_metrics_in,
    pairing_text,
    values_of,
)
from cprl.studies.tables.tidy_table import RANDOM_PART, TRAINING_PART, StudyTable
from cprl.system.waiting_room import experimental
from cprl.terminal.panels import draw_dots, draw_line
from cprl.terminal.style import (
    CHARACTER_EM,
    DASHES,
    MEAN_COLOUR,
    RANDOM_LINE_STYLE,
    Sheet,
    Width,
    drawing,
    wrapped,
)
from cprl.values import is_number, refusal
from cprl.values.array_types import Float64

_MOST_CONDITIONS: Final = 60
"""The largest number of conditions in a figure that has a row or a panel for each."""
_COLOURS: Final = ("#08519c", "#d95f02", "#1b9e77", "#7b3294", "#a50f15", "#8c6d31", "#e7298a", "#555555")
"""The colours of conditions that have names. Numeric levels get a scale from dark to light."""
_NAME_WIDTH: Final = 16
"""The largest width of a condition's name in em; longer names wrap."""
RANDOM_LABEL: Final = "random play (in the colour of its conditions where they differ)"
_LINE_HEIGHT: Final = 1.25
"""The height of a line of text in em."""


class StudyFigure(NamedTuple):
    """A figure that fits a study and can be drawn."""

    file_name: str
    description: str
    draw: Callable[[Path], Path]
    """Draws the figure into a file, and returns its path."""


def figures_of(
    table: StudyTable, *, suffix: str = ".png", metrics: Sequence[str] = ()
) -> Iterator[StudyFigure]:
    """Yield the figures that fit a study.

    Args:
        suffix: the suffix of their files: ".png", ".pdf" or ".svg".
        metrics: the metrics that are drawn; by default those that are compared.
    """
    if not table.metrics:
        return
    design = table.design
    conditions = table.finished_conditions
    for factor in design.factors:
        if is_numeric([design.conditions[name][factor] for name in conditions]):
            draw = partial(by_factor, table, factor, metrics=metrics)
            yield StudyFigure(f"by_{file_name_of(factor)}{suffix}", f"Outcome by {factor}", draw)
    if len(conditions) <= _MOST_CONDITIONS:
        levels = partial(by_condition, table, metrics=metrics)
        yield StudyFigure(f"levels{suffix}", "Outcome by condition", levels)
        draw_courses = partial(courses, table, metrics=metrics)
        yield StudyFigure(f"courses{suffix}", "The course of the training", draw_courses)
        if len(conditions) > 1 and table.replicas[design.reference]:
            differences = partial(by_condition, table, kind="differences", metrics=metrics)
            description = f"Differences from {design.reference}"
            yield StudyFigure(f"differences{suffix}", description, differences)
    yield from experimental("factor_maps.map_figures")(table, suffix=suffix, metrics=metrics)


DRAWN: Final = re.compile(r"(by_|map_|phases|levels|differences|courses).*\.(png|pdf|svg)")
"""The names of the files of these figures."""


def file_name_of(factor: str) -> str:
    """Return a factor or metric as a part of a file's name."""
    return re.sub(r"[^A-Za-z0-9]+", "_", factor.replace("*", "all")).strip("_")


# A metric by a factor

_MOST_LINES: Final = 8
_CLOSEST_TICKS: Final = 0.07
"""The smallest distance between two levels at which their names can be read, as a share of the axis."""
_LOGARITHMIC_FROM: Final = 30
"""The axis is logarithmic if the largest level is more than this many times the smallest."""


def by_factor(
    table: StudyTable,
    factor: str,
    path: Path | str,
    *,
    metrics: Sequence[str] = (),
    width: Width = "page",
) -> Path:
    """Draw metrics over a factor whose levels are numbers.

    The axis is logarithmic if the largest level is more than 30 times the smallest. If some of at most eight
    levels would be too close to each other, all stand at equal distances, and the axis says so.

    A line joins conditions that differ in this factor only. Random draws give single points, since the other
    factors vary too. Random play is left out where it differs between points at the same level.

    Args:
        factor: the path of the factor.
        path: the file to draw.
        metrics: the metrics to draw; by default those that are compared.
        width: a "page" or a "column" of a paper.

    Raises:
        ValueError: for a factor without numeric levels, or a metric that the table does not have.
    """
    design = table.design
    numeric = [name for name in design.factors if is_numeric(design.levels(name))]
    if factor not in numeric:
        allowed = ", ".join(numeric) or "none, as no factor has levels that are numbers"
        raise refusal("factor", factor, allowed)
    chosen = _drawn_metrics(table, metrics)
    means = condition_means(table, chosen)
    layout = _factor_layout(table, factor)
    with drawing(path, width=width) as sheet:
        columns = sheet.columns_that_fit(min(len(chosen), 3), 16)
        panels = sheet.panels(len(chosen), columns=columns, row_height_em=19, sharex=True)
        for axes, metric in zip(panels, chosen, strict=True):
            _draw_factor_panel(axes, table, layout, metric, means)
            bottom, top = axes.get_ylim()
            if bounds(metric)[0] == 0 and bottom < top / 2:
                axes.set_ylim(0, None)
            _scale(axes, layout.places, _replicas_by_level(table, factor), is_even=layout.is_even)
            axes.set_title(metric_title(metric, means))
        sheet.xlabel = factor_word(factor) + ", at equal distances" * layout.is_even
        sheet.title = f"{design.name}: outcome by {factor_word(factor)}"
        sheet.caption = figure_caption(table, f"{_levels_note(table)} Faint: single replicas.")
        if layout.others and list(layout.lines) == [""]:
            sheet.caption += f" Conditions differ in {', '.join(map(factor_word, layout.others))} too."
    return Path(path)


@dataclass(frozen=True)
class _FactorLayout:
    """The lines of `by_factor` and the places of conditions on its axis."""

    lines: Mapping[str, Sequence[str]]
    """The conditions of each line, by what they have in common."""
    colours: Mapping[str, str]
    """The colour of each line."""
    places: Mapping[float, float]
    """The place of each level on the axis."""
    is_even: bool
    """True if levels stand at equal distances."""
    place_of: Mapping[str, float]
    """The place of each condition on the axis."""
    others: Sequence[str]
    """The other factors."""


def _factor_layout(table: StudyTable, factor: str) -> _FactorLayout:
    """Return the layout of the panels over a factor."""
    design = table.design
    others = [name for name in design.factors if name != factor]
    lines = _lines(table, factor, others)
    shades: Sequence[Any] = range(len(lines))
    if len(others) == 1:
        shades = [design.conditions[names[0]][others[0]] for names in lines.values()]
    levels = {name: design.conditions[name][factor] for name in table.finished_conditions}
    places, is_even = axis_places(levels.values())
    return _FactorLayout(
        lines=lines,
        colours=line_colours(list(lines), shades),
        places=places,
        is_even=is_even,
        place_of={name: places[level] for name, level in levels.items()},
        others=others,
    )


def _draw_factor_panel(
    axes: Axes, table: StudyTable, layout: _FactorLayout, metric: str, means: Family
) -> None:
    """Draw a metric over a factor: a line or single points for each line of the layout, and random play."""
    values = values_of(table.windows(), metric)
    place_of = layout.place_of
    random_play = _random_play(table, metric)
    is_same = _is_same_at_each_place(random_play, place_of)
    # A single line has no colour that could tell random play of different conditions apart.
    shows_random = bool(random_play) and (is_same or len(layout.lines) > 1)
    for label, names in layout.lines.items():
        drawn = [name for name in names if (name, metric) in means]
        is_joined = table.design.is_grid and len({place_of[name] for name in names}) == len(names)
        linestyle = "-" if is_joined else "none"
        draw_dots(
            axes,
            [place_of[name] for name in drawn],
            [means[name, metric] for name in drawn],
            replicas=[list(values[name].values()) for name in drawn],
            color=layout.colours[label],
            label=label or "mean and interval",
            linestyle=linestyle,
        )
        if shows_random:
            look = {**RANDOM_LINE_STYLE, "marker": "_", "markersize": 9}
            if not is_same:
                look["color"] = layout.colours[label]
            if not is_joined:
                look["linestyle"] = linestyle
            dashes = [random_play.get(name, nan) for name in names]
            axes.plot([place_of[name] for name in names], dashes, **look)
    if shows_random:
        axes.plot([], [], label=RANDOM_LABEL, **RANDOM_LINE_STYLE)


def _is_same_at_each_place(random_play: Mapping[str, float], at: Mapping[str, float]) -> bool:
    """Return whether random play is equal in all conditions at the same level."""
    by_place: dict[float, list[float]] = {}
    for name, value in random_play.items():
        by_place.setdefault(at[name], []).append(value)
    return all(map(are_one_number, by_place.values()))


def axis_places(levels: Iterable[float]) -> tuple[dict[float, float], bool]:
    """Return the place of each level on the axis, ordered, and whether the places are at equal distances."""
    ordered = sorted(set(levels))
    at = np.log(ordered) if is_logarithmic(ordered) else np.array(ordered, np.float64)
    is_crowded = np.diff(at).min(initial=np.inf) < _CLOSEST_TICKS * np.ptp(at)
    if is_crowded and len(ordered) <= _MOST_LINES:
        return {level: float(place) for place, level in enumerate(ordered)}, True
    return {level: level for level in ordered}, False


def _replicas_by_level(table: StudyTable, factor: str) -> Counter[float]:
    counts: Counter[float] = Counter()
    for name in table.finished_conditions:
        counts[table.design.conditions[name][factor]] += table.replicas[name]
    return counts


def _scale(
    axes: Axes, places: Mapping[float, float], replicas: Mapping[float, int], *, is_even: bool
) -> None:
    """Set the scale of the axis; if there are few levels, set a tick for each.

    Ticks say the number of replicas if it is not the same for all levels.
    """
    if not is_even and is_logarithmic(list(places)):
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")  # of matplotlib's own, formulas are texts like names
        axes.xaxis.set_minor_locator(NullLocator())
    if len(places) <= _MOST_LINES:
        is_same = len(set(replicas.values())) == 1
        texts = [f"{level:g}" + ("" if is_same else f"\nn={replicas[level]}") for level in places]
        axes.set_xticks(list(places.values()), texts)


def _lines(table: StudyTable, factor: str, others: Sequence[str]) -> dict[str, list[str]]:
    """Return the lines of `by_factor`: conditions that differ in this factor only, by their other levels.

    The conditions of a line are ordered by their level.
    """
    design = table.design
    names = table.finished_conditions
    lines: dict[str, list[str]] = {}
    for name in names:  # lines are in the order of the conditions
        levels = design.conditions[name]
        common = (
            ", ".join(f"{factor_word(other)} {levels[other]}" for other in others) if design.is_grid else ""
        )
        lines.setdefault(common, []).append(name)
    if len(lines) > _MOST_LINES:
        lines = {"": names}
    level_of = {name: float(design.conditions[name][factor]) for name in names}
    return {common: sorted(names, key=lambda name: level_of[name]) for common, names in lines.items()}


def is_numeric(levels: Sequence[Any]) -> bool:
    """Return whether there are at least two different levels and all are numbers."""
    return len(set(levels)) > 1 and all(map(is_number, levels))


def is_logarithmic(levels: Sequence[float]) -> bool:
    """Return whether an axis of these levels is logarithmic."""
    return min(levels) > 0 and max(levels) > _LOGARITHMIC_FROM * min(levels)


# Conditions one below the other


_NO_WIDTH: Final = 1e-12
"""The largest width at which an axis counts as empty, as all its differences are 0."""


def by_condition(
    table: StudyTable,
    path: Path | str,
    *,
    kind: Comparison = "levels",
    metrics: Sequence[str] = (),
    width: Width = "page",
) -> Path:
    """Draw conditions below each other: means over replicas, or differences from the reference.

    Args:
        table: the table, of at most `_MOST_CONDITIONS` conditions that were run; the others are left out.
        kind: "levels", with random play as dashes; or "differences", with a dashed line at 0.
        metrics: by default those that are compared, and of levels what institutions took and found.
        width: a "page" or a "column" of a paper.

    Raises:
        ValueError: for more than 60 conditions or none, a reference without a finished run, or a metric that
            the table does not have.
    """
    design = table.design
    is_levels = kind == "levels"
    conditions = [name for name in table.finished_conditions if is_levels or name != design.reference]
    if not is_levels and not table.replicas[design.reference]:
        raise ValueError(f"the reference {design.reference} has no finished run; allowed: one that has")
    if not 0 < len(conditions) <= _MOST_CONDITIONS:
        raise refusal("table", table, f"1 to {_MOST_CONDITIONS} conditions, not {len(conditions)}")
    chosen = _drawn_metrics(table, metrics) if is_levels else compared_metrics(table, metrics)
    family = (condition_means if is_levels else condition_differences)(table, chosen)
    levels = family if is_levels else condition_means(table, chosen)
    rows = table.windows()
    with drawing(path, width=width) as sheet:
        labels = condition_labels(table)
        panels = _row_panels(sheet, [labels[name] for name in conditions], len(chosen))
        for axes, metric in zip(panels, chosen, strict=True):
            values = values_of(rows, metric) if is_levels else {}
            for place, name in enumerate(conditions):
                _draw_row(axes, place, family.get((name, metric)), values.get(name, {}))
            if is_levels:
                _draw_random_play(axes, conditions, _random_play(table, metric))
            else:
                axes.axvline(0, **RANDOM_LINE_STYLE)
                if axes.dataLim.width < _NO_WIDTH:
                    axes.set_xlim(-1, 1)
            axes.set_title(metric_title(metric, levels))
        by = factor_word(design.factors[0]) if len(design.factors) == 1 else "condition"
        sheet.title = f"{design.name}: outcome by {by}"
        note = f"{_levels_note(table)} Faint: single replicas. Dashed: random play."
        if not is_levels:
            sheet.title = f"{design.name}: difference from {' '.join(design.reference.splitlines())}"
            pairing = capitalised(pairing_text(table))
            note = f"{pairing}; means of {episodes_text(table)}; {INTERVALS}."
        sheet.caption = figure_caption(table, note)
    return Path(path)


def _row_panels(sheet: Sheet, labels: Sequence[str], number: int) -> list[Axes]:
    """Add panels with a row for each label, the first on top, as high as the labels need."""
    names = [wrapped(label, min(_NAME_WIDTH, 0.3 * sheet.width_em)) for label in labels]
    lines = [name.splitlines() for name in names]
    high = (_LINE_HEIGHT * max(map(len, lines)) + 0.8) * len(names) + 7
    beside = CHARACTER_EM * max(len(line) for name in lines for line in name)
    columns = sheet.columns_that_fit(number, 12.5)
    panels = sheet.panels(number, columns=columns, row_height_em=high, row_names_em=beside, sharey=True)
    for axes in panels:
        axes.set_yticks(range(len(names)), names)
        axes.locator_params(axis="x", nbins=3)
        axes.grid(axis="y", color="#e6e6e6", linewidth=0.6)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
    return panels


def _draw_random_play(axes: Axes, conditions: Sequence[str], random_play: Mapping[str, float]) -> None:
    """Draw a dash for random play in the rows of the conditions that have it."""
    look = {**RANDOM_LINE_STYLE, "linestyle": (0, (2, 1))}
    for place, name in enumerate(conditions):
        if name in random_play:
            axes.plot([random_play[name]] * 2, [place - 0.42, place + 0.42], **look)


def _draw_row(axes: Axes, place: int, estimate: Estimate | None, values: Mapping[int, float]) -> None:
    """Draw the value of a condition in a row, or a text that says why there is none."""
    if estimate is not None and estimate.replicas:
        draw_dots(axes, [place], [estimate], replicas=[list(values.values())], across=True)
        return
    why = "no pairs" if estimate is None else "undefined"
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
    across = axes.get_yaxis_transform()
    axes.text(0.5, place, why, bbox=box, ha="center", va="center", transform=across)


# Courses

_DEFAULT_COURSES: Final = (COLLECTIVE_RETURN, "survival_steps")
"""The metrics whose courses are drawn by default."""
_MOST_TOGETHER: Final = 6
"""The largest number of conditions in one panel. With more, each has a panel, beside the reference."""


def courses(
    table: StudyTable, path: Path | str, *, metrics: Sequence[str] = (), width: Width = "page"
) -> Path:
    """Draw metrics during the training: means over replicas, 95 % intervals, and random play.

    Up to six conditions share panels, one for each metric; more have a panel each, of the first metric, with
    the reference beside it in grey. Running means are over whole windows of the table and centred.

    Args:
        metrics: by default the collective return and survival; else the first that the table has.

    Raises:
        ValueError: for more than 60 conditions, or a metric that the table does not have.
    """
    design = table.design
    conditions = table.finished_conditions
    usual = [metric for metric in _DEFAULT_COURSES if metric in table.metrics]
    chosen = compared_metrics(table, metrics or usual)[: len(metrics) or 2]
    if len(conditions) > _MOST_CONDITIONS:
        raise ValueError(f"the table has {len(conditions)} conditions; allowed: up to {_MOST_CONDITIONS}")
    factor = design.factors[0] if len(design.factors) == 1 else None
    is_together = len(conditions) <= _MOST_TOGETHER
    contents = _course_panels(table, conditions, chosen)
    windows: set[int] = set()
    is_dashed = factor is None or not is_numeric(design.levels(factor))
    with drawing(path, width=width) as sheet:
        columns = 1 if is_together else sheet.columns_that_fit(4, 14)
        high = 21 if is_together else 15
        panels = sheet.panels(
            len(contents), columns=columns, row_height_em=high, sharex=True, sharey=not is_together
        )
        for axes, content in zip(panels, contents, strict=True):
            windows |= _draw_courses(axes, table, content.metric, content.lines, is_dashed=is_dashed)
            _draw_random_lines(axes, _random_play(table, content.metric), content.lines)
            axes.set_title(content.title)
        sheet.xlabel = "episode"
        for group in [[axes] for axes in panels] if is_together else [panels]:
            if all(axes.dataLim.y0 >= 0 for axes in group):
                group[0].set_ylim(0, None)
        sheet.legend_title = factor_word(factor) if factor is not None and is_together else ""
        sheet.title = f"{design.name}: {'course of the training' if is_together else title(chosen[0])}"
        over = " to ".join(map(str, dict.fromkeys((min(windows), max(windows)))))
        smoothed = (
            f"Centred running means over {over} episodes" if max(windows) > 1 else "Nothing is smoothed"
        )
        note = f"{smoothed}, then over replicas; bands: 95% intervals over replicas by Student's t."
        sheet.caption = figure_caption(table, note)
    return Path(path)


class _Line(NamedTuple):
    """The look of a condition's line."""

    colour: str
    label: str


class _CoursePanel(NamedTuple):
    """The content of a panel of `courses`."""

    title: str
    metric: str
    lines: dict[str, _Line]
    """The lines of the panel, by condition."""


def _course_panels(
    table: StudyTable, conditions: Sequence[str], metrics: Sequence[str]
) -> list[_CoursePanel]:
    """Return the panels of `courses`: one for each metric if there are few conditions, else one for each
    condition, with the reference beside it."""
    design = table.design
    labels = condition_labels(table)
    if len(conditions) <= _MOST_TOGETHER:
        levels: Sequence[Any] = conditions
        if len(design.factors) == 1:
            levels = [design.conditions[name][design.factors[0]] for name in conditions]
        colours = line_colours(conditions, levels)
        lines = {name: _Line(colours[name], labels[name]) for name in conditions}
        return [_CoursePanel(title(metric), metric, lines) for metric in metrics]
    reference = design.reference
    beside = {}
    if reference in conditions:
        beside[reference] = _Line("#777777", f"reference: {labels[reference]}")
    alone = _Line(MEAN_COLOUR, "the condition of the panel")
    return [
        _CoursePanel(labels[name], metrics[0], {**beside, name: alone})
        for name in conditions
        if name != reference
    ]


def _draw_random_lines(axes: Axes, random_play: Mapping[str, float], lines: Mapping[str, _Line]) -> None:
    """Draw random play of the conditions of a panel; a single line if it is the same for all."""
    values = {name: random_play[name] for name in lines if name in random_play}
    is_same = are_one_number(values.values())
    for name, value in list(values.items())[: 1 if is_same else None]:
        look = {} if is_same else {"color": lines[name].colour, "linewidth": 1.0}
        axes.axhline(value, **{**RANDOM_LINE_STYLE, **look})
    if values:
        axes.plot([], [], **RANDOM_LINE_STYLE, label=RANDOM_LABEL)


def _draw_courses(
    axes: Axes, table: StudyTable, metric: str, lines: Mapping[str, _Line], *, is_dashed: bool
) -> set[int]:
    """Draw the courses of conditions into a panel.

    Args:
        lines: the colour and the label of each condition.

    Returns:
        The numbers of episodes over which running means are taken.
    """
    windows = set()
    training = where(table.rows, part=TRAINING_PART)
    for place, (name, (colour, label)) in enumerate(lines.items()):
        rows = where(training, condition=name, metric=metric)
        if not len(rows):
            continue
        lengths = _windows_of(rows, WINDOWS)
        length = int(lengths.max())
        episodes = pc.min(by_replica(rows, metric)["episodes"]).as_py()
        is_whole = (lengths == length).all(0)  # those that all replicas have
        count = max(1, smoothed_episodes(episodes) // length)
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
    """Return a column of a condition's windows, float64 [R, W], cut to the shortest replica."""
    replicas = rows["replica"].unique().to_pylist()
    windows = [where(rows, replica=replica)[number].to_numpy() for replica in replicas]
    shortest = min(map(len, windows))
    return np.array([values[:shortest] for values in windows])


# What all of them share


def missing_note(table: StudyTable) -> str:
    """Return a sentence that counts the conditions without a finished run; "" if there are none."""
    count = len(table.design.conditions) - len(table.finished_conditions)
    return f" Not run: {count} of {len(table.design.conditions)} conditions." if count else ""


def _random_play(table: StudyTable, metric: str) -> dict[str, float]:
    """Return the mean of a metric in random play, by condition; conditions without it are left out."""
    levels = condition_means(table, [metric], part=RANDOM_PART)
    return {name: level.value for (name, _), level in levels.items() if level.replicas}


def are_one_number(values: Iterable[float]) -> bool:
    """Return whether all values are equal up to the rounding of exported tables, which are float32."""
    values = list(values)
    return not values or isclose(min(values), max(values), rel_tol=1e-6)


def factor_word(factor: str) -> str:
    """Return a short name of a factor for an axis, e.g. "freeze steps"."""
    return factor.rpartition(".")[2].replace("_", " ")


def condition_labels(table: StudyTable) -> dict[str, str]:
    """Return the label of each condition: its level if there is a single factor, otherwise its name.

    Labels say the number of replicas if it is not the same for all conditions.
    """
    design = table.design
    names = list(table.design.conditions)
    texts = names
    if len(design.factors) == 1:
        levels = design.levels(design.factors[0])
        texts = [f"{level:,.6g}" if isinstance(level, float) else str(level) for level in levels]
        texts = texts if len(set(texts)) == len(texts) else names
    is_same = len(_counts(table.replicas)) == 1
    counts = ["" if is_same else f" (n={table.replicas[name]})" for name in names]
    return {name: f"{text}{count}" for name, text, count in zip(names, texts, counts, strict=True)}


def line_colours(names: Sequence[str], levels: Sequence[Any]) -> dict[str, str]:
    """Return the colour of each line: on a scale from dark to light if the levels are numbers."""
    if len(names) > 2 and is_numeric(levels):
        order = sorted(set(levels))
        shades = matplotlib.colormaps["viridis"]
        places = {level: 0.88 * place / (len(order) - 1) for place, level in enumerate(order)}
        return {name: to_hex(shades(places[level])) for name, level in zip(names, levels, strict=True)}
    return {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(names)}


def _drawn_metrics(table: StudyTable, metrics: Sequence[str]) -> tuple[str, ...]:
    """Return the metrics to draw; by default those that are compared, and those of institutions."""
    return compared_metrics(table, metrics) + (() if metrics else institution_metrics_in(table))


def replicas_text(replicas: Mapping[str, int]) -> str:
    """Return a text for the number of replicas of the conditions that were run, e.g. "8 replicas each"."""
    counts = _counts(replicas)
    if len(counts) == 1:
        return f"{counts[0]} replica{'s' * (counts[0] != 1)} each"
    return f"{counts[0]} to {counts[-1]} replicas each (n)"


def _counts(replicas: Mapping[str, int]) -> list[int]:
    return sorted({number for number in replicas.values() if number}) or [0]


def figure_caption(table: StudyTable, note: str) -> str:
    """Return a caption: the number of replicas, the note, and how many conditions are missing."""
    return f"{replicas_text(table.replicas)}. {note}{missing_note(table)}"


def _levels_note(table: StudyTable) -> str:
    """Return the sentence of a caption that explains points and intervals."""
    return f"Means of {episodes_text(table)}, then over replicas; {INTERVALS}."


def metric_title(metric: str, levels: Family) -> str:
    """Return the title of a metric, with the number of episodes in which it is undefined, if any."""
    means = levels.column(metric).values()
    undefined = sum(mean.undefined for mean in means)
    episodes = sum(mean.episodes for mean in means)
    name = title(metric)
    return f"{name}, undefined in {undefined:,} of {episodes:,} episodes" if undefined else name
