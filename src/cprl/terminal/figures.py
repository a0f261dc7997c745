"""Draws the training curve of a run from its table of episodes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, unit, with_unit
from cprl.measuring.table import complete, episodes
from cprl.measuring.windows import episodes_per_world, mean_of_worlds, smoothed_episodes
from cprl.runs.curves import as_curves, curve_worlds, episode_of_turn
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.terminal import style
from cprl.terminal.style import MARK_COLOUR, Width
from cprl.values.array_types import Float64

_HEIGHTS_EM: Final = (24, 13, 12, 12)
"""The heights of the panels from the top, in em."""
_INSTITUTION_PANELS: Final = ("institutions/violations", "institutions/fines")
"""The metrics that have a panel in games with institutions."""


def training_curve(
    run: Path,
    *,
    title: str,
    random: pa.Table | None = None,
    exploration_turns: float | None = None,
    path: Path | None = None,
    width: Width = "page",
) -> Path:
    """Draw the collective return in each episode of a run, and below it the length of the episodes.

    Episodes and replicas have faint lines; the mean over replicas has a bold line with its highest point.
    Running means are centred and over 100 episodes, or 1/20 of all if that is less; each world counts alike.
    Evaluations during the training are points. A game without a harvest has one panel, the income of all
    agents. A game with institutions has two more panels, the violations and the fines of all agents.

    Args:
        run: the run's directory.
        title: the title of the figure.
        random: episodes of random play, whose means are dashed lines.
        exploration_turns: the turn of the training in which exploration ends, see
            `cprl.population.exploration_steps`; a mark shows its episode.
        path: the file; by default `figures/training_curve.png` in the run's directory.
        width: the width of the figure, see `cprl.terminal.style.drawing`.

    Returns:
        The path of the file.
    """
    table = read_episodes(run)
    curves = as_curves(table)
    metrics = _panel_metrics(curves)
    worlds = curve_worlds(table)
    lanes = len(np.unique(worlds[0]))
    length = worlds.shape[1]
    window = smoothed_episodes(length)
    averaged_episodes = episodes_per_world(window, lanes) * lanes
    random_means: dict[str, float] = {}
    if random is not None:
        random_means = {metric: np.mean(episodes(random, metric)["value"].to_numpy()) for metric in metrics}
    random_label = ", ".join(_amount(metric, mean) for metric, mean in random_means.items())
    path = path or run / "figures" / "training_curve.png"
    evaluations = read_evaluations(run)
    evaluations = None if evaluations is None else complete(evaluations)
    with style.drawing(path, width=width) as sheet:
        panels = sheet.panels(len(metrics), row_height_em=_HEIGHTS_EM[: len(metrics)], sharex=True)
        for axes, metric in zip(panels, metrics, strict=True):
            values = curves[metric]
            replicas = zip(values, worlds, strict=True)
            means = np.stack([mean_of_worlds(*replica, window) for replica in replicas])
            middle = np.arange(length, dtype=np.float64) - (averaged_episodes - 1) / 2
            is_defined = ~np.isnan(means).any(0)
            running = middle[is_defined], means[:, is_defined]
            _draw(axes, values, *running)
            _draw_evaluations(axes, evaluations, metric)
            if metric in random_means:
                label = f"random play, {random_label}"
                axes.axhline(random_means[metric], **style.RANDOM_LINE_STYLE, label=label)
            if metric == metrics[0]:
                _mark_peak(axes, metric, *running, averaged_episodes)
            axes.set(xlim=(-0.5, max(length - 0.5, 1)), ylabel=with_unit(metric))
            if values.min() >= 0:
                axes.set_ylim(0, None)
        sheet.xlabel = "episode"
        sheet.title = title.encode("utf-8", "replace").decode()
        sheet.caption = _caption(averaged_episodes, lanes)
        if exploration_turns is not None:
            end = episode_of_turn(table, exploration_turns)
            mark_exploration(panels, end)
            if end is None:
                sheet.caption += " Exploration was not over at the last episode."
    return path


def _caption(averaged_episodes: int, worlds: int) -> str:
    """Return the sentence that explains the running means."""
    if averaged_episodes == 1:
        return "Nothing is smoothed."
    sentence = f"Running means are over {averaged_episodes} episodes, centred"
    if worlds == 1:
        return f"{sentence}."
    return f"{sentence}, {averaged_episodes // worlds} of each of {worlds} worlds."


def _panel_metrics(curves: Mapping[str, Float64]) -> list[str]:
    """Return the metrics that have a panel, the uppermost first."""
    main = (COLLECTIVE_RETURN, "survival_steps") if COLLECTIVE_RETURN in curves else (INCOME,)
    return [*main, *(name for name in _INSTITUTION_PANELS if name in curves)]


def _amount(name: str, value: float) -> str:
    return f"{value:,.4g} {'' if name == INCOME else unit(name)}".rstrip()


def _draw(axes: Axes, values: Float64, middle: Float64, means: Float64) -> None:
    """Draw the values of a metric in each episode, and their running means.

    Args:
        values: float [R, E], for each replica and episode.
        middle: float [M], the middle of the episodes of each running mean.
        means: float [R, M].
    """
    replicas, length = values.shape
    dot = "." if length < 3 else None  # a line needs two points
    has_replicas = replicas > 1
    label = "each episode, mean of the replicas" if has_replicas else "each episode"
    axes.plot(values.mean(0), color=style.RAW_COLOUR, linewidth=0.7, marker=dot, label=label, zorder=1.5)
    if has_replicas:
        lines = axes.plot(middle, means.T, color=style.REPLICA_COLOUR, linewidth=0.9, alpha=0.75, zorder=2)
        lines[0].set_label("each replica, running mean")
    label = f"mean of the {replicas} replicas, running mean" if has_replicas else "running mean"
    axes.plot(
        middle, means.mean(0), color=style.MEAN_COLOUR, linewidth=2.4, marker=dot, label=label, zorder=3
    )


def _draw_evaluations(axes: Axes, evaluations: pa.Table | None, name: str) -> None:
    """Draw the means of evaluations during the training, each at the episode after which it was made."""
    if evaluations is None or name not in evaluations.column_names:
        return
    rows = episodes(evaluations, name).group_by("trained_episodes").aggregate([("value", "mean")])
    rows = rows.sort_by("trained_episodes")
    last_episode = rows["trained_episodes"].to_numpy() - 1.0  # episodes are counted from 0
    label = "greedy, evaluated while trained"
    axes.plot(last_episode, rows["value_mean"].to_numpy(), **style.EVALUATED_STYLE, label=label, zorder=3.5)


def _mark_peak(axes: Axes, name: str, middle: Float64, means: Float64, averaged_episodes: int) -> None:
    """Mark the highest and the last point of the running mean over replicas."""
    mean = means.mean(0)
    highest = int(mean.argmax())
    last = len(mean) - 1
    point_words = f"mean of {averaged_episodes} episodes" if averaged_episodes > 1 else "episode"
    marks = {"highest": (highest, "o"), "last": (last, "s")}
    if highest == last:
        marks = {"highest and last": (highest, "o")}
    for adjective, (point, marker) in marks.items():
        episode_words = f", episode {middle[point]:,.0f}" if point == highest else ""
        label = f"{adjective} {point_words}, {_amount(name, mean[point])}{episode_words}"
        axes.plot(middle[point], mean[point], marker, **style.POINT_STYLE, label=label, zorder=4)


def mark_exploration(panels: Sequence[Axes], episode: float | None) -> None:
    """Mark the episode in which exploration ends on every panel; mark nothing for None."""
    if episode is None:
        return
    label = f"exploration ends, episode {episode:,.0f}"
    for panel in panels:
        panel.axvline(episode, color=MARK_COLOUR, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
        at_axis: dict[str, Any] = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.plot(episode, 0, "^", markersize=9, color=MARK_COLOUR, zorder=5, label=label, **at_axis)
