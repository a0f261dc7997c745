"""Phases of a training: where the social metrics change their course, and what each stretch looks like.

A phase is a stretch of episodes in which every metric follows a straight line; lines of neighbouring phases
need not meet. Change points are those that leave the least squared error over all metrics, each in units of
its own standard deviation, found exactly by dynamic programming (C. Truong et al., "Selective review of
offline change point detection methods" (2020), and their library ruptures).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import ruptures
from numpy.typing import ArrayLike, NDArray
from ruptures.base import BaseCost

Values = NDArray[np.float64]

PHASES: Final = ("exploration", "tragedy", "combat", "cultivation")
"""The study's names, in its order."""
METRICS: Final = ("collective_return", "equality", "survival_steps", "peacefulness")
"""What labels are told by."""
GRID: Final = 50
"""Episodes to which change points are told; a figure of running means over 100 has no finer ones."""
SHORTEST: Final = 200
"""Episodes of the shortest phase."""
CHANGE: Final = 0.25
"""How much of its whole range a metric's line must rise or fall by to count as rising or falling."""


@dataclass(frozen=True, kw_only=True)
class ChangePoint:
    """An episode at which a phase ends and the next begins."""

    episode: float
    low: float
    high: float
    """low .. high holds 95 % of the change points of resampled replicas; NaN for one series alone."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A stretch of episodes."""

    first: float
    last: float
    label: str | None
    """One of `PHASES`, or None where the pattern is none of theirs."""
    change: Mapping[str, float]
    """By how much the line of each metric rises from the phase's beginning to its end, in shares of the
    metric's range over the whole training."""


def change_points(
    episodes: ArrayLike,
    metrics: Mapping[str, ArrayLike],
    *,
    number: int = 3,
    resamples: int = 200,
    seed: int = 0,
) -> list[ChangePoint]:
    """Where phases change.

    Args:
        episodes: the number of each episode, [E], rising.
        metrics: float [E] or [R, E] by name, the same R replicas for all; running means do well. NaN is
            left out of means over replicas.
        number: how many change points are looked for.
        resamples: of the replicas, for the uncertainty.
        seed: of the resampling.

    Raises:
        ValueError: for too few episodes for so many phases, metrics of other lengths, and undefined values.
    """
    at = np.asarray(episodes, np.float64)
    curves = np.stack([np.atleast_2d(np.asarray(curve, np.float64)) for curve in metrics.values()])
    if curves.shape[-1] != len(at):
        raise ValueError(f"metrics have {curves.shape[-1]} episodes, episodes {len(at)}; as many are wanted")
    grid = np.arange(at[0], at[-1] + 1e-9, GRID / 5)
    if (grid[-1] - grid[0]) < (number + 1) * SHORTEST:
        raise ValueError(
            f"episodes {at[0]:g} to {at[-1]:g} are too few for {number + 1} phases of {SHORTEST} or more"
        )
    found = _found(grid, at, _over_replicas(curves), number)
    replicas = curves.shape[1]
    low = high = np.full(number, np.nan)
    if replicas > 1:
        chance = np.random.default_rng(seed)
        drawn = [
            _found(grid, at, _over_replicas(curves[:, chance.integers(replicas, size=replicas)]), number)
            for _ in range(resamples)
        ]
        low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    return [
        ChangePoint(episode=float(middle), low=float(least), high=float(most))
        for middle, least, most in zip(found, low, high, strict=True)
    ]


def told_apart(
    episodes: ArrayLike, metrics: Mapping[str, ArrayLike], *, number: int = 3
) -> tuple[list[ChangePoint], list[Phase]]:
    """So many change points and the phases between them; see `change_points` and `phases`."""
    changes = change_points(episodes, metrics, number=number) if number else []
    return changes, phases(episodes, metrics, changes)


def phases(
    episodes: ArrayLike, metrics: Mapping[str, ArrayLike], changes: Sequence[ChangePoint]
) -> list[Phase]:
    """The stretches between change points, labelled where the pattern of the study's claims is theirs.

    exploration: the first, and the collective return rises;
    tragedy: collective return, survival and peacefulness all fall;
    combat: after a tragedy, and the collective return rises;
    cultivation: after a tragedy, and none of the four metrics rises or falls.
    To rise or fall is to do so by more than `CHANGE` of the metric's range.

    Args:
        episodes: [E].
        metrics: float [E] or [R, E] by name, `METRICS` at least.
        changes: see `change_points`.
    """
    at = np.asarray(episodes, np.float64)
    means = {name: _over_replicas(np.atleast_2d(np.asarray(metrics[name], np.float64))) for name in METRICS}
    bounds = [at[0], *(change.episode for change in changes), at[-1]]
    found: list[Phase] = []
    for first, last in pairwise(bounds):
        inside = (at >= first) & (at <= last)
        change = {
            name: float(
                np.polyfit(at[inside], curve[inside], 1)[0] * (last - first) / max(np.ptp(curve), 1e-12)
            )
            for name, curve in means.items()
        }
        label = _label(change, [phase.label for phase in found])
        found.append(Phase(first=float(first), last=float(last), label=label, change=change))
    return found


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


def _over_replicas(curves: Values) -> Values:
    """Means over R of what is defined, [..., R, E] to [..., E]; NaN where nothing is."""
    defined = ~np.isnan(curves)
    with np.errstate(invalid="ignore"):
        means: Values = np.where(defined, curves, 0.0).sum(-2) / defined.sum(-2)
    return means


class _LineCost(BaseCost):
    """The squared error that a straight line over a stretch leaves, summed over metrics."""

    model = "line"
    min_size = int(SHORTEST // (GRID / 5))

    def fit(self, signal: Values) -> "_LineCost":
        self.signal = signal
        place = np.arange(len(signal))[:, None]
        sums = np.stack([signal, signal * place, signal**2]).cumsum(1)
        self._sums = np.concatenate([np.zeros_like(sums[:, :1]), sums], 1)
        return self

    def error(self, start: int, end: int) -> float:
        size, middle = end - start, (start + end - 1) / 2
        total, by_place, squares = self._sums[:, end] - self._sums[:, start]
        places = size * (size**2 - 1) / 12  # the sum of (place - middle)**2
        slopes = (by_place - middle * total) ** 2 / places
        return float((squares - total**2 / size - slopes).sum())


def _found(grid: Values, at: Values, means: Values, number: int) -> Any:
    """The change points of one set of curves [M, E]."""
    on_grid = np.stack([np.interp(grid, at, curve) for curve in means], axis=1)
    if not np.isfinite(on_grid).all():
        raise ValueError("a metric is undefined in some episode of all replicas; leave it out, or fill it")
    spread = on_grid.std(0)
    signal = (on_grid - on_grid.mean(0)) / np.where(spread > 0, spread, 1.0)
    search = ruptures.Dynp(custom_cost=_LineCost(), min_size=_LineCost.min_size, jump=5).fit(signal)
    return grid[np.array(search.predict(number)[:-1]) - 1]
