"""Draws into the panels of figures: lines with bands, dots with intervals, and matrices of cells."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike

from cprl.measuring.statistics import Estimate
from cprl.terminal.style import CHARACTER_EM, EMPTY_COLOUR, MEAN_COLOUR, Sheet, wrapped
from cprl.values.array_types import Float64

_BAND_OPACITY: Final = 0.2
_INTERVAL_STYLE: Final[dict[str, Any]] = {"linewidth": 2.3, "alpha": 0.7, "zorder": 3}
_REPLICA_STYLE: Final[dict[str, Any]] = {
    "marker": ".",
    "linestyle": "none",
    "alpha": 0.25,
    "markersize": 5,
    "zorder": 2,
}
_REPLICAS_BESIDE: Final = 0.16
"""The distance of the dots of single replicas from their mean, as a share of a row."""
_CELL_WIDE_EM: Final = 4.4
"""The smallest width of a cell that has room for its number, in em."""
_CELL_HIGH_EM: Final = 3.0
"""The height of a cell, in em."""

Pair = tuple[Any, Any]
"""The row and the column of a cell."""


def draw_line(
    axes: Axes,
    x: ArrayLike,
    curve: tuple[Float64, Float64, Float64],
    *,
    color: str = MEAN_COLOUR,
    **look: Any,
) -> None:
    """Draw the line of a mean, with its interval as a band.

    Args:
        x: [E], the positions of the points.
        curve: the mean and the low and high end of its interval, each [E], as `curve_interval` returns them.
        look: the look of the line, e.g. label and linestyle.
    """
    mean, low, high = curve
    axes.fill_between(x, low, high, color=color, alpha=_BAND_OPACITY, linewidth=0)
    axes.plot(x, mean, color=color, **{"linewidth": 2, **look})


def draw_dots(
    axes: Axes,
    places: Sequence[float],
    means: Sequence[Estimate],
    *,
    replicas: Sequence[Sequence[float]] = (),
    across: bool = False,
    color: str = MEAN_COLOUR,
    **look: Any,
) -> None:
    """Draw means as dots with their intervals.

    Args:
        places: the position of each mean on the axis of conditions.
        means: the mean of each condition.
        replicas: the values of the replicas behind each mean, which are drawn faintly.
        across: whether conditions are one below the other, with their values on the x-axis.
        look: the look of the dots, e.g. label, marker, and a linestyle that joins them.
    """

    def plot(positions: Sequence[float], values: Sequence[float], **look: Any) -> None:
        if across:
            axes.plot(values, positions, color=color, **look)
        else:
            axes.plot(positions, values, color=color, **look)

    for position, values in zip(places, replicas, strict=False):
        plot([position + _REPLICAS_BESIDE * across] * len(values), values, **_REPLICA_STYLE)
    for position, mean in zip(places, means, strict=True):
        plot([position, position], [mean.low, mean.high], **_INTERVAL_STYLE)
    default_look = {"marker": "o", "linestyle": "none", "linewidth": 1.4, "markersize": 6, "zorder": 4}
    plot(places, [mean.value for mean in means], **{**default_look, **look})


def draw_matrix(
    sheet: Sheet,
    axes: Axes,
    rows: Mapping[Any, str],
    columns: Mapping[Any, str],
    values: Mapping[Pair, float],
    texts: Mapping[Pair, str],
    *,
    is_difference: bool = True,
    share: float = 1.0,
    upward: bool = False,
) -> None:
    """Draw a matrix of numbers as coloured cells, and the colour scale beside it.

    Cells without a value are grey. Cells that are too small for their texts show only a star, if they have
    one.

    Args:
        sheet: the figure.
        axes: the panel of the figure.
        rows: the name of each row, by its key in `values` and `texts`.
        columns: the name of each column, by its key.
        values: the number that decides the colour of each cell, by the keys of its row and column.
        texts: the text of each cell.
        is_difference: whether the middle of the colour scale is 0.
        share: the panel's share of the sheet's width.
        upward: whether the first row is the lowest.
    """
    low = min(values.values(), default=0.0)
    high = max(values.values(), default=1.0)
    scale = Normalize(low, high)
    colours = "viridis"
    if is_difference:
        largest = max(-low, high) or 1.0
        scale = Normalize(-largest, largest)
        colours = "RdBu"
    shades = matplotlib.colormaps[colours]
    is_small = width_of_cells(sheet, rows, columns, share=share) < _CELL_WIDE_EM
    cells = {}
    for pair, text in texts.items():
        colour = shades(scale(values[pair])) if pair in values else EMPTY_COLOUR
        cells[pair] = colour, "*" * text.endswith("*") if is_small else text
    draw_cells(sheet, axes, rows, columns, cells, share=share, upward=upward)
    axes.figure.colorbar(ScalarMappable(scale, colours), ax=axes)


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
    """Draw a matrix of cells, each with its colour and its text; for the arguments see `draw_matrix`.

    Texts are black on light colours and white on dark ones.
    """
    names = list(columns.values())
    row_index = {key: index for index, key in enumerate(rows)}
    column_index = {key: index for index, key in enumerate(columns)}
    for (row, column), (colour, text) in cells.items():
        x = column_index[column]
        y = row_index[row]
        red, green, blue, _ = to_rgba(colour)
        ink = "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else "white"
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="white"))
        axes.text(x, y, text, ha="center", va="center", color=ink)
    cell_width_em = width_of_cells(sheet, rows, columns, share=share)
    rotation = 90
    if cell_width_em >= min(_longest(names), 6):
        rotation = 0
        names = [wrapped(name, cell_width_em) for name in names]
    axes.set_xticks(range(len(names)), names, rotation=rotation)
    axes.set_yticks(range(len(rows)), _row_names(sheet, rows, share))
    ends = (-0.5, len(rows) - 0.5) if upward else (len(rows) - 0.5, -0.5)
    axes.set(xlim=(-0.5, len(names) - 0.5), ylim=ends)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)


def width_of_cells(
    sheet: Sheet, rows: Mapping[Any, str], columns: Mapping[Any, str], *, share: float = 1.0
) -> float:
    """Return the width of a cell in a matrix, in em, when its row names have their room."""
    names_width_em = _longest(_row_names(sheet, rows, share))
    return (0.8 * share * sheet.width_em - names_width_em - 2) / len(columns)


def _row_names(sheet: Sheet, rows: Mapping[Any, str], share: float) -> list[str]:
    return [wrapped(name, 0.25 * share * sheet.width_em) for name in rows.values()]


def _longest(names: Sequence[str]) -> float:
    """Return the width of the longest line of all names, in em."""
    return CHARACTER_EM * max(len(line) for name in names for line in name.splitlines())


def matrix_height(rows: int) -> float:
    """Return the height of a panel with a matrix, in em."""
    return max(_CELL_HIGH_EM * rows, 12) + 8
