"""The training curve of a run, plotted from its table of episodes alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, unit, with_unit
from cprl.measuring.table import complete, episodes
from cprl.measuring.windows import SMOOTHED_EPISODES, mean_of_worlds, rounds_of
from cprl.runs.curves import as_curves, episode_of_turn, worlds_of
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.terminal import style
from cprl.terminal.style import MARK, Width
from cprl.values.arrays import Float64

PARTS: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
HEIGHTS: Final = (24, 13, 12, 12)
"""Of panels, in em."""
OF_INSTITUTIONS: Final = ("institutions/violations", "institutions/fines")
"""What has a panel in games with institutions."""


def training_curve(
    run: Path,
    *,
    title: str,
    random: pa.Table | None = None,
    exploration_turns: float | None = None,
    path: Path | None = None,
    width: Width = "page",
) -> Path:
    """Plot the collective return in each episode of a run, and survival below it.

    Every episode and replica is faint, the mean over replicas and its highest point bold. Running means are
    centred, over 100 episodes, or 1/20 of all where that is less, in which each of many worlds counts alike.
    A game without a harvest has one panel, the income of all its agents. Games with institutions have two
    more, violations and fines of all agents.

    Args:
        random: Episodes of random play, whose means are dashed lines; those of evaluations while the agents
            were trained are points.
        exploration_turns: The turn of all worlds with which exploration ends, from
            `cprl.population.exploration_steps`; a tick marks its episode.
        path: Of the picture, by default `figures/training_curve.png` of the run.

    Returns:
        The path.
    """
    table = read_episodes(run)
    curves = as_curves(table)
    numbers = _numbers(curves)
    worlds = worlds_of(table)
    lanes = len(np.unique(worlds[0]))
    length = worlds.shape[1]
    window = min(SMOOTHED_EPISODES, max(1, length // PARTS))
    over = rounds_of(window, lanes) * lanes
    levels = {} if random is None else {name: _mean(random, name) for name in numbers}
    dashed = ", ".join(_amount(name, level) for name, level in levels.items())
    path = path or run / "figures" / "training_curve.png"
    evaluations = read_evaluations(run)
    evaluations = None if evaluations is None else complete(evaluations)
    with style.drawing(path, width=width) as sheet:
        panels = sheet.panels(len(numbers), high=HEIGHTS[: len(numbers)], sharex=True)
        for axes, name in zip(panels, numbers, strict=True):
            values = curves[name]
            means = np.stack([mean_of_worlds(*one, window) for one in zip(values, worlds, strict=True)])
            at = np.arange(length, dtype=np.float64) - (over - 1) / 2
            is_there = ~np.isnan(means).any(0)
            course = at[is_there], means[:, is_there]
            _draw(axes, values, *course)
            _draw_evaluations(axes, evaluations, name)
            if name in levels:
                axes.axhline(levels[name], **style.RANDOM_LINE, label=f"random play, {dashed}")
            if name == numbers[0]:
                _mark_peak(axes, name, *course, over)
            axes.set(xlim=(-0.5, max(length - 0.5, 1)), ylabel=with_unit(name))
            if values.min() >= 0:
                axes.set_ylim(0, None)
        ends = None if exploration_turns is None else episode_of_turn(table, exploration_turns)
        mark_exploration(panels, ends)
        panels[-1].set_xlabel("episode")
        note = f"Running means are over {over} episodes, centred." if over > 1 else "Nothing is smoothed."
        if lanes > 1:
            note = f"{note.removesuffix('.')}, {over // lanes} of each of {lanes} worlds."
        if exploration_turns is not None and ends is None:
            note += " Exploration was not over at the last episode."
        sheet.title = title.encode("utf-8", "replace").decode()
        sheet.caption = note
    return path


def _numbers(curves: Mapping[str, Float64]) -> list[str]:
    """Return what has a panel: collective return and survival, or the income of a game without a harvest;
    violations and fines of a game with institutions."""
    main = (COLLECTIVE_RETURN, "survival_steps") if COLLECTIVE_RETURN in curves else (INCOME,)
    return [*main, *(name for name in OF_INSTITUTIONS if name in curves)]


def _amount(name: str, value: float) -> str:
    return f"{value:,.4g} {'' if name == INCOME else unit(name)}".rstrip()


def _mean(table: pa.Table, name: str) -> float:
    return float(np.mean(episodes(table, name)["value"].to_numpy()))


def _draw(axes: Axes, values: Float64, at: Float64, means: Float64) -> None:
    """Draw a number of each episode, [R, E], and its running means, [R, M]."""
    replicas, length = values.shape
    dot = "." if length < 3 else None  # a line needs two points
    several = replicas > 1
    label = "each episode, mean of the replicas" if several else "each episode"
    axes.plot(values.mean(0), color=style.RAW, linewidth=0.7, marker=dot, label=label, zorder=1.5)
    if several:
        lines = axes.plot(at, means.T, color=style.REPLICA, linewidth=0.9, alpha=0.75, zorder=2)
        lines[0].set_label("each replica, running mean")
    label = f"mean of the {replicas} replicas, running mean" if several else "running mean"
    axes.plot(at, means.mean(0), color=style.MEAN, linewidth=2.4, marker=dot, label=label, zorder=3)


def _draw_evaluations(axes: Axes, evaluations: pa.Table | None, name: str) -> None:
    """Draw the means of evaluations while agents were trained, at the episodes after which they played."""
    if evaluations is None or name not in evaluations.column_names:
        return
    rows = episodes(evaluations, name).group_by("trained_episodes").aggregate([("value", "mean")])
    rows = rows.sort_by("trained_episodes")
    at = rows["trained_episodes"].to_numpy() - 1.0  # counted from 0
    label = "greedy, evaluated while trained"
    axes.plot(at, rows["value_mean"].to_numpy(), **style.EVALUATED, label=label, zorder=3.5)


def _mark_peak(axes: Axes, name: str, at: Float64, means: Float64, number: int) -> None:
    """Mark the highest and the last running mean, of so many episodes, of the mean over replicas."""
    mean = means.mean(0)
    top = int(mean.argmax())
    end = len(mean) - 1
    over = f"mean of {number} episodes" if number > 1 else "episode"
    marks = {"highest": (top, "o"), "last": (end, "s")}
    if top == end:
        marks = {"highest and last": (top, "o")}
    for which, (place, marker) in marks.items():
        when = f", episode {at[place]:,.0f}" if place == top else ""
        label = f"{which} {over}, {_amount(name, mean[place])}{when}"
        axes.plot(at[place], mean[place], marker, **style.POINT, label=label, zorder=4)


def mark_exploration(panels: Sequence[Axes], episode: float | None) -> None:
    """Mark the episode in which exploration ends, None for nowhere, by a tick on every panel."""
    if episode is None:
        return
    label = f"exploration ends, episode {episode:,.0f}"
    for panel in panels:
        panel.axvline(episode, color=MARK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
        on_the_axis: dict[str, Any] = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.plot(episode, 0, "^", markersize=9, color=MARK, zorder=5, label=label, **on_the_axis)
