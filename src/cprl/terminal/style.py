"""The style of all figures: their size, fonts and colours, their title, legend and caption, and their files.

    with style.drawing("diagram.pdf", width="column") as sheet:
        left, right = sheet.panels(2, columns=sheet.fitting(2, 25), high=16)
        left.plot(means, label="mean of the replicas")
        sheet.title, sheet.caption = "Who gains", "Bars: 95 % intervals by Student's t."

Lengths are in em, the size of the text: a page is 64 em wide, a column of a paper 36.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cprl.runs.files import refuse_to_write_over, write_atomically, write_text
from cprl.terminal.text_tables import wrap_lines
from cprl.values import checked, refusal

Width = Literal["page", "column"]
PICTURE_SUFFIXES: Final = (".png", ".pdf", ".svg")
WIDTH_IN: Final[dict[Width, float]] = {"page": 8.0, "column": 3.3}
"""The width of a figure in inches: of a whole page, or of a column of a paper."""
TEXT_PT: Final[dict[Width, float]] = {"page": 9.0, "column": 6.5}
"""The size of all text but titles, in points. (Browsers show the 1,200 pixels of a page at about 800.)"""
DPI: Final[dict[Width, int]] = {"page": 150, "column": 300}
PNG_COLOURS: Final = 128
"""The number of colours in a PNG of lines. With all colours it looks the same and is three times larger."""
PNG_SHADES: Final = 256
"""The number of colours in a PNG that shows a colour scale."""
CHARACTER: Final = 0.56
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
FIGURE_STYLE: Final = "cprl figures 2"
"""The name of this style in the metadata of every figure. Raise its number when figures change their look."""

MEAN: Final = "#08519c"
"""The colour of means over replicas; the colours below are of single replicas and raw values."""
REPLICA: Final = "#6baed6"
RAW: Final = "#b5b5b5"
RANDOM_LINE: Final[dict[str, Any]] = {"color": "#555555", "linestyle": "--", "linewidth": 1.4, "zorder": 2.5}
EVALUATED: Final[dict[str, Any]] = {
    "color": "#d94801",
    "linewidth": 1.2,
    "marker": "D",
    "markersize": 4,
    "markerfacecolor": "white",
}
POINT: Final[dict[str, Any]] = {
    "markersize": 8,
    "markerfacecolor": "white",
    "markeredgecolor": MEAN,
    "markeredgewidth": 2,
    "linestyle": "none",
}
PUBLISHED: Final = "#000000"
MARK: Final = "#a50f15"
EMPTY: Final = "#f2f2f2"
"""The colour of a cell without a number."""
DASHES: Final[tuple[Any, ...]] = ("-", (0, (6, 2)), (0, (4, 1, 1, 1)), (0, (1, 1)))
"""The line styles that distinguish lines of the same colour."""
_PAD_IN: Final = 3 / 72
"""The default room of matplotlib's constrained layout above and below a part of a figure, in inches."""
_FAINT: Final = "#555555"


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
        self._middle: Any = self.figure.subfigures()
        """The panels and their legend, between title and caption."""
        self._panel_wide_em = 0.0
        self._row_heights_em: dict[Axes, float] = {}
        """The height of each panel's row."""
        self._lowest: list[Axes] = []
        """The lowest panel of each column."""
        self._panels_high_em = 0.0
        """The height of all rows of panels together."""

    def fitting(self, number: int, least: float) -> int:
        """Return how many panels, of `number`, fit side by side if each is at least `least` em wide."""
        return max(1, min(number, int(self.width_em / least)))

    def panels(
        self,
        number: int,
        *,
        columns: int = 1,
        high: float | Sequence[float],
        beside: float = 0.0,
        **grid: Any,
    ) -> list[Axes]:
        """Add panels in rows and return their axes.

        Args:
            number: the number of panels.
            columns: the number of panels in a row.
            high: the height of each row with its labels, or of all rows one by one, in em.
            beside: the room that row names take to the left of the panels, in em.
            grid: further arguments of `Figure.subplots`, e.g. sharex.
        """
        rows = -(-number // columns)
        heights = [float(high)] * rows if isinstance(high, int | float) else list(high)
        self._panels_high_em = sum(heights)
        self._panel_wide_em = (self.width_em - beside) / columns
        grid["gridspec_kw"] = {"height_ratios": heights}
        panels = list(self._middle.subplots(rows, columns, squeeze=False, **grid).flat)
        for index, axes in enumerate(panels):
            self._row_heights_em[axes] = heights[index // columns]
            axes.set_visible(index < number)
        panels = panels[:number]
        self._lowest = panels[-columns:]
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
        left: Any = {"x": 0.5 / self.width_em, "ha": "left"}
        if self.title:
            title = wrapped(self.title, 0.86 * self.width_em)
            parts.append(figure.suptitle(title, fontsize="large", **left))
        if self.caption and self.width == "page":
            caption = wrapped(self.caption, self.width_em - 1, 0.47)
            parts.append(figure.supxlabel(caption, fontsize="small", color=_FAINT, **left))
        high_in = self._panels_high_em * TEXT_PT[self.width] / 72
        for part in parts:
            high_in += part.get_window_extent(renderer).height / figure.dpi + 2 * _PAD_IN
        figure.set_size_inches(wide_in, high_in)
        self._scale_lines()

    def _wrap_labels(self) -> None:
        """Wrap the titles and the axis labels of all panels, with the label that they share."""
        if self.xlabel:
            for axes in self._lowest:
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
            legend = self._middle.legend(
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
    path: Path | str, *, width: Width = "page", colours: int = PNG_COLOURS, is_new: bool = False
) -> Iterator[Sheet]:
    """Draw a figure within the block, and write it at the end of the block.

    Args:
        path: the file; its suffix decides whether it is a PNG, a PDF or an SVG.
        width: "page", or "column" for a column of a paper, 3.3 inches wide. The caption of a column is
            written to a text file beside the figure, `NAME.caption.txt`.
        colours: the number of colours in a PNG.
        is_new: whether to refuse a path that exists.
    """
    path = check_picture(path, is_new=is_new)
    checked("width", width, Width)
    look: Any = {**_LOOK, "font.size": TEXT_PT[width]}
    with matplotlib.rc_context(look):
        sheet = Sheet(width)
        yield sheet
        sheet.finish()
        path.parent.mkdir(parents=True, exist_ok=True)
        save(sheet.figure, path, colours=colours, title=sheet.title, caption=sheet.caption)
        if width == "column":
            write_text(path.with_suffix(".caption.txt"), f"{sheet.title}\n\n{sheet.caption}\n")


def check_picture(path: str | Path, name: str = "path", *, is_new: bool = True) -> Path:
    """Check the path of a figure before hours of work, and return it; its folder need not exist.

    Args:
        name: the name of the argument, for a refusal.
        is_new: whether to refuse a path that exists.

    Raises:
        ValueError: for another suffix than `PICTURE_SUFFIXES`.
        FileExistsError: if the path exists and `is_new`.
    """
    path = Path(path)
    if path.suffix not in PICTURE_SUFFIXES:
        raise refusal(name, str(path), f"a file whose name ends in {', '.join(PICTURE_SUFFIXES)}")
    if is_new:
        refuse_to_write_over(path)
    return path


def save(
    figure: Figure, path: Path, *, colours: int = PNG_COLOURS, title: str = "", caption: str = ""
) -> Path:
    """Write a figure completely or not at all.

    Args:
        colours: the number of colours in a PNG.
        title: the title in the file's metadata.
        caption: the description in the file's metadata.
    """
    drawn = BytesIO()
    metadata: dict[str, str | None] = {"Title": title, "Description": caption, "Software": FIGURE_STYLE}
    if path.suffix == ".pdf":
        metadata = {"Title": title, "Subject": caption, "Creator": FIGURE_STYLE, "CreationDate": None}
    elif path.suffix == ".svg":
        metadata = {"Title": title, "Description": caption, "Creator": FIGURE_STYLE, "Date": None}
    figure.savefig(drawn, format=path.suffix[1:], metadata=metadata)
    drawn = _with_colours(drawn, colours) if path.suffix == ".png" else drawn
    return write_atomically(path, lambda file: file.write(drawn.getvalue()))


def _with_colours(drawn: BytesIO, colours: int) -> BytesIO:
    """Return a PNG with fewer colours, each near those that it replaces."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    reduced = BytesIO()
    texts = PngInfo()
    with Image.open(drawn) as picture:
        for name in ("Title", "Description", "Software"):
            texts.add_itxt(name, picture.info[name])
        quantized = picture.convert("RGB").quantize(
            colours, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
        )
        quantized.save(reduced, format="png", optimize=True, dpi=picture.info["dpi"], pnginfo=texts)
    return reduced


def wrapped(text: str, wide: float, character: float = CHARACTER) -> str:
    """Break a text into lines of at most `wide` em, with characters of about `character` em."""
    return wrap_lines(text, max(4, int(wide / character)))
