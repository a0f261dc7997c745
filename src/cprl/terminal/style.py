"""The style of all figures: their size, fonts and colours, their title, legend and caption.

    with style.drawing("diagram.pdf", width="column") as sheet:
        left, right = sheet.panels(2, columns=sheet.columns_that_fit(2, 25), row_height_em=16)
        left.plot(means, label="mean of the replicas")
        sheet.title, sheet.caption = "Who gains", "Bars: 95 % intervals by Student's t."

Lengths are in em, the size of the text: a page is 64 em wide, a column of a paper 36.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cprl.runs.files import write_text
from cprl.terminal import picture_files
from cprl.terminal.text_tables import wrap_lines
from cprl.values import checked

Width = Literal["page", "column"]
WIDTH_IN: Final[dict[Width, float]] = {"page": 8.0, "column": 3.3}
"""The width of a figure in inches: of a whole page, or of a column of a paper."""
TEXT_PT: Final[dict[Width, float]] = {"page": 9.0, "column": 6.5}
"""The size of all text but titles, in points. (Browsers show the 1,200 pixels of a page at about 800.)"""
DPI: Final[dict[Width, int]] = {"page": 150, "column": 300}
CHARACTER_EM: Final = 0.56
"""About the width of a character, in em."""
_LOOK: Final[dict[str, Any]] = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "text.parse_math": False,
    "axes.edgecolor": "#6b6b6b",
    "xtick.color": "#6b6b6b",
    "ytick.color": "#6b6b6b",
    "axes.labelcolor": "#222222",
    "xtick.labelcolor": "#222222",
    "ytick.labelcolor": "#222222",
    "axes.titlesize": "medium",
    "axes.labelsize": "medium",
    "xtick.labelsize": "medium",
    "ytick.labelsize": "medium",
    "legend.fontsize": "medium",
    "legend.title_fontsize": "medium",
    "axes.titlelocation": "left",
    "axes.axisbelow": True,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.6,
    "svg.hashsalt": "cprl",
    "pdf.fonttype": 42,
}
"""Settings of matplotlib. Formulas are off, because users' names may have dollar signs."""
MEAN_COLOUR: Final = "#08519c"
"""The colour of means over replicas."""
REPLICA_COLOUR: Final = "#6baed6"
"""The colour of single replicas."""
RAW_COLOUR: Final = "#b5b5b5"
"""The colour of raw values, and of lines for comparison."""
PUBLISHED_COLOUR: Final = "#000000"
"""The colour of numbers of others, e.g. of a paper."""
MARK_COLOUR: Final = "#a50f15"
"""The colour of what a reader should notice."""
EMPTY_COLOUR: Final = "#f2f2f2"
"""The colour of a cell without a number."""
RANDOM_LINE_STYLE: Final[dict[str, Any]] = {
    "color": "#555555",
    "linestyle": "--",
    "linewidth": 1.4,
    "zorder": 2.5,
}
"""The line of random play."""
EVALUATED_STYLE: Final[dict[str, Any]] = {
    "color": "#d94801",
    "linewidth": 1.2,
    "marker": "D",
    "markersize": 4,
    "markerfacecolor": "white",
}
"""The line of evaluations during a training."""
POINT_STYLE: Final[dict[str, Any]] = {
    "markersize": 8,
    "markerfacecolor": "white",
    "markeredgecolor": MEAN_COLOUR,
    "markeredgewidth": 2,
    "linestyle": "none",
}
"""The marker of a point on the line of means."""
DASHES: Final[tuple[Any, ...]] = ("-", (0, (6, 2)), (0, (4, 1, 1, 1)), (0, (1, 1)))
"""The line styles that distinguish lines of the same colour."""
_PAD_IN: Final = 3 / 72
"""The default room of matplotlib's constrained layout above and below a part of a figure, in inches."""
_FAINT: Final = "#555555"
_TITLE_SHARE: Final = 0.86
"""The share of the width, in em of the text, at which the large title is wrapped."""
_SMALL_CHARACTER_EM: Final = 0.47
"""About the width of a character of the caption, in em of the text."""
_MARGIN_EM: Final = 0.5
"""The room to the left of title and caption."""


