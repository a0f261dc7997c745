"""How does a metric of a run look beside the published curve? A figure for each."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from claims import undefined_text
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke
from phases import PHASES, PHASES_BEGIN, UNNAMED, Phase, training_phases
from published import EXPERIMENT_5
from random_play import random_returns
from results import Result

from cprl.measuring.registry import title, unit
from cprl.measuring.statistics import curve_interval
from cprl.pictures.colours import agent_colour
from cprl.terminal import style
from cprl.terminal.figures import mark_exploration
from cprl.values.array_types import Float64

TITLES: Final = {
    "return_0": "return of the learner, apples",
    "return_1": "return of the random walker, apples",
}
"""The titles of the returns of single agents, which are drawn for experiment 4 alone."""
PANEL_EM: Final = 27
"""The height of the panel of a metric."""
STRIP_EM: Final = 2.0
"""The height of a row of a strip."""
MARGIN: Final = 0.04
"""Empty room above and below all curves, as a share of their range."""
MOST_BOLD: Final = 4
"""Replicas whose curves can be told apart; those of more are fainter."""
INTERVAL: Final = "#4292c6"
"""The colour of intervals over replicas."""
AGENTS_OF_A_DASH: Final = 4
"""The number of agents with the same line style, which have different colours."""

Bands = Sequence[tuple[float, float, str]]
"""First episode, last episode and name of each phase."""
COLOURS: Final = {
    "exploration": "#e4e4e4",
    "tragedy": "#f9cdbf",
    "combat": "#faecb4",
    "cultivation": "#e0d4f0",
    UNNAMED: "#ffffff",
}
"""Light enough for curves before them; the four are apart under deuteranopia too."""


def axis_title(metric: str) -> str:
    """Return what a figure's vertical axis shows, with its unit."""
    return TITLES.get(metric) or title(metric)


def draw_figures(results: Sequence[Result], folder: Path) -> Iterator[tuple[Result, str, Path]]:
    """Draw each published metric of each result; collective return if the study has no such run.

    Figures of the same metric have the same vertical range if their boards have the same size: they are
    compared with each other.

    Args:
        folder: where the PNGs are written.

    Yields:
        The result, the metric and the PNG.
    """
    drawn = []
    values: dict[object, list[Float64]] = {}
    for result in results:
        for metric in result.study.curves if result.study else ("collective_return",):
            key = (_board(result), metric)
            values.setdefault(key, []).append(_values(result, metric))
            drawn.append((result, metric, key))
    for result, metric, key in drawn:
        everything = np.concatenate(values[key])
        path = folder / f"{result.name}_{metric}.png"
        _draw(result, metric, (np.nanmin(everything), np.nanmax(everything)), path)
        yield result, metric, path


def _board(result: Result) -> object:
    """Return what figures that are compared share: the size of the board, else the game itself."""
    board = getattr(result.experiment.game, "map", None)
    return (board.height, board.width) if board else result.name


def _values(result: Result, metric: str) -> Float64:
    """Return all values in a figure."""
    values = [result.smoothed(metric).ravel()]
    if result.study:
        values.append(result.study.curve(metric)[1])
    random = _random(result, metric)
    return np.concatenate([*values, [] if random is None else [random]])


def _random(result: Result, metric: str) -> float | None:
    """Return the mean of random play; None if there is no evaluation."""
    if metric == "collective_return" and result.random_game is not None:
        return float(random_returns(result.random_game).mean())
    means = (result.evaluated("random") or {}).get(metric)
    if means is None or np.isnan(means).all():
        return None
    return float(np.nanmean(means))


def _draw(result: Result, metric: str, limits: tuple[float, float], path: Path) -> None:
    """Draw replicas, their mean and its interval, the published curve, random play, and phases."""
    strips: dict[str, Bands] = {}
    if result.study == EXPERIMENT_5:
        strips["published"] = published_bands(EXPERIMENT_5.episodes)
        phases = training_phases(result.curves)
        if phases:
            strips["ours"] = bands_of(phases)
    heights = [STRIP_EM * len(strips), PANEL_EM] if strips else [PANEL_EM]
    with style.drawing(path) as sheet:
        *above, axes = sheet.panels(len(heights), row_height_em=heights, sharex=True)
        for first, last, name in strips.get("ours", ()):
            if name != UNNAMED:  # which is white, and hatched in the strip alone
                axes.axvspan(first, last, **_look(name, "#e6e6e6"), zorder=0, linewidth=0)
            axes.axvline(last, color="#999999", linewidth=0.6, zorder=0.5)
        _draw_curves(axes, result.smoothed(metric), metric)
        _draw_published(axes, result, metric)
        mark_exploration([axes], result.exploration_ends)
        low, high = limits
        margin = MARGIN * ((high - low) or 1.0)
        episodes = result.curves[metric].shape[1]
        if result.study:
            episodes = max(episodes, result.study.episodes)
        axes.set(xlim=(0, episodes), ylim=(low - margin, high + margin), ylabel=axis_title(metric))
        axes.set_xlabel("episode")
        for strip in above:
            _draw_strip(sheet, strip, axes, strips)
        window = min(result.window, result.curves[metric].shape[1])
        note = f"Running means over the {window} episodes that follow"
        sheet.title = f"{result.name}: {axis_title(metric)}"
        sheet.caption = f"{result.title}. {note}{undefined_text(result.curves[metric])}."


