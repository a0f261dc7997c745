"""What phases has a training of experiment 5? Change points of the social metrics, and their patterns.

In a phase every metric follows a straight line over the episodes; the lines of adjacent phases need not meet.
The change points minimise the squared error summed over all metrics, each in units of its own standard
deviation. Dynamic programming finds the exact minimum (C. Truong et al., "Selective review of offline change
point detection methods" (2020)).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from page import section
from published import EXPERIMENT_5
from results import TOO_FEW, Result

from cprl.measuring.windows import running_mean
from cprl.values.array_types import Float64

PHASES: Final = ("exploration", "tragedy", "combat", "cultivation")
"""The study's names of phases, in its order."""
UNNAMED: Final = "none of the four patterns"
"""The name of a phase without a label."""
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
        ValueError: If there are too few or too many episodes, or a metric is NaN in one of all replicas.
    """
    at = np.asarray(episodes, np.float64)
    shortest = (number + 1) * SHORTEST
    if not shortest <= at[-1] - at[0] <= LONGEST:
        raise ValueError(
            f"episodes are {at[0]:g} to {at[-1]:g}; allowed: {shortest:,} to {LONGEST:,} of them"
        )
    grid = np.arange(at[0], at[-1] + 1e-9, GRID / _JUMP)
    on_grid = np.stack([np.interp(grid, at, _mean(curve)) for curve in metrics.values()], axis=1)
    if not np.isfinite(on_grid).all():
        raise ValueError(
            "a metric is NaN in some episode of all replicas; allowed: finite means over replicas"
        )
    spread = on_grid.std(0)
    signal = (on_grid - on_grid.mean(0)) / np.where(spread > 0, spread, 1.0)
    ends = np.unique([*range(0, len(signal), _JUMP), len(signal)])
    costs = _costs_of_lines(signal, ends)
    # best[e]: the least cost of k + 1 segments up to ends[e]; before[k][e]: where the last of them begins.
    best = costs[0]
    before = []
    for _ in range(number):
        totals = best[:, None] + costs
        before.append(totals.argmin(0))
        best = totals.min(0)
    place = len(ends) - 1
    changes = []
    for begins in reversed(before):
        place = begins[place]
        changes.append(float(grid[ends[place] - 1]))
    return changes[::-1]


def _costs_of_lines(signal: Float64, ends: NDArray[np.int64]) -> Float64:
    """Return the squared error of the best straight lines from ends[i] to ends[j] of a signal [G, M], summed
    over metrics, [P, P] for P ends; infinite for segments shorter than `SHORTEST`."""
    place = np.arange(len(signal))[:, None]
    sums = np.stack([signal, signal * place, signal**2]).cumsum(1)
    sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], 1)[:, ends]
    costs = np.full((len(ends), len(ends)), np.inf)
    for last, end in enumerate(ends):
        starts = ends[ends <= end - _LEAST]
        size = (end - starts)[:, None]
        middle = ((starts + end - 1) / 2)[:, None]
        total, by_place, squares = sums[:, last, None] - sums[:, : len(starts)]
        places = size * (size**2 - 1) / 12  # the sum of (place - middle)**2
        slopes = (by_place - middle * total) ** 2 / places
        costs[: len(starts), last] = (squares - total**2 / size - slopes).sum(1)
    return costs


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
    """
    at = np.asarray(episodes, np.float64)
    means = {name: _mean(metrics[name]) for name in METRICS}
    divided: list[Phase] = []
    for first, last in pairwise([at[0], *changes, at[-1]]):
        is_inside = (at >= first) & (at <= last)
        change = {}
        for name, curve in means.items():
            rise = np.polyfit(at[is_inside], curve[is_inside], 1)[0] * (last - first)
            change[name] = float(rise / max(np.ptp(curve), 1e-12))
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


def find_phases(episodes: ArrayLike, metrics: Mapping[str, ArrayLike]) -> list[Phase]:
    """Return the phases between three change points; see `change_points` and `phases`."""
    return phases(episodes, metrics, change_points(episodes, metrics))


def _mean(curve: ArrayLike) -> Float64:
    """Return means over replicas that ignore NaN, [R, E] or [E] to [E]; NaN if all replicas are NaN."""
    curves = np.atleast_2d(np.asarray(curve, np.float64))
    is_defined = ~np.isnan(curves)
    with np.errstate(invalid="ignore"):
        return np.where(is_defined, curves, 0.0).sum(0) / is_defined.sum(0)


