"""Phases as bands behind the curves with their names in a strip above, and the end of exploration."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from cprl.measuring.phases import PHASES, Phase
from cprl.measuring.published import PHASES_BEGIN
from cprl.plotting.style import MARK, SMALL_PT, WIDTH_IN

Bands = Sequence[tuple[float, float, str]]
"""First episode, last episode and name of each phase."""

UNNAMED: Final = "none of the four patterns"
COLOURS: Final = {
    "exploration": "#e4e4e4",
    "tragedy": "#f9cdbf",
    "combat": "#faecb4",
    "cultivation": "#e0d4f0",
    UNNAMED: "#ffffff",
}
"""Light enough for curves before them; the four are apart under deuteranopia too."""
STRIP_IN: Final = 0.24
"""The height of a row of a strip in inches."""
_CHARACTER_IN: Final = 0.075


def bands_of(phases: Sequence[Phase]) -> Bands:
    """Bands of phases that were found."""
    return [(phase.first, phase.last, phase.label or UNNAMED) for phase in phases]


def published_bands(episodes: float) -> Bands:
    """The study's phases of experiment 5, up to so many episodes."""
    bounds = [0.0, *(begin for begin in PHASES_BEGIN if begin < episodes), float(episodes)]
    return [(first, last, name) for (first, last), name in zip(pairwise(bounds), PHASES, strict=False)]


def draw_bands(panel: Axes, bands: Bands) -> None:
    """Draws bands behind the curves of a panel."""
    for first, last, name in bands:
        panel.axvspan(first, last, **_look(name, "#e6e6e6"), zorder=0, linewidth=0)
        panel.axvline(last, color="#999999", linewidth=0.6, zorder=0.5)


def add_keys(panel: Axes, *rows: Bands) -> None:
    """Gives a panel an entry for the legend of each phase in these bands, in the study's order."""
    names = {name for bands in rows for _, _, name in bands}
    for name in (known for known in COLOURS if known in names):
        panel.add_patch(Rectangle((0, 0), 0, 0, label=f"phase: {name}", **_look(name, "#999999")))


def _look(name: str, edge: str) -> dict[str, Any]:
    hatch = {"hatch": "///"} if name == UNNAMED else {}
    return {"facecolor": COLOURS[name], "edgecolor": edge, **hatch}


def draw_strip(panel: Axes, rows: Mapping[str, Bands]) -> None:
    """Draws rows of named blocks into a panel of its own, above that of the curves.

    A name that is wider than its block is left to the legend of the bands.
    """
    low, high = panel.get_xlim()
    for at, bands in enumerate(rows.values()):
        for first, last, name in bands:
            panel.barh(at, last - first, left=first, height=0.9, **_look(name, "#777777"))
            room_in = (last - first) / (high - low) * (WIDTH_IN - 1)
            if len(name) * _CHARACTER_IN < room_in:
                box = {"facecolor": COLOURS[name], "edgecolor": "none", "pad": 1}
                middle = (first + last) / 2
                panel.text(middle, at, name, ha="center", va="center", fontsize=SMALL_PT, bbox=box)
    panel.set(yticks=range(len(rows)), yticklabels=list(rows), ylim=(len(rows) - 0.5, -0.5))
    panel.tick_params(left=False, bottom=False, labelbottom=False, labelsize=SMALL_PT)
    panel.spines[:].set_visible(False)


def mark_exploration(panels: Sequence[Axes], episode: float | None) -> None:
    """Marks the episode in which exploration ends, None for nowhere, by a tick on every panel."""
    if episode is None:
        return
    label = f"exploration ends, episode {episode:,.0f}"
    for panel in panels:
        panel.axvline(episode, color=MARK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
        panel.plot(
            episode,
            0,
            marker="^",
            markersize=9,
            color=MARK,
            linestyle="none",
            transform=panel.get_xaxis_transform(),
            clip_on=False,
            zorder=5,
            label=label,
        )
