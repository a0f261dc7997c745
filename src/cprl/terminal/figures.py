"""The training curve of a run, plotted from its table of episodes alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, unit, with_unit
from cprl.measuring.table import complete, episodes
from cprl.measuring.windows import SMOOTHED_EPISODES, Values, mean_of_worlds, rounds_of
from cprl.runs.curves import as_curves, episode_of_turn, worlds_of
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.terminal import style
from cprl.terminal.style import MARK, Width

PARTS: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
HEIGHTS: Final = (24, 13, 12, 12)
"""Of panels, in em."""
OF_INSTITUTIONS: Final = ("institutions/violations", "institutions/fines")
"""What has a panel in games with institutions."""


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """A number of each episode, and its course."""

    number: str
    values: Values
    """[R, E]."""
    at: Values
    """The episodes at the centres of running means, [M]."""
    means: Values
    """These means of each replica, [R, M]."""
    random: float | None
    """The mean of random play."""
    evaluated: tuple[Values, Values] | None
    """The episodes after which agents were evaluated, counted from 0, and their means."""

    @property
    def title(self) -> str:
        return with_unit(self.number)

    def amount(self, value: float) -> str:
        return f"{value:,.4g} {'' if self.number == INCOME else unit(self.number)}".rstrip()


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
    worlds = worlds_of(table)
    lanes = len(np.unique(worlds[0]))
    length = worlds.shape[1]
    window = min(SMOOTHED_EPISODES, max(1, length // PARTS))
    over = rounds_of(window, lanes) * lanes
    panels = _panels(run, table, random, window, over)
    levels = [panel.amount(panel.random) for panel in panels if panel.random is not None]
    path = path or run / "figures" / "training_curve.png"
    with style.drawing(path, width=width) as sheet:
        drawn = sheet.panels(len(panels), high=HEIGHTS[: len(panels)], sharex=True)
        for axes, panel in zip(drawn, panels, strict=True):
            _draw(axes, panel, f"random play, {', '.join(levels)}")
            axes.set_xlim(-0.5, max(length - 0.5, 1))
        _mark_peak(drawn[0], panels[0], over)
        ends = None if exploration_turns is None else episode_of_turn(table, exploration_turns)
        mark_exploration(drawn, ends)
        drawn[-1].set_xlabel("episode")
        note = f"Running means are over {over} episodes, centred." if over > 1 else "Nothing is smoothed."
        if lanes > 1:
            note = f"{note.removesuffix('.')}, {over // lanes} of each of {lanes} worlds."
        if exploration_turns is not None and ends is None:
            note += " Exploration was not over at the last episode."
        sheet.title = title.encode("utf-8", "replace").decode()
        sheet.caption = note
    return path


def _panels(run: Path, table: pa.Table, random: pa.Table | None, window: int, over: int) -> list[_Panel]:
    """Return collective return and survival, or the income of a game without a harvest; violations and fines
    of a game with institutions."""
    curves = as_curves(table)
    worlds = worlds_of(table)
    evaluations = read_evaluations(run)
    main = (COLLECTIVE_RETURN, "survival_steps") if COLLECTIVE_RETURN in curves else (INCOME,)
    panels = []
    for number in (*main, *(name for name in OF_INSTITUTIONS if name in curves)):
        values = curves[number]
        means = np.stack([mean_of_worlds(*one, window) for one in zip(values, worlds, strict=True)])
        is_there = ~np.isnan(means).any(0)
        level = None if random is None else float(np.mean(episodes(random, number)["value"].to_numpy()))
        panels.append(
            _Panel(
                number=number,
                values=values,
                at=np.asarray(np.flatnonzero(is_there) - (over - 1) / 2, np.float64),
                means=means[:, is_there],
                random=level,
                evaluated=None if evaluations is None else _evaluated(evaluations, number),
            )
        )
    return panels


def _evaluated(evaluations: pa.Table, number: str) -> tuple[Values, Values] | None:
    """Return the episodes after which agents were evaluated, counted from 0, and the means of a number; None
    where it was not reported."""
    table = complete(evaluations)
    if number not in table.column_names:
        return None
    rows = episodes(table, number).group_by("trained_episodes").aggregate([("value", "mean")])
    rows = rows.sort_by("trained_episodes")
    return rows["trained_episodes"].to_numpy() - 1.0, rows["value_mean"].to_numpy()


def _draw(axes: Axes, panel: _Panel, dashed: str) -> None:
    replicas, length = panel.values.shape
    several = replicas > 1
    dot = "." if length < 3 else None  # a line needs two points
    raw = panel.values.mean(0)
    label = "each episode, mean of the replicas" if several else "each episode"
    axes.plot(raw, color=style.RAW, linewidth=0.7, marker=dot, label=label, zorder=1.5)
    if several:
        lines = axes.plot(panel.at, panel.means.T, color=style.REPLICA, linewidth=0.9, alpha=0.75, zorder=2)
        lines[0].set_label("each replica, running mean")
    label = f"mean of the {replicas} replicas, running mean" if several else "running mean"
    mean = panel.means.mean(0)
    axes.plot(panel.at, mean, color=style.MEAN, linewidth=2.4, marker=dot, label=label, zorder=3)
    if panel.evaluated is not None:
        axes.plot(*panel.evaluated, **style.EVALUATED, label="greedy, evaluated while trained", zorder=3.5)
    if panel.random is not None:
        axes.axhline(panel.random, **style.RANDOM_LINE, label=dashed)
    axes.set_ylabel(panel.title)
    if panel.values.min() >= 0:
        axes.set_ylim(0, None)


def _mark_peak(axes: Axes, panel: _Panel, number: int) -> None:
    """Mark the highest and the last running mean, of so many episodes, of the mean over replicas."""
    mean = panel.means.mean(0)
    top = int(mean.argmax())
    end = len(mean) - 1
    over = f"mean of {number} episodes" if number > 1 else "episode"
    marks = {"highest": (top, "o"), "last": (end, "s")}
    if top == end:
        marks = {"highest and last": (top, "o")}
    for name, (place, marker) in marks.items():
        when = f", episode {panel.at[place]:,.0f}" if place == top else ""
        label = f"{name} {over}, {panel.amount(mean[place])}{when}"
        axes.plot(panel.at[place], mean[place], marker, **style.POINT, label=label, zorder=4)


def mark_exploration(panels: Sequence[Axes], episode: float | None) -> None:
    """Mark the episode in which exploration ends, None for nowhere, by a tick on every panel."""
    if episode is None:
        return
    label = f"exploration ends, episode {episode:,.0f}"
    for panel in panels:
        panel.axvline(episode, color=MARK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
        on_the_axis: dict[str, Any] = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.plot(episode, 0, "^", markersize=9, color=MARK, zorder=5, label=label, **on_the_axis)