class Sheet:
    """A figure while it is drawn. The legend below all panels shows whatever has a label in a panel."""

    def __init__(self, width: Width) -> None:
        self.width: Width = width
        self.width_em = 72 * WIDTH_IN[width] / TEXT_PT[width]
        self.figure = Figure(layout="constrained", dpi=DPI[width])
        self.title = ""
        """The title, in about five words."""
        self.caption = ""
        """The small text below the figure, which says how it was made."""
        self.legend_title = ""
        self.xlabel = ""
        """The label below the lowest panel of each column."""
        self._panel_area: Any = self.figure.subfigures()
        """The panels and their legend, between title and caption."""
        self._panel_wide_em = 0.0
        self._row_heights_em: dict[Axes, float] = {}
        """The height of each panel's row."""
        self._bottom_panels: list[Axes] = []
        """The lowest panel of each column."""
        self._panels_high_em = 0.0
        """The height of all rows of panels together."""

    def columns_that_fit(self, count: int, least_em: float) -> int:
        """Return how many panels, of `count`, fit side by side if each is at least `least_em` wide."""
        return max(1, min(count, int(self.width_em / least_em)))

    def panels(
        self,
        count: int,
        *,
        columns: int = 1,
        row_height_em: float | Sequence[float],
        row_names_em: float = 0.0,
        **grid: Any,
    ) -> list[Axes]:
        """Add panels in rows and return their axes.

        Args:
            count: the number of panels.
            columns: the number of panels in a row.
            row_height_em: the height of each row with its labels, or of all rows one by one.
            row_names_em: the room that row names take to the left of the panels.
            grid: further arguments of `Figure.subplots`, e.g. sharex; gridspec_kw is made here.
        """
        rows = -(-count // columns)
        heights = [row_height_em] * rows if isinstance(row_height_em, int | float) else list(row_height_em)
        self._panels_high_em = sum(heights)
        self._panel_wide_em = (self.width_em - row_names_em) / columns
        grid["gridspec_kw"] = {"height_ratios": heights}
        panels = list(self._panel_area.subplots(rows, columns, squeeze=False, **grid).flat)
        for index, axes in enumerate(panels):
            self._row_heights_em[axes] = heights[index // columns]
            axes.set_visible(index < count)
        panels = panels[:count]
        self._bottom_panels = panels[-columns:]
        return panels

    def finish(self) -> None:
        """Add title, legend and caption, and make the figure as high as all its parts need."""
        figure = self.figure
        wide_in = WIDTH_IN[self.width]
        any_height_in = 10  # the parts are measured first; the height is set below
        figure.set_size_inches(wide_in, any_height_in)
        self._wrap_labels()
        renderer: Any = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
        parts = self._add_legend(renderer)
        left: Any = {"x": _MARGIN_EM / self.width_em, "ha": "left"}
        if self.title:
            title = wrapped(self.title, _TITLE_SHARE * self.width_em)
            parts.append(figure.suptitle(title, fontsize="large", **left))
        if self.caption and self.width == "page":
            caption = wrapped(self.caption, self.width_em - 2 * _MARGIN_EM, _SMALL_CHARACTER_EM)
            parts.append(figure.supxlabel(caption, fontsize="small", color=_FAINT, **left))
        high_in = self._panels_high_em * TEXT_PT[self.width] / 72
        for part in parts:
            high_in += part.get_window_extent(renderer).height / figure.dpi + 2 * _PAD_IN
        figure.set_size_inches(wide_in, high_in)
        self._scale_lines()

    def _wrap_labels(self) -> None:
        """Wrap the titles and the axis labels of all panels, with the label that they share."""
        if self.xlabel:
            for axes in self._bottom_panels:
                axes.tick_params(labelbottom=True)
                axes.set_xlabel(self.xlabel)
        for axes in self.figure.axes:
            row_height_em = self._row_heights_em.get(axes, self._panels_high_em)
            axes.set_title(wrapped(axes.get_title("left"), self._panel_wide_em - 1))
            axes.set_xlabel(wrapped(axes.get_xlabel(), self._panel_wide_em - 2))
            axes.set_ylabel(wrapped(axes.get_ylabel(), row_height_em - 3))

    def _scale_lines(self) -> None:
        """Make lines and markers thinner in a figure for a column, in proportion to its text."""
        scale = TEXT_PT[self.width] / TEXT_PT["page"]
        if scale == 1:
            return
        for line in self.figure.findobj(Line2D):
            assert isinstance(line, Line2D)
            line.set(linewidth=scale * line.get_linewidth(), markersize=scale * line.get_markersize())

    def _add_legend(self, renderer: Any) -> list[Any]:
        """Add a legend in as many columns as fit, with each label once.

        Return a list of the legend, which is empty if nothing has a label.
        """
        entries: dict[str, Any] = {}
        for axes in self.figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(wrapped(label, self.width_em - 4), handle)
        for columns in range(len(entries), 0, -1):
            legend = self._panel_area.legend(
                list(entries.values()),
                list(entries),
                loc="outside lower left",
                ncols=columns,
                title=wrapped(self.legend_title, self.width_em - 4) or None,
                alignment="left",
            )
            if columns == 1 or legend.get_window_extent(renderer).width <= self.figure.bbox.width:
                return [legend]
            legend.remove()
        return []


@contextmanager
def drawing(
    path: Path | str,
    *,
    width: Width = "page",
    colours: int = picture_files.PNG_COLOURS,
    refuse_existing: bool = False,
) -> Iterator[Sheet]:
    """Draw a figure within the block, and write it at the end of the block.

    Args:
        path: the file; its suffix decides whether it is a PNG, a PDF or an SVG.
        width: "page", or "column" for a column of a paper, 3.3 inches wide. The caption of a column is
            written to a text file beside the figure, `NAME.caption.txt`.
        colours: the number of colours in a PNG.
        refuse_existing: whether to refuse a path that exists.
    """
    path = picture_files.check_picture(path, refuse_existing=refuse_existing)
    checked("width", width, Width)
    look: Any = {**_LOOK, "font.size": TEXT_PT[width]}
    with matplotlib.rc_context(look):
        sheet = Sheet(width)
        yield sheet
        sheet.finish()
        path.parent.mkdir(parents=True, exist_ok=True)
        picture_files.save(sheet.figure, path, colours=colours, title=sheet.title, caption=sheet.caption)
        if width == "column":
            write_text(path.with_suffix(".caption.txt"), f"{sheet.title}\n\n{sheet.caption}\n")


def wrapped(text: str, width_em: float, character_em: float = CHARACTER_EM) -> str:
    """Break a text into lines of at most `width_em`, with characters of about `character_em`."""
    return wrap_lines(text, max(4, int(width_em / character_em)))