def training_phases(curves: Mapping[str, Float64]) -> list[Phase] | None:
    """Return the phases of a training, of running means over 100 episodes, each at its first one.

    Args:
        curves: Those of `cprl.runs.curves.curves_of`.

    Returns:
        None for a number of episodes that is not in `EPISODES`, a single agent, a game that does not report
        the metrics, or a metric that is undefined in a whole window.
    """
    if not {*METRICS, "return_1"} <= set(curves):
        return None
    if curves["survival_steps"].shape[1] not in EPISODES:
        return None
    smoothed = {name: running_mean(curves[name]) for name in METRICS}
    if any(np.isnan(means).all(0).any() for means in smoothed.values()):
        return None
    return find_phases(np.arange(smoothed["equality"].shape[1]), smoothed)


SURVIVED: Final = 990
"""The running mean of survival, in steps of an episode's 1000, below which survival counts as falling."""
_RESAMPLES: Final = 200


def sections(results: Sequence[Result]) -> list[str]:
    """Return the sections on phases and on turning points, those of the published curves first; nothing
    without a run of experiment 5."""
    runs = [result for result in results if result.study == EXPERIMENT_5]
    if not runs:
        return []
    rows = [["published curves", *_phase_cells(_published_phases())]]
    for result in runs:
        divided = training_phases(result.curves)
        cells = _phase_cells(divided, _change_intervals(result)) if divided else [TOO_FEW]
        rows.append([result.name, *cells])
    note = (
        f"The study draws its phases from {', '.join(map(str, PHASES_BEGIN))} on. "
        "See `recipes/study/phases.py` for how ours are found."
    )
    head = ["curves", "second phase from", "third", "fourth", "phases by their pattern"]
    lines = section("Phases of experiment 5", head, rows, note)
    returns, survival = (EXPERIMENT_5.curve(name) for name in ("collective_return", "survival_steps"))
    rows = [["published curves", *_turning_cells(*returns, *survival)]]
    for result in runs:
        survival = result.smoothed("survival_steps")
        episodes = np.arange(survival.shape[1])
        returns = result.smoothed("collective_return").mean(0)
        lowest = survival.min(1)
        cells = _turning_cells(episodes, returns, episodes, survival.mean(0))
        rows.append([result.name, *cells, f"{lowest.min():.0f} to {lowest.max():.0f}"])
    head = ["curves", "highest return", "at episode", "lowest return after it", "at episode"]
    head += [f"survival first below {SURVIVED} steps", "lowest survival", "lowest of single replicas"]
    return [*lines, *section("Turning points of experiment 5", head, rows)]


def _turning_cells(at: Float64, returns: Float64, survival_at: Float64, survival: Float64) -> list[str]:
    top = int(returns.argmax())
    bottom = top + int(returns[top:].argmin())
    falls = survival < SURVIVED
    first = f"{survival_at[falls.argmax()]:.0f}" if falls.any() else "never"
    cells = [f"{returns[top]:.0f}", f"{at[top]:.0f}", f"{returns[bottom]:.0f}", f"{at[bottom]:.0f}"]
    return [*cells, first, f"{survival.min():.0f}"]


def _published_phases() -> list[Phase]:
    episodes = np.arange(10, 4745)
    # The curve of survival begins at episode 512; before that no agents deplete the board.
    return find_phases(episodes, {name: EXPERIMENT_5.drawn_at(name, episodes) for name in METRICS})


def _change_intervals(result: Result) -> list[str]:
    """Return in which episodes 95 % of the change points of resampled replicas lie; nothing for a single
    replica.

    Change points are no means, of which Student's t speaks: replicas are drawn anew, with replacement.
    """
    smoothed = {name: running_mean(result.curves[name]) for name in METRICS}
    replicas, episodes = smoothed[METRICS[0]].shape
    if replicas == 1:
        return []
    rng = np.random.default_rng(0)
    resampled = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(replicas, size=replicas)
        metrics = {name: curves[drawn] for name, curves in smoothed.items()}
        resampled.append(change_points(np.arange(episodes), metrics))
    return [f" [{low:.0f}, {high:.0f}]" for low, high in np.quantile(resampled, [0.025, 0.975], axis=0).T]


def _phase_cells(divided: Sequence[Phase], intervals: Sequence[str] = ()) -> list[str]:
    pairs = zip_longest(divided[1:], intervals, fillvalue="")
    cells = [f"{phase.first:.0f}{interval}" for phase, interval in pairs]
    return [*cells, ", ".join(phase.label or "none of them" for phase in divided)]
