"""What figures draw into their panels: lines with bands, dots with intervals, and matrices of cells."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import ArrayLike

from cprl.measuring.statistics import Estimate
from cprl.terminal.style import CHARACTER, EMPTY, MEAN, Sheet, draw_cell, wrapped
from cprl.values.arrays import Float64

_BAND: Final = 0.2
"""How opaque a band is."""
_BAR: Final[dict[str, Any]] = {"linewidth": 2.3, "alpha": 0.7, "zorder": 3}
_FAINT: Final[dict[str, Any]] = {
    "marker": ".",
    "linestyle": "none",
    "alpha": 0.25,
    "markersize": 5,
    "zorder": 2,
}
_BESIDE: Final = 0.16
"""How far single replicas stand from their mean in a row."""
_CELL: Final = (4.4, 3.0)
"""How wide and high cells are that have room for their numbers, in em."""

Pair = tuple[Any, Any]
"""The row and the column of a cell."""


def draw_line(
    axes: Axes, at: ArrayLike, curve: tuple[Float64, Float64, Float64], *, color: str = MEAN, **look: Any
) -> None:
    """Draw a line with the band of its interval.

    Args:
        at: [E], where its points stand.
        curve: mean, low and high, each [E], as `curve_interval` gives them.
        look: of the line, e.g. label and linestyle.
    """
    middle, low, high = curve
    axes.fill_between(at, low, high, color=color, alpha=_BAND, linewidth=0)
    axes.plot(at, middle, color=color, **{"linewidth": 2, **look})


def draw_dots(
    axes: Axes,
    places: Sequence[float],
    means: Sequence[Estimate],
    *,
    replicas: Sequence[Sequence[float]] = (),
    across: bool = False,
    color: str = MEAN,
    **look: Any,
) -> None:
    """Draw means at their places with their intervals.

    Args:
        places: along the axis of conditions.
        replicas: the values of single replicas behind each mean, which are faint.
        across: whether conditions stand one below the other, so that numbers are on the x-axis.
        look: of the means, e.g. label, marker, and a linestyle that joins them.
    """

    def plot(at: Sequence[float], values: Sequence[float], **look: Any) -> None:
        first, second = (values, at) if across else (at, values)
        axes.plot(first, second, color=color, **look)

    for place, values in zip(places, replicas, strict=False):
        plot([place + _BESIDE * across] * len(values), values, **_FAINT)
    for place, mean in zip(places, means, strict=True):
        plot([place, place], [mean.low, mean.high], **_BAR)
    usual = {"marker": "o", "linestyle": "none", "linewidth": 1.4, "markersize": 6, "zorder": 4}
    plot(places, [mean.value for mean in means], **{**usual, **look})


def draw_matrix(
    sheet: Sheet,
    axes: Axes,
    rows: Mapping[Any, str],
    columns: Mapping[Any, str],
    values: Mapping[Pair, float],
    texts: Mapping[Pair, str],
    *,
    colours: str = "RdBu",
    is_about_0: bool = True,
    share: float = 1.0,
    upward: bool = False,
) -> None:
    """Draw a matrix of numbers, and the scale of its colours.

    Cells without a value are grey, and those that are too small for their numbers have their star alone.

    Args:
        rows: what each row is called, by its key in `values` and `texts`.
        columns: what each column is called.
        colours: the name of a colour map of matplotlib.
        is_about_0: whether its middle is 0, as of differences.
        share: of the width of the sheet, which the panel has.
        upward: whether the first row is the lowest.
    """
    low = min(values.values(), default=0.0)
    high = max(values.values(), default=1.0)
    reach = max(-low, high) or 1.0
    scale = Normalize(-reach, reach) if is_about_0 else Normalize(low, high)
    shades = matplotlib.colormaps[colours]
    is_small = width_of_cells(sheet, rows, columns, share=share) < _CELL[0]
    cells = {}
    for pair, text in texts.items():
        colour = shades(scale(values[pair])) if pair in values else EMPTY
        cells[pair] = colour, "*" * text.endswith("*") if is_small else text
    draw_cells(sheet, axes, rows, columns, cells, share=share, upward=upward)
    sheet.figure.colorbar(ScalarMappable(scale, colours), ax=axes)


def draw_cells(
    sheet: Sheet,
    axes: Axes,
    rows: Mapping[Any, str],
    columns: Mapping[Any, str],
    cells: Mapping[Pair, tuple[Any, str]],
    *,
    share: float = 1.0,
    upward: bool = False,
) -> None:
    """Draw a matrix of cells, each of a colour and with a text; see `draw_matrix`."""
    names = list(columns.values())
    row_at = {key: place for place, key in enumerate(rows)}
    column_at = {key: place for place, key in enumerate(columns)}
    for (row, column), (colour, text) in cells.items():
        draw_cell(axes, column_at[column], row_at[row], colour, text)
    wide = width_of_cells(sheet, rows, columns, share=share)
    is_narrow = wide < min(_longest(names), 6)
    if not is_narrow:
        names = [wrapped(name, wide) for name in names]
    axes.set_xticks(range(len(names)), names, rotation=90 if is_narrow else 0)
    axes.set_yticks(range(len(rows)), _row_names(sheet, rows, share))
    ends = (-0.5, len(rows) - 0.5) if upward else (len(rows) - 0.5, -0.5)
    axes.set(xlim=(-0.5, len(names) - 0.5), ylim=ends)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def width_of_cells(
    sheet: Sheet, rows: Mapping[Any, str], columns: Mapping[Any, str], *, share: float = 1.0
) -> float:
    """Return how wide a cell of a matrix is beside the names of its rows, in em."""
    beside = _longest(_row_names(sheet, rows, share))
    return (0.8 * share * sheet.width_em - beside - 2) / len(columns)


def _row_names(sheet: Sheet, rows: Mapping[Any, str], share: float) -> list[str]:
    return [wrapped(name, 0.25 * share * sheet.width_em) for name in rows.values()]


def _longest(names: Sequence[str]) -> float:
    """Return how wide the widest line of several names is, in em."""
    return CHARACTER * max(len(line) for name in names for line in name.splitlines())


def matrix_height(rows: int) -> float:
    """Return the height of a panel with a matrix of so many rows, in em."""
    return max(_CELL[1] * rows, 12) + 8
