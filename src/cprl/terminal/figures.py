"""Figures of a run, plotted from its table of episodes alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from cprl.measuring.episodes import Episode
from cprl.measuring.phases import UNNAMED as UNNAMED
from cprl.measuring.phases import Phase
from cprl.measuring.registry import title as metric_title
from cprl.measuring.registry import unit
from cprl.measuring.series import Values
from cprl.measuring.table import Numbers
from cprl.measuring.windows import SMOOTHED_EPISODES, centres, mean_of_worlds, rounds_of, running_mean
from cprl.runs.curves import curves_of, episode_of_turn, phases_of, worlds_of
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.terminal import style
from cprl.terminal.style import CHARACTER, MARK, Sheet, Width

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
STRIP: Final = 2.0
"""The height of a row of a strip in em."""


def bands_of(phases: Sequence[Phase]) -> Bands:
    return [(phase.first, phase.last, phase.label or UNNAMED) for phase in phases]


def draw_bands(panel: Axes, bands: Bands) -> None:
    for first, last, name in bands:
        if name != UNNAMED:  # which is white, and hatched in the strip alone
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


def draw_strip(sheet: Sheet, panel: Axes, rows: Mapping[str, Bands]) -> None:
    """Draws rows of named blocks into a panel of its own, above that of the curves.

    A name that is wider than its block is left to the legend of the bands.
    """
    low, high = panel.get_xlim()
    for at, bands in enumerate(rows.values()):
        for first, last, name in bands:
            panel.barh(at, last - first, left=first, height=0.9, **_look(name, "#777777"))
            if CHARACTER * len(name) < (last - first) / (high - low) * (sheet.width_em - 8):
                box = {"facecolor": COLOURS[name], "edgecolor": "none", "pad": 1}
                panel.text((first + last) / 2, at, name, ha="center", va="center", bbox=box)
    panel.set(yticks=range(len(rows)), yticklabels=list(rows), ylim=(len(rows) - 0.5, -0.5))
    panel.tick_params(left=False, bottom=False, labelbottom=False)
    panel.spines[:].set_visible(False)


def mark_exploration(panels: Sequence[Axes], episode: float | None) -> None:
    """Marks the episode in which exploration ends, None for nowhere, by a tick on every panel."""
    if episode is None:
        return
    label = f"exploration ends, episode {episode:,.0f}"
    for panel in panels:
        panel.axvline(episode, color=MARK, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
        on_the_axis: dict[str, Any] = {"transform": panel.get_xaxis_transform(), "clip_on": False}
        panel.plot(episode, 0, "^", markersize=9, color=MARK, zorder=5, label=label, **on_the_axis)


PARTS: Final = 20
"""A running mean takes in at most one part in so many of a training, so that short ones keep their course."""
HEIGHTS: Final = (24, 13, 12, 12)
"""Of panels, in em."""
OF_INSTITUTIONS: Final = ("institutions/violations", "institutions/fines")
"""What has a panel in games with institutions."""


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """What is plotted in one panel: [R, E], the mean of random play, and the episodes of evaluations with
    their means over replicas and episodes."""

    title: str
    unit: str
    values: Values
    worlds: Numbers
    """The world of each episode, [R, E]."""
    random: float | None
    evaluated: tuple[Values, Values] | None


def training_curve(
    run: Path,
    *,
    title: str,
    random: list[Episode] | None = None,
    exploration_turns: float | None = None,
    path: Path | None = None,
    width: Width = "page",
) -> Path:
    """Plots the collective return in each episode of a run, and survival below it.

    Every episode and replica is faint, the mean over replicas and its highest point bold. Running means are
    centred, over 100 episodes, or 1/20 of all where that is less, in which each of many worlds counts alike.
    Trainings of 1,000 to 100,000 episodes have their phases as bands behind the curves. A game without a
    harvest has one panel, the return of all its agents. Games with institutions have two more, violations and
    fines of all agents.

    Args:
        random: episodes of the random policy, whose means are dashed lines; those of evaluations while the
            agents were trained are points.
        exploration_turns: the turn of all worlds with which exploration ends, from
            `cprl.population.exploration_steps`; a tick marks its episode.
        path: of the picture, by default `figures/training_curve.png` of the run.

    Returns:
        The path.
    """
    title = title.encode("utf-8", "replace").decode()
    curves = curves_of(run)
    panels = _panels(run, curves, random or [])
    episodes = panels[0].values.shape[1]
    window = min(SMOOTHED_EPISODES, max(1, episodes // PARTS))
    ours = bands_of(phases_of(curves, centred=True) or [])
    strips = {"this run": ours} if ours else {}

    heights = [STRIP] * len(strips) + list(HEIGHTS[: len(panels)])
    levels = [f"{panel.random:,.4g} {panel.unit}".strip() for panel in panels if panel.random is not None]
    dashed = f"random play, {', '.join(levels)}"
    path = path or run / "figures" / "training_curve.png"
    with style.drawing(path, width=width) as sheet:
        every = sheet.panels(len(heights), high=heights, sharex=True)
        drawn = every[len(strips) :]
        for axes, panel in zip(drawn, panels, strict=True):
            draw_bands(axes, ours)
            _draw(axes, panel, window, dashed)
            axes.set_xlim(-0.5, max(episodes - 0.5, 1))
        add_keys(drawn[0], *strips.values())
        _mark_peak(drawn[0], panels[0], window)
        ends = None if exploration_turns is None else episode_of_turn(read_episodes(run), exploration_turns)
        mark_exploration(drawn, ends)
        for axes in every[: len(strips)]:
            draw_strip(sheet, axes, strips)
        drawn[-1].set_xlabel("episode")
        over = _over(panels[0], window)
        note = f"Running means are over {over} episodes, centred." if over > 1 else "Nothing is smoothed."
        if lanes := _lanes(panels[0]):
            note = f"{note.removesuffix('.')}, {over // lanes} of each of {lanes} worlds."
        if exploration_turns is not None and ends is None:
            note += " Exploration was not over at the last episode."
        sheet.title, sheet.caption = title, note
    return path


def _panels(run: Path, curves: dict[str, Values], random: Sequence[Episode]) -> list[_Panel]:
    """Collective return and survival, or the return of all agents of a game without a harvest; violations and
    fines of a game with institutions."""
    worlds = worlds_of(read_episodes(run))
    played: list[dict[str, float]] = [
        {"return": float(one.return_.sum()), **one.social, **one.of_institutions} for one in random
    ]
    if "collective_return" in curves:
        names = ["collective_return", "survival_steps"]
    else:
        returns = sum(curve for name, curve in curves.items() if name.startswith("return_"))
        curves, names = {**curves, "return": np.asarray(returns)}, ["return"]
    return [
        _Panel(
            title="return of all agents together" if name == "return" else metric_title(name),
            unit=unit(name),
            values=curves[name],
            worlds=worlds,
            random=fmean(metrics[name] for metrics in played) if played else None,
            evaluated=_evaluated(run, name),
        )
        for name in (*names, *(name for name in OF_INSTITUTIONS if name in curves))
    ]


def _evaluated(run: Path, name: str) -> tuple[Values, Values] | None:
    """The episodes after which agents were evaluated, counted from 0, and the means of a metric, or of the
    return of all agents; None where nothing was evaluated."""
    table = read_evaluations(run)
    if table is None or name not in table.column_names:
        return None
    trained = table["trained_episodes"].to_numpy()
    values = table[name].to_numpy().astype(np.float64)
    if name == "return":
        values = values * (table["agent"].to_numpy().max() + 1)
    at = np.unique(trained)
    return at - 1.0, np.array([np.nanmean(values[trained == episodes]) for episodes in at])


def _lanes(panel: _Panel) -> int:
    """Return the worlds of a replica; 0 for one alone."""
    lanes = len(np.unique(panel.worlds[0]))
    return lanes if lanes > 1 else 0


def _over(panel: _Panel, window: int) -> int:
    """Over how many episodes running means are: as many of each world."""
    lanes = _lanes(panel) or 1
    return rounds_of(window, lanes) * lanes


def _means(panel: _Panel, window: int) -> tuple[Values, Values]:
    """Return the episodes at the centres of running means, and these of each replica, [R, ...]."""
    if not _lanes(panel):
        return np.asarray(centres(panel.values[0], window), np.float64), running_mean(panel.values, window)
    of_replicas = zip(panel.values, panel.worlds, strict=True)
    means = np.stack([mean_of_worlds(*of_replica, window) for of_replica in of_replicas])
    is_there = ~np.isnan(means).any(0)
    at = np.arange(means.shape[1], dtype=np.float64) - (_over(panel, window) - 1) / 2
    return at[is_there], means[:, is_there]


def _draw(axes: Axes, panel: _Panel, window: int, dashed: str) -> None:
    replicas, episodes = panel.values.shape
    several = replicas > 1
    dot = "." if episodes < 3 else None  # a line needs two points
    raw = panel.values.mean(0)
    label = "each episode, mean of the replicas" if several else "each episode"
    axes.plot(raw, color=style.RAW, linewidth=0.7, marker=dot, label=label, zorder=1.5)
    at, means = _means(panel, window)
    if several:
        lines = axes.plot(at, means.T, color=style.REPLICA, linewidth=0.9, alpha=0.75, zorder=2)
        lines[0].set_label("each replica, running mean")
    label = f"mean of the {replicas} replicas, running mean" if several else "running mean"
    axes.plot(at, means.mean(0), color=style.MEAN, linewidth=2.4, marker=dot, label=label, zorder=3)
    if panel.evaluated is not None:
        axes.plot(*panel.evaluated, **style.EVALUATED, label="greedy, evaluated while trained", zorder=3.5)
    if panel.random is not None:
        axes.axhline(panel.random, **style.RANDOM_LINE, label=dashed)
    axes.set_ylabel(panel.title)
    if panel.values.min() >= 0:
        axes.set_ylim(0, None)


def _mark_peak(axes: Axes, panel: _Panel, window: int) -> None:
    """Marks the highest and the last running mean of the mean over replicas."""
    if _lanes(panel):
        at, means = _means(panel, window)
        mean = means.mean(0)
    else:
        at = centres(panel.values[0], window)
        mean = running_mean(panel.values.mean(0), window)
    top = int(mean.argmax())
    end = len(mean) - 1
    number = _over(panel, window)
    over = f"mean of {number} episodes" if number > 1 else "episode"
    marks = {"highest": (top, "o"), "last": (end, "s")}
    if top == end:
        marks = {"highest and last": (top, "o")}
    for name, (place, marker) in marks.items():
        when = f", episode {at[place]:,.0f}" if place == top else ""
        label = f"{name} {over}, {mean[place]:,.4g} {panel.unit}".rstrip() + when
        axes.plot(at[place], mean[place], marker, **style.POINT, label=label, zorder=4)
