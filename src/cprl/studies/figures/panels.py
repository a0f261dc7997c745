"""What the figures of studies share: names, colours of conditions, notes, and legends."""

from collections.abc import Iterable, Mapping, Sequence
from math import isclose
from textwrap import fill
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from cprl.measuring.statistics import Estimate
from cprl.studies.tables.comparing import Comparison
from cprl.studies.tables.sources import Design
from cprl.studies.tables.texts import metric_title
from cprl.terminal.style import CHARACTER_IN, SMALL_PT

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
