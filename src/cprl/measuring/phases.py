"""Phases of a training: the change points of the social metrics, and labels for the phases between them.

In a phase every metric follows a straight line over the episodes; the lines of adjacent phases need not meet.
The change points minimise the squared error summed over all metrics, each in units of its own standard
deviation. Dynamic programming finds the exact minimum (C. Truong et al., "Selective review of offline change
point detection methods" (2020), and their library ruptures).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import ruptures
from numpy.typing import ArrayLike, NDArray
from ruptures.base import BaseCost

from cprl import arguments
from cprl.arguments import objects

Values = NDArray[np.float64]

PHASES: Final = ("exploration", "tragedy", "combat", "cultivation")
"""The study's names of phases, in its order."""
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
CHANGE: Final = 0.25
"""The share of its range by which a metric's line must rise or fall to count as rising or falling."""


@dataclass(frozen=True, kw_only=True)
class ChangePoint:
    """An episode at which a phase ends and the next begins."""

    episode: float
    low: float
    high: float
    """low .. high contains 95 % of the change points of resampled replicas; NaN for a single replica."""


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


def change_points(
    episodes: ArrayLike,
    metrics: Mapping[str, ArrayLike],
    *,
    number: int = 3,
    resamples: int = 200,
    seed: int = 0,
) -> list[ChangePoint]:
    """Finds the change points between phases.

    Args:
        episodes: The index of each episode, [E], increasing.
        metrics: float [E] or [R, E] by name, the same R replicas for all; running means work well. Means
            over replicas ignore NaN.
        number: The number of change points.
        resamples: The number of bootstrap resamples of the replicas.
        seed: The seed of the resampling.

    Raises:
        ValueError: If there are too few or too many episodes, a metric has another shape or is NaN in some
            episode of all replicas, or an argument is out of range.
    """
    at, by_name = _checked(episodes, metrics)
    number, resamples = arguments.integer("number", number, 1), arguments.integer("resamples", resamples, 1)
    seed = arguments.seed(seed)
    shapes = {name: curve.shape for name, curve in by_name.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"metrics are {shapes}; allowed: the same shape for all")
    curves = np.stack(list(by_name.values()))
    if at[-1] - at[0] > LONGEST:
        raise ValueError(f"episodes are {at[0]:g} to {at[-1]:g}; allowed: at most {LONGEST:,} episodes")
    grid = np.arange(at[0], at[-1] + 1e-9, GRID / 5)
    if (grid[-1] - grid[0]) < (number + 1) * SHORTEST:
        raise ValueError(
            f"episodes {at[0]:g} to {at[-1]:g} are too few for {number + 1} phases of at least {SHORTEST}"
        )
    found = _found(grid, at, _over_replicas(curves), number)
    replicas = curves.shape[1]
    low = high = np.full(number, np.nan)
    if replicas > 1:
        rng = np.random.default_rng(seed)
        resampled = [
            _found(grid, at, _over_replicas(curves[:, rng.integers(replicas, size=replicas)]), number)
            for _ in range(resamples)
        ]
        low, high = np.quantile(resampled, [0.025, 0.975], axis=0)
    return [
        ChangePoint(episode=float(middle), low=float(lower), high=float(upper))
        for middle, lower, upper in zip(found, low, high, strict=True)
    ]


def find_phases(
    episodes: ArrayLike, metrics: Mapping[str, ArrayLike], *, number: int = 3, resamples: int = 200
) -> tuple[list[ChangePoint], list[Phase]]:
    """Finds `number` change points and the phases between them; see `change_points` and `phases`."""
    number, resamples = arguments.integer("number", number, 0), arguments.integer("resamples", resamples, 1)
    changes = change_points(episodes, metrics, number=number, resamples=resamples) if number else []
    return changes, phases(episodes, metrics, changes)


def phases(
    episodes: ArrayLike, metrics: Mapping[str, ArrayLike], changes: Sequence[ChangePoint]
) -> list[Phase]:
    """The phases between change points, labelled if they have a pattern that the study claims.

    exploration: the first phase, if the collective return rises;
    tragedy: collective return, survival and peacefulness all fall;
    combat: after a tragedy, if the collective return rises;
    cultivation: after a tragedy, if none of the four metrics rises or falls, at whatever level: a board that
    is steadily drained has this label too, so look at the level of the collective return beside it.
    A metric rises or falls if its line changes by more than `CHANGE` of the metric's range.

    Args:
        episodes: The index of each episode, [E], increasing.
        metrics: float [E] or [R, E] by name; at least `METRICS`.
        changes: The change points, see `change_points`.

    Raises:
        ValueError: If a metric is missing or has another shape, or a phase has fewer than two episodes.
    """
    points = objects("changes", changes, ChangePoint, "change points")
    at, by_name = _checked(episodes, metrics)
    missing = [name for name in METRICS if name not in by_name]
    if missing:
        raise ValueError(f"metrics lack {missing}; allowed: at least {list(METRICS)}")
    means = {name: _over_replicas(by_name[name]) for name in METRICS}
    bounds = [at[0], *(change.episode for change in points), at[-1]]
    found: list[Phase] = []
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
        label = _label(change, [phase.label for phase in found])
        found.append(Phase(first=float(first), last=float(last), label=label, change=change))
    return found


def _checked(episodes: ArrayLike, metrics: Mapping[str, ArrayLike]) -> tuple[Values, dict[str, Values]]:
    """The episodes, [E], and each metric, [R, E], after checking their form."""
    at = arguments.floats("episodes", episodes)
    if at.ndim != 1 or len(at) < 2 or not (np.diff(at) > 0).all() or not np.isfinite(at[[0, -1]]).all():
        raise arguments.refusal("episodes", episodes, "[E], at least two, finite and increasing")
    arguments.object_of("metrics", metrics, Mapping, "a table of at least one metric, [E] or [R, E]")
    curves = {
        name: np.atleast_2d(arguments.floats(f"metrics[{name!r}]", own)) for name, own in metrics.items()
    }
    if not curves:
        raise ValueError("metrics is empty; allowed: at least one metric, [E] or [R, E]")
    for name, curve in curves.items():
        if curve.ndim != 2 or curve.shape[1] != len(at) or not len(curve):
            raise ValueError(
                f"metrics[{name!r}] is {list(curve.shape)}; allowed: [{len(at)}] or [R, {len(at)}], as there "
                f"are {len(at)} episodes"
            )
        if np.isinf(curve).any():
            raise ValueError(f"metrics[{name!r}] holds infinity; allowed: finite numbers, and NaN")
    return at, curves


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
    """Means over replicas that ignore NaN, [..., R, E] to [..., E]; NaN if all replicas are NaN."""
    defined = ~np.isnan(curves)
    with np.errstate(invalid="ignore"):
        means: Values = np.where(defined, curves, 0.0).sum(-2) / defined.sum(-2)
    return means


class _LineCost(BaseCost):
    """The squared error of the best straight line over a segment, summed over metrics."""

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
    """The change points of one set of curves, [M, E] for M metrics."""
    on_grid = np.stack([np.interp(grid, at, curve) for curve in means], axis=1)
    if not np.isfinite(on_grid).all():
        raise ValueError(
            "a metric is NaN in some episode of all replicas; allowed: finite means over replicas "
            "(omit the metric or fill the gap)"
        )
    spread = on_grid.std(0)
    signal = (on_grid - on_grid.mean(0)) / np.where(spread > 0, spread, 1.0)
    search = ruptures.Dynp(custom_cost=_LineCost(), min_size=_LineCost.min_size, jump=5).fit(signal)
    return grid[np.array(search.predict(number)[:-1]) - 1]
