"""Phases of a training of the study of 2019: change points of the social metrics, and how figures draw them.

find_phases   the phases of curves
phases_of     those of a run, of running means
draw_bands    behind curves; `draw_strip` above them

In a phase every metric follows a straight line over the episodes; the lines of adjacent phases need not meet.
The change points minimise the squared error summed over all metrics, each in units of its own standard
deviation. Dynamic programming finds the exact minimum (C. Truong et al., "Selective review of offline change
point detection methods" (2020)).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from cprl.measuring.windows import SMOOTHED_EPISODES, centres, running_mean
from cprl.terminal.style import CHARACTER, Sheet

Values = NDArray[np.float64]

PHASES: Final = ("exploration", "tragedy", "combat", "cultivation")
"""The study's names of phases, in its order."""
UNNAMED: Final = "none of the four patterns"
"""What a phase without a label is called."""
PHASES_BEGIN: Final = (450, 1500, 2400)
"""The episodes at which tragedy, combat and cultivation begin in the study's figures of experiment 5."""
METRICS: Final = ("collective_return", "equality", "survival_steps", "peacefulness")
"""The metrics that the labels of phases depend on."""
GRID: Final = 50
"""The resolution of change points in episodes; running means over 100 episodes allow no finer one."""
LONGEST: Final = 100_000
"""The largest number of episodes; the search takes time in proportion to its square. Longer trainings have
no phases."""
SHORTEST: Final = 200
"""The minimum length of a phase in episodes."""
FEWEST_EPISODES: Final = 1_000
"""Phases are found in trainings of at least so many episodes; in shorter ones they would be noise."""
EPISODES: Final = range(FEWEST_EPISODES, LONGEST + 1)
"""The numbers of episodes of trainings that have phases."""
_JUMP: Final = 5
"""Points of the grid between candidates for change points; the grid has `_JUMP` points in `GRID` episodes."""
_LEAST: Final = SHORTEST * _JUMP // GRID
"""The minimum length of a phase in points of the grid."""
CHANGE: Final = 0.25
"""The share of its range by which a metric's line must rise or fall to count as rising or falling."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """The episodes between two change points."""

    first: float
    last: float
    label: str | None
    """One of `PHASES`, or None if the phase has the pattern of none of them."""
    change: Mapping[str, float]
    """The rise of each metric's line from the beginning of the phase to its end, as a share of the metric's
    range over the whole training; negative for a fall."""


def change_points(episodes: ArrayLike, metrics: Mapping[str, ArrayLike], *, number: int = 3) -> list[float]:
    """Return the episodes at which a phase ends and the next begins, of which each `GRID`-th is a candidate.

    Args:
        episodes: The index of each episode, [E], increasing.
        metrics: float [E] or [R, E] by name; running means work well. Means over replicas ignore NaN.
        number: The number of change points.

    Raises:
        ValueError: If there are too few or too many episodes, or a metric is NaN in some episode of all
            replicas.
    """
    at = np.asarray(episodes, np.float64)
    if at[-1] - at[0] > LONGEST:
        raise ValueError(f"episodes are {at[0]:g} to {at[-1]:g}; allowed: at most {LONGEST:,} episodes")
    grid = np.arange(at[0], at[-1] + 1e-9, GRID / _JUMP)
    if (grid[-1] - grid[0]) < (number + 1) * SHORTEST:
        raise ValueError(
            f"episodes {at[0]:g} to {at[-1]:g} are too few for {number + 1} phases of at least {SHORTEST}"
        )
    on_grid = np.stack([np.interp(grid, at, _over_replicas(curve)) for curve in metrics.values()], axis=1)
    if not np.isfinite(on_grid).all():
        raise ValueError(
            "a metric is NaN in some episode of all replicas; allowed: finite means over replicas "
            "(omit the metric or fill the gap)"
        )
    spread = on_grid.std(0)
    signal = (on_grid - on_grid.mean(0)) / np.where(spread > 0, spread, 1.0)
    ends = np.array([*range(0, len(signal), _JUMP), len(signal)])
    if ends[-1] == ends[-2]:
        ends = ends[:-1]
    costs = _costs_of_lines(signal, ends)
    # best[e]: the least cost of k + 1 segments up to ends[e]; before[k][e]: where the last of them begins.
    best, before = costs[0], []
    for _ in range(number):
        totals = best[:, None] + costs
        before.append(totals.argmin(0))
        best = totals.min(0)
    place, changes = len(ends) - 1, []
    for of_last in reversed(before):
        place = of_last[place]
        changes.append(float(grid[ends[place] - 1]))
    return changes[::-1]


def find_phases(episodes: ArrayLike, metrics: Mapping[str, ArrayLike], *, number: int = 3) -> list[Phase]:
    """Return the phases between `number` change points; see `change_points` and `phases`."""
    changes = change_points(episodes, metrics, number=number) if number else []
    return phases(episodes, metrics, changes)


def phases(episodes: ArrayLike, metrics: Mapping[str, ArrayLike], changes: Sequence[float]) -> list[Phase]:
    """Return the phases between change points, labelled if they have a pattern that the study claims.

    exploration: the first phase, if the collective return rises;
    tragedy: collective return, survival and peacefulness all fall;
    combat: after a tragedy, if the collective return rises;
    cultivation: after a tragedy, if none of the four metrics rises or falls, at whatever level: a board that
    is steadily drained has this label too, so look at the level of the collective return beside it.
    A metric rises or falls if its line changes by more than `CHANGE` of the metric's range.

    Args:
        episodes: The index of each episode, [E], increasing.
        metrics: float [E] or [R, E] by name; at least `METRICS`.

    Raises:
        ValueError: If a phase has fewer than two episodes.
    """
    at = np.asarray(episodes, np.float64)
    means = {name: _over_replicas(metrics[name]) for name in METRICS}
    bounds = [at[0], *changes, at[-1]]
    divided: list[Phase] = []
    for first, last in pairwise(bounds):
        inside = (at >= first) & (at <= last)
        if inside.sum() < 2:
            raise ValueError(
                f"the phase from episode {first:g} to {last:g} has {inside.sum()} episodes; allowed: at "
                "least 2"
            )
        change = {
            name: float(
                np.polyfit(at[inside], curve[inside], 1)[0] * (last - first) / max(np.ptp(curve), 1e-12)
            )
            for name, curve in means.items()
        }
        label = _label(change, [phase.label for phase in divided])
        divided.append(Phase(first=float(first), last=float(last), label=label, change=change))
    return divided


def _label(change: Mapping[str, float], before: Sequence[str | None]) -> str | None:
    rises = change["collective_return"] > CHANGE
    if not before:
        return "exploration" if rises else None
    if all(change[name] < -CHANGE for name in ("collective_return", "survival_steps", "peacefulness")):
        return "tragedy"
    if "tragedy" in before and rises:
        return "combat"
    if "tragedy" in before and all(abs(moved) <= CHANGE for moved in change.values()):
        return "cultivation"
    return None


def _over_replicas(curve: ArrayLike) -> Values:
    """Means over replicas that ignore NaN, [R, E] or [E] to [E]; NaN if all replicas are NaN."""
    curves = np.atleast_2d(np.asarray(curve, np.float64))
    defined = ~np.isnan(curves)
    with np.errstate(invalid="ignore"):
        means: Values = np.where(defined, curves, 0.0).sum(0) / defined.sum(0)
    return means


def _costs_of_lines(signal: Values, ends: NDArray[np.int64]) -> Values:
    """The squared error of the best straight lines from ends[i] to ends[j] of a signal [G, M], summed over
    metrics, [P, P] for P ends; infinite for segments shorter than `SHORTEST`."""
    place = np.arange(len(signal))[:, None]
    sums = np.stack([signal, signal * place, signal**2]).cumsum(1)
    sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], 1)[:, ends]
    costs = np.full((len(ends), len(ends)), np.inf)
    for last, end in enumerate(ends):
        starts = ends[ends <= end - _LEAST]
        size, middle = (end - starts)[:, None], ((starts + end - 1) / 2)[:, None]
        total, by_place, squares = sums[:, last, None] - sums[:, : len(starts)]
        places = size * (size**2 - 1) / 12  # the sum of (place - middle)**2
        slopes = (by_place - middle * total) ** 2 / places
        costs[: len(starts), last] = (squares - total**2 / size - slopes).sum(1)
    return costs


def phases_of(curves: Mapping[str, Values], *, centred: bool = False) -> list[Phase] | None:
    """Return the phases of a training, of running means over `SMOOTHED_EPISODES`.

    Args:
        curves: Those of `cprl.runs.curves.curves_of`.
        centred: Whether an episode is the centre of its running mean; else its first, as in the study.

    Returns:
        None for a number of episodes that is not in `EPISODES`, a single agent, a game that does not report
        the metrics, or a metric that is undefined in a whole window.
    """
    if not set(METRICS) <= set(curves) or "return_1" not in curves:
        return None
    whole = curves["survival_steps"]
    if whole.shape[1] not in EPISODES:
        return None
    smoothed = {name: running_mean(curves[name]) for name in METRICS}
    if any(np.isnan(means).all(0).any() for means in smoothed.values()):
        return None
    at = centres(whole, SMOOTHED_EPISODES)
    return find_phases(at if centred else at - at[0], smoothed)


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
    """Return the phases as bands of a figure."""
    return [(phase.first, phase.last, phase.label or UNNAMED) for phase in phases]


def draw_bands(panel: Axes, bands: Bands) -> None:
    """Draw phases behind the curves of a panel."""
    for first, last, name in bands:
        if name != UNNAMED:  # which is white, and hatched in the strip alone
            panel.axvspan(first, last, **_look(name, "#e6e6e6"), zorder=0, linewidth=0)
        panel.axvline(last, color="#999999", linewidth=0.6, zorder=0.5)


def add_keys(panel: Axes, *rows: Bands) -> None:
    """Give a panel an entry for the legend of each phase in these bands, in the study's order."""
    names = {name for bands in rows for _, _, name in bands}
    for name in (known for known in COLOURS if known in names):
        panel.add_patch(Rectangle((0, 0), 0, 0, label=f"phase: {name}", **_look(name, "#999999")))


def _look(name: str, edge: str) -> dict[str, Any]:
    hatch = {"hatch": "///"} if name == UNNAMED else {}
    return {"facecolor": COLOURS[name], "edgecolor": edge, **hatch}


def draw_strip(sheet: Sheet, panel: Axes, rows: Mapping[str, Bands]) -> None:
    """Draw rows of named blocks into a panel of its own, above that of the curves.

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
