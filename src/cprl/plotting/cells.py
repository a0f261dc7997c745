"""Cells of a matrix, each with its colour and a text."""

from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle

from cprl.plotting.style import SMALL_PT

EMPTY: Final = "#f2f2f2"
"""The colour of a cell without a number."""


def draw_cell(axes: Axes, x: int, y: int, colour: Any, text: str) -> None:
    """Draws the cell about (x, y), one unit wide and high."""
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="white"))
    axes.text(x, y, text, ha="center", va="center", fontsize=SMALL_PT, color=_ink(colour))


def _ink(colour: Any) -> str:
    """Black on light cells, white on dark ones."""
    red, green, blue, _ = to_rgba(colour)
    return "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else "white"