def published_bands(episodes: float) -> Bands:
    """Return the study's phases of experiment 5, up to so many episodes."""
    bounds = [0.0, *(begin for begin in PHASES_BEGIN if begin < episodes), float(episodes)]
    return [(first, last, name) for (first, last), name in zip(pairwise(bounds), PHASES, strict=False)]


def bands_of(phases: Sequence[Phase]) -> Bands:
    """Return the phases as bands of a figure."""
    return [(phase.first, phase.last, phase.label or UNNAMED) for phase in phases]


def _look(name: str, edge: str) -> dict[str, Any]:
    hatch = {"hatch": "///"} if name == UNNAMED else {}
    return {"facecolor": COLOURS[name], "edgecolor": edge, **hatch}


def _draw_strip(sheet: style.Sheet, panel: Axes, axes: Axes, rows: Mapping[str, Bands]) -> None:
    """Draw rows of named blocks into a panel above that of the curves, whose legend has each name.

    A name that is wider than its block is left to the legend.
    """
    low, high = panel.get_xlim()
    names = set()
    for row, bands in enumerate(rows.values()):
        for first, last, name in bands:
            names.add(name)
            panel.barh(row, last - first, left=first, height=0.9, **_look(name, "#777777"))
            if style.CHARACTER_EM * len(name) < (last - first) / (high - low) * (sheet.width_em - 8):
                box = {"facecolor": COLOURS[name], "edgecolor": "none", "pad": 1}
                panel.text((first + last) / 2, row, name, ha="center", va="center", bbox=box)
    for name in filter(names.__contains__, COLOURS):
        axes.add_patch(Rectangle((0, 0), 0, 0, label=f"phase: {name}", **_look(name, "#999999")))
    panel.set(yticks=range(len(rows)), yticklabels=list(rows), ylim=(len(rows) - 0.5, -0.5))
    panel.tick_params(left=False, bottom=False, labelbottom=False)
    panel.spines[:].set_visible(False)


def on_white(agent: int) -> dict[str, Any]:
    """Return the style of an agent's line on a white background: its colour with a dark edge.

    The edge makes light colours such as yellow visible. Agents 4 and on also have dashes, because their
    colours repeat.
    """
    red, green, blue = agent_colour(agent)
    edge = [Stroke(linewidth=3.2, foreground="#303030"), Normal()]
    dashes = style.DASHES[agent // AGENTS_OF_A_DASH % len(style.DASHES)]
    return {"color": (red / 255, green / 255, blue / 255), "path_effects": edge, "linestyle": dashes}


def _draw_curves(axes: Axes, smoothed: Float64, metric: str) -> None:
    """Draw each replica, [R, E], their mean and its interval; an agent's return in the agent's colour."""
    middle, low, high = curve_interval(smoothed)
    replicas = len(smoothed)
    bold: dict[str, Any] = {"color": style.MEAN_COLOUR}
    faint = style.REPLICA_COLOUR
    wide = INTERVAL
    agent = metric.removeprefix("return_")
    if agent.isdecimal():
        bold = on_white(int(agent))
        faint = wide = style.RAW_COLOUR
    marker = "." if len(middle) < 3 else None  # a line needs two points
    label = "ours, one replica"
    if replicas > 1:
        label = f"ours, mean of {replicas} replicas"
        alpha = 0.8 if replicas <= MOST_BOLD else 0.25
        lines = axes.plot(smoothed.T, color=faint, linewidth=0.6, alpha=alpha, zorder=2)
        lines[0].set_label("ours, each replica")
        look = {"color": wide, "alpha": 0.45, "lw": 0, "zorder": 2.2}
        axes.fill_between(np.arange(len(middle)), low, high, label="ours, 95 % interval", **look)
    axes.plot(middle, linewidth=2.0, marker=marker, label=label, zorder=3, **bold)


def _draw_published(axes: Axes, result: Result, metric: str) -> None:
    """Draw the published curve and random play."""
    if result.study:
        look = {"color": style.PUBLISHED_COLOUR, "linewidth": 1.1, "zorder": 2.8}
        axes.plot(*result.study.curve(metric), label="published", **look)
    random = _random(result, metric)
    if random is not None:
        label = f"random play, ours, {random:,.4g} {unit(metric)}".strip()
        axes.axhline(random, **style.RANDOM_LINE_STYLE, label=label)
