"""What all figures share: sizes and colours on white, legends that lie beside the data, cells of a matrix."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from textwrap import fill
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.text import Text

from cprl.commons.colours import agent_colour
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.values import refusal

DPI: Final = 150
COLOURS: Final = 128
"""Of a PNG of lines, which looks the same with all of them and is three times as large."""
SHADES: Final = 256
"""Of a PNG with a scale of colours."""
WIDTH_IN: Final = 8.0
TITLE_CHARACTERS: Final = 84
"""The largest number of characters on a line of a title; then it wraps."""
SMALL_PT: Final = 9
"""The size of the smallest text. A page shows a figure of 1,200 pixels at about 800."""
CHARACTER_IN: Final = 0.083
"""The width of a character of small text, about."""

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
_EDGE: Final = "#303030"
AGENTS_OF_A_DASH: Final = 4
_DASHES: Final = ("-", (0, (6, 2)), (0, (4, 1, 1, 1)), (0, (1, 1)))


def new_figure(heights_in: Sequence[float], *, title: str) -> tuple[Figure, list[Axes]]:
    """An empty figure with one panel below the other, and the same episodes in all."""
    lines = fill(title, TITLE_CHARACTERS)
    height = sum(heights_in) + 1.9 + 0.2 * lines.count("\n")
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    grid = figure.add_gridspec(len(heights_in), 1, height_ratios=list(heights_in))
    panels: list[Axes] = []
    for row in range(len(heights_in)):
        panels.append(figure.add_subplot(grid[row], sharex=panels[0] if panels else None))
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    figure.suptitle(lines, fontsize=11)
    return figure, panels


def on_white(agent: int) -> dict[str, Any]:
    """An agent's colour for a line on white, with a dark edge because some agents are as light as yellow.

    Agents 4 and on have dashes too, because their colours repeat.
    """
    red, green, blue = agent_colour(agent)
    edge = [Stroke(linewidth=3.2, foreground=_EDGE), Normal()]
    dashes = _DASHES[agent // AGENTS_OF_A_DASH % len(_DASHES)]
    return {"color": (red / 255, green / 255, blue / 255), "path_effects": edge, "linestyle": dashes}


def legend_below(figure: Figure, panels: Sequence[Axes], *, note: str = "", columns: int = 2) -> Legend:
    """A legend of everything in the panels that has a label, each label once, below them all.

    Args:
        note: a sentence above the entries, e.g. how the curves are smoothed.
    """
    entries: dict[str, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return figure.legend(
        list(entries.values()),
        [fill(label, 58) for label in entries],
        loc="outside lower center",
        ncols=columns,
        fontsize=SMALL_PT,
        title=fill(note, 110) or None,
        title_fontsize=SMALL_PT,
        frameon=False,
    )


def head(figure: Figure, title: str, note: str) -> None:
    """A title, and below it what is drawn."""
    width_in = figure.get_figwidth()
    figure.suptitle(f"{wrapped(title, width_in)}\n{wrapped(note, width_in)}", fontsize=SMALL_PT + 1)


def wrapped(title: str, width_in: float) -> str:
    return fill(title, int(width_in / CHARACTER_IN))


def write_small(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Gives a panel its labels, in small text as its ticks."""
    axes.set_xlabel(x, fontsize=SMALL_PT)
    axes.set_ylabel(y, fontsize=SMALL_PT)
    axes.set_title(title, fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT)


def picture_path(path: str | Path, name: str = "path") -> Path:
    """The path of a picture to be, whose folder may be missing; a picture that is there is drawn anew."""
    path = Path(path)
    if path.suffix != ".png":
        raise refusal(name, str(path), "a file whose name ends in .png")
    return path


def check_picture(path: str | Path, name: str = "path") -> Path:
    """`picture_path` of a new picture, checked before hours of work."""
    path = picture_path(path, name)
    refuse_to_write_over(path)
    return path


def save(figure: Figure, path: Path, *, colours: int = COLOURS) -> Path:
    """Write a PNG of so few colours atomically; its folder is created if missing.

    Texts are drawn as they are: a name with two dollar signs is no formula.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    few = _with_colours(drawn, colours)
    write_atomically(path, lambda file: file.write(few.getvalue()))
    return path


def _with_colours(drawn: BytesIO, colours: int) -> BytesIO:
    """A picture as a PNG of so few colours, each near those that it stands for."""
    from PIL import Image

    few = BytesIO()
    with Image.open(drawn) as picture:
        chosen = picture.convert("RGB").quantize(
            colours, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
        )
        chosen.save(few, format="png", optimize=True, dpi=(DPI, DPI))
    return few


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
