"""What all figures share: size, letters and colours, where title, legend and caption stand, their files.

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
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke

from cprl.pictures.colours import agent_colour
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.terminal.tables import lines_of
from cprl.values import checked, refusal

Width = Literal["page", "column"]
SUFFIXES: Final = (".png", ".pdf", ".svg")
WIDTH_IN: Final[dict[Width, float]] = {"page": 8.0, "column": 3.3}
TEXT_PT: Final[dict[Width, float]] = {"page": 9.0, "column": 6.5}
"""The size of all text but titles; a page shows a figure of 1,200 pixels at about 800."""
DPI: Final[dict[Width, int]] = {"page": 150, "column": 300}
COLOURS: Final = 128
"""Of a PNG of lines, which looks the same with all of them and is three times as large."""
SHADES: Final = 256
"""Of a PNG with a scale of colours."""
CHARACTER: Final = 0.56
"""The width of a character in em, about."""
_LOOK: Final[dict[str, Any]] = {
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon", "text.parse_math"), False),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), "#6b6b6b"),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor", "axes.labelcolor"), "#222222"),
    **dict.fromkeys(
        ("axes.titlesize", "axes.labelsize", "legend.fontsize", "legend.title_fontsize"), "medium"
    ),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), "medium"),
    "axes.titlelocation": "left",
    "axes.axisbelow": True,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.6,
    "svg.hashsalt": "cprl",
    "pdf.fonttype": 42,
}
"""Names are no formulas, though they may have dollar signs."""

MEAN: Final = "#08519c"
REPLICA: Final = "#6baed6"
INTERVAL: Final = "#4292c6"
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
_AGENTS_OF_A_DASH: Final = 4
_EDGE: Final = "#303030"
_FAINT: Final = "#555555"


class Sheet:
    """A figure that is being drawn. Whatever has a label in a panel is in the legend below all panels."""

    def __init__(self, width: Width) -> None:
        self.width: Width = width
        self.width_em = 72 * WIDTH_IN[width] / TEXT_PT[width]
        self._layout = ConstrainedLayoutEngine()
        self.figure = Figure(layout=self._layout, dpi=DPI[width])
        self.title = ""
        """Some five words; how the figure was made is said in the caption."""
        self.caption = ""
        self.legend_title = ""
        self._high = self._wide = 0.0
        self._row_high: dict[Axes, float] = {}
        """The height of each panel's row in em."""

    def fitting(self, number: int, least: float) -> int:
        """Return how many of so many panels stand side by side, each at least so many em wide."""
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
        """Add panels in rows.

        Args:
            high: a row with its labels, in em; or each of them.
            beside: em that names of rows take in each row of panels.
            grid: of `Figure.subplots`, e.g. sharex.
        """
        rows = -(-number // columns)
        heights = [float(high)] * rows if isinstance(high, int | float) else list(high)
        self._high = sum(heights)
        self._wide = (self.width_em - beside) / columns
        grid["gridspec_kw"] = {"height_ratios": heights}
        panels = list(self.figure.subplots(rows, columns, squeeze=False, **grid).flat)
        for place, axes in enumerate(panels):
            self._row_high[axes] = heights[place // columns]
            axes.set_visible(place < number)
        return panels[:number]

    def finish(self) -> None:
        """Put title, legend and caption around the panels, as high as they are."""
        figure = self.figure
        em_in = TEXT_PT[self.width] / 72
        figure.set_size_inches(WIDTH_IN[self.width], 10)
        for axes in figure.axes:
            axes.set_title(wrapped(axes.get_title("left"), self._wide - 1))
            axes.set_xlabel(wrapped(axes.get_xlabel(), self._wide - 2))
            axes.set_ylabel(wrapped(axes.get_ylabel(), self._row_high.get(axes, self._high) - 3))
        renderer: Any = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
        title = figure.text(
            0, 1, wrapped(self.title, 0.86 * self.width_em), fontsize="large", va="top", ha="left"
        )
        drawn = wrapped(self.caption, self.width_em - 1, 0.47) if self.width == "page" else ""
        caption = figure.text(0, 0, drawn, fontsize="small", color=_FAINT, va="bottom", ha="left")
        legend = self._legend(renderer)

        def high(part: Any) -> float:
            return float(part.get_window_extent(renderer).height) / (em_in * figure.dpi)

        over = high(title) + 0.8 if self.title else 0.0
        under = high(caption) + 0.4 if drawn else 0.0
        keys = high(legend) + 0.5 if legend else 0.0
        total = over + self._high + keys + under + 0.6
        figure.set_size_inches(WIDTH_IN[self.width], total * em_in)
        left = 0.5 / self.width_em
        title.set_position((left, 1 - 0.2 / total))
        caption.set_position((left, 0.3 / total))
        if legend:
            legend.set_bbox_to_anchor((0, (under + 0.1) / total))
        inner = (0, (under + keys) / total, 1, 1 - (under + keys + over) / total)
        self._layout.set(rect=inner)
        scale = TEXT_PT[self.width] / TEXT_PT["page"]
        for line in figure.findobj(Line2D) if scale != 1 else ():
            assert isinstance(line, Line2D)
            line.set(linewidth=scale * line.get_linewidth(), markersize=scale * line.get_markersize())

    def _legend(self, renderer: Any) -> Any:
        """Return a legend of everything that has a label, each label once, in as many columns as fit."""
        entries: dict[str, Any] = {}
        for axes in self.figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                entries.setdefault(wrapped(label, self.width_em - 4), handle)
        legend = None
        for columns in range(len(entries), 0, -1):
            legend = self.figure.legend(
                list(entries.values()),
                list(entries),
                loc="lower left",
                ncols=columns,
                title=wrapped(self.legend_title, self.width_em - 4) or None,
                alignment="left",
            )
            if columns == 1 or legend.get_window_extent(renderer).width <= self.figure.bbox.width:
                break
            legend.remove()
        return legend


@contextmanager
def drawing(
    path: Path | str, *, width: Width = "page", colours: int = COLOURS, is_new: bool = False
) -> Iterator[Sheet]:
    """Draw a figure in a block of code, and write it at its end: a PNG, PDF or SVG by the name of the path.

    Args:
        width: "page", or "column" of a paper, 3.3 inches wide; then the caption stands in a file beside it,
            `NAME.caption.txt`.
        colours: of a PNG.
        is_new: whether a picture that is there is refused.
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
            text = f"{sheet.title}\n\n{sheet.caption}\n".encode("utf-8", "replace")
            write_atomically(path.with_suffix(".caption.txt"), lambda file: file.write(text))


def check_picture(path: str | Path, name: str = "path", *, is_new: bool = True) -> Path:
    """Return the path of a picture to be, checked before hours of work; its folder may be missing."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise refusal(name, str(path), f"a file whose name ends in {', '.join(SUFFIXES)}")
    if is_new:
        refuse_to_write_over(path)
    return path


def save(figure: Figure, path: Path, *, colours: int = COLOURS, title: str = "", caption: str = "") -> Path:
    """Write a picture atomically, a PNG of so few colours."""
    drawn = BytesIO()
    about: dict[str, str | None] = {"Title": title, "Description": caption}
    if path.suffix == ".pdf":
        about = {"Title": title, "Subject": caption, "CreationDate": None}
    elif path.suffix == ".svg":
        about["Date"] = None
    figure.savefig(drawn, format=path.suffix[1:], metadata=about)
    drawn = _with_colours(drawn, colours) if path.suffix == ".png" else drawn
    return write_atomically(path, lambda file: file.write(drawn.getvalue()))


def _with_colours(drawn: BytesIO, colours: int) -> BytesIO:
    """Return a PNG with so few colours, each near those that it stands for."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    few = BytesIO()
    texts = PngInfo()
    with Image.open(drawn) as picture:
        for name in ("Title", "Description"):
            texts.add_itxt(name, picture.info[name])
        chosen = picture.convert("RGB").quantize(
            colours, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
        )
        chosen.save(few, format="png", optimize=True, dpi=picture.info["dpi"], pnginfo=texts)
    return few


def wrapped(text: str, wide: float, character: float = CHARACTER) -> str:
    """Return a text in lines of so many em."""
    return lines_of(text, max(4, int(wide / character)))


def on_white(agent: int) -> dict[str, Any]:
    """Return an agent's colour for a line on white, with a dark edge, as some agents are as light as yellow.

    Agents 4 and on have dashes too, because their colours repeat.
    """
    red, green, blue = agent_colour(agent)
    edge = [Stroke(linewidth=3.2, foreground=_EDGE), Normal()]
    dashes = DASHES[agent // _AGENTS_OF_A_DASH % len(DASHES)]
    return {"color": (red / 255, green / 255, blue / 255), "path_effects": edge, "linestyle": dashes}


def draw_cell(axes: Axes, x: int, y: int, colour: Any, text: str) -> None:
    """Draw the cell about (x, y), one unit wide and high, its text black on light cells and white on dark
    ones."""
    red, green, blue, _ = to_rgba(colour)
    ink = "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else "white"
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="white"))
    axes.text(x, y, text, ha="center", va="center", color=ink)
