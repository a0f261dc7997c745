"""The figures of a report: a metric of a run beside the published curve."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from claims import undefined_in
from matplotlib.axes import Axes
from phases import (
    PHASES,
    PHASES_BEGIN,
    STRIP,
    Bands,
    add_keys,
    bands_of,
    draw_bands,
    draw_strip,
)
from published import PHASED_RECIPE, curve
from results import Result, Values, returns_by_chance
from verdicts import curve_prediction

from cprl.measuring.registry import title, unit
from cprl.measuring.windows import running_mean
from cprl.terminal import style
from cprl.terminal.figures import mark_exploration

TITLES: Final = {
    "return_0": "return of the learner, apples",
    "return_1": "return of the random walker, apples",
}
"""Of the returns of single agents, which are drawn for experiment 4 alone."""
HIGH: Final = 27
"""Of the panel of a metric, in em."""
MARGIN: Final = 0.04
"""Empty room above and below all curves, as a share of their range."""

MOST_BOLD: Final = 4
"""Replicas whose curves can be told apart; those of more are fainter."""

Limits = tuple[float, float]


def published_bands(episodes: float) -> Bands:
    """The study's phases of experiment 5, up to so many episodes."""
    bounds = [0.0, *(begin for begin in PHASES_BEGIN if begin < episodes), float(episodes)]
    return [(first, last, name) for (first, last), name in zip(pairwise(bounds), PHASES, strict=False)]


def axis_title(metric: str) -> str:
    """What a figure's vertical axis shows, with its unit."""
    return TITLES.get(metric) or title(metric)


def draw_figures(results: Sequence[Result], folder: Path) -> Iterator[tuple[Result, str, Path]]:
    """Draws each published metric of each result; collective return if the study has no such run.

    Figures of the same metric have the same vertical range if their boards have the same size: they are
    compared with each other.

    Args:
        results: the results.
        folder: where the PNGs are written.

    Yields:
        The result, the metric and the PNG.
    """
    limits: dict[tuple[object, str], Limits] = {}
    for result in results:
        for metric in _metrics(result):
            low, high = _extent(result, metric)
            own = _compared(result), metric
            before = limits.get(own, (low, high))
            limits[own] = min(low, before[0]), max(high, before[1])
    for result in results:
        for metric in _metrics(result):
            path = folder / f"{result.name}_{metric}.png"
            _draw(result, metric, limits[_compared(result), metric], path)
            yield result, metric, path


def _metrics(result: Result) -> list[str]:
    return list(result.study.curves) if result.study else ["collective_return"]


def _compared(result: Result) -> object:
    """Figures of results with the same key are compared: the size of the board, else the game itself."""
    board = getattr(result.experiment.game, "map", None)
    return (board.height, board.width) if board else result.name


def _extent(result: Result, metric: str) -> Limits:
    """The lowest and the highest value in a figure."""
    values = [running_mean(result.curves[metric], result.window).ravel()]
    if result.study:
        values.append(curve(result.study.curves[metric])[1])
    random = _random(result, metric)
    everything = np.concatenate([*values, [] if random is None else [random]])
    return float(np.nanmin(everything)), float(np.nanmax(everything))


def _random(result: Result, metric: str) -> float | None:
    """The mean of random play; None if there is no evaluation."""
    if metric == "collective_return" and (game := result.random_game) is not None:
        return float(returns_by_chance(game).mean())
    found = result.evaluated("random")
    if found is None or metric not in found or np.isnan(found[metric]).all():
        return None
    return float(np.nanmean(found[metric]))


def _draw(result: Result, metric: str, limits: Limits, path: Path) -> None:
    """Draws replicas, their mean and its interval, the published curve, random play, and phases."""
    strips = {}
    if result.study and result.study.recipe == PHASED_RECIPE:
        strips["published"] = published_bands(result.study.episodes)
        if result.phases:
            strips["ours"] = bands_of(result.phases)
    heights = [STRIP * len(strips)] * bool(strips) + [HIGH]
    smoothed = running_mean(result.curves[metric], result.window)
    with style.drawing(path) as sheet:
        *above, axes = sheet.panels(len(heights), high=heights, sharex=True)
        draw_bands(axes, strips.get("ours", []))
        _draw_curves(axes, smoothed, metric)
        _draw_published(axes, result, metric)
        mark_exploration([axes], result.exploration_ends)
        add_keys(axes, *strips.values())
        low, high = limits
        margin = MARGIN * ((high - low) or 1.0)
        longest = max(result.curves[metric].shape[1], result.study.episodes if result.study else 0)
        axes.set(xlim=(0, longest), ylim=(low - margin, high + margin), ylabel=axis_title(metric))
        axes.set_xlabel("episode")
        for strip in above:
            draw_strip(sheet, strip, strips)
        sheet.title = f"{result.name}: {axis_title(metric)}"
        sheet.caption = f"{result.title}. {_note(result, metric)}"


def _draw_curves(axes: Axes, smoothed: Values, metric: str) -> None:
    """Each replica, [R, E], their mean and its interval; an agent's return in the agent's colour."""
    middle, low, high = curve_prediction(smoothed, runs=None)
    replicas = len(smoothed)
    agent = metric.removeprefix("return_")
    of_agent = agent.isdecimal()
    bold = style.on_white(int(agent)) if of_agent else {"color": style.MEAN}
    faint, wide = (style.RAW, style.RAW) if of_agent else (style.REPLICA, style.INTERVAL)
    dot = "." if len(middle) < 3 else None  # a line needs two points
    if replicas > 1:
        alpha = 0.8 if replicas <= MOST_BOLD else 0.25
        lines = axes.plot(smoothed.T, color=faint, linewidth=0.6, alpha=alpha, zorder=2)
        lines[0].set_label("ours, each replica")
        at, interval = np.arange(len(middle)), "ours, 95 % interval"
        axes.fill_between(at, low, high, color=wide, alpha=0.45, lw=0, label=interval, zorder=2.2)
    label = f"ours, mean of {replicas} replicas" if replicas > 1 else "ours, one replica"
    axes.plot(middle, linewidth=2.0, marker=dot, label=label, zorder=3, **bold)


def _draw_published(axes: Axes, result: Result, metric: str) -> None:
    """The published curve and random play."""
    if result.study:
        published = curve(result.study.curves[metric])
        axes.plot(*published, color=style.PUBLISHED, linewidth=1.1, label="published", zorder=2.8)
    random = _random(result, metric)
    if random is not None:
        label = f"random play, ours, {random:,.4g} {unit(metric)}".strip()
        axes.axhline(random, **style.RANDOM_LINE, label=label)


def _note(result: Result, metric: str) -> str:
    """How the curves are smoothed, and how many episodes are in none of their means."""
    values = result.curves[metric]
    window = min(result.window, values.shape[1])
    return f"Running means over the {window} episodes that follow{undefined_in(values)}."
