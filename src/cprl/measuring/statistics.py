"""What a few replicas say about all that could have been run: means, intervals, differences.

A replica is one independent repetition of a whole training; within a replica episodes and agents depend on
each other, so replicas are what is counted and resampled, never episodes. Values are float64 [R], a number
for each of R replicas. The advice followed: R. Agarwal et al., "Deep Reinforcement Learning at the Edge of
the Statistical Precipice" (2021): inter-quartile means and stratified bootstrap intervals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Values = NDArray[np.float64]
Statistic = Literal["mean", "iqm"]

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 2000


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its bootstrap interval."""

    value: float
    low: float
    high: float
    """low .. high is the interval of the confidence asked for; NaN where one replica alone says nothing."""
    replicas: int

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


def mean(values: ArrayLike, axis: int = -1) -> Any:
    """The mean, float64 [...]."""
    return np.mean(np.asarray(values, np.float64), axis=axis)


def inter_quartile_mean(values: ArrayLike, axis: int = -1) -> Any:
    """The mean of the middle half, float64 [...]: of R values floor(R / 4) are left out at each end."""
    return stats.trim_mean(np.asarray(values, np.float64), 0.25, axis=axis)


_STATISTICS: Final[dict[Statistic, Callable[..., Any]]] = {"mean": mean, "iqm": inter_quartile_mean}


def estimate(
    *strata: ArrayLike,
    statistic: Statistic = "mean",
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """A statistic over replicas with its bootstrap interval, stratified where there are several strata.

    Each stratum (a board, an experiment) is resampled by itself and weighs the same, whatever its number of
    replicas: the value is the mean over strata of the statistic of each.

    Args:
        strata: float [R] each.
        statistic: "mean" or "iqm", the inter-quartile mean.
        confidence: of the interval, 0..1.
        resamples: of the bootstrap.
        seed: of the resampling.

    Raises:
        ValueError: for no replicas, for values that are not finite, and for numbers out of range.
    """
    samples = [_checked(stratum) for stratum in strata]
    if not samples:
        raise ValueError("no values were given; at least one replica is wanted")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}; a number between 0 and 1 is wanted")
    of_one = _STATISTICS[statistic]

    def overall(*parts: Values, axis: int = -1) -> Any:
        return sum(of_one(part, axis=axis) for part in parts) / len(parts)

    low, high = _interval(samples, overall, confidence, resamples, seed)
    replicas = sum(len(sample) for sample in samples)
    return Estimate(value=float(overall(*samples)), low=low, high=high, replicas=replicas)


def paired_difference(
    values: ArrayLike,
    others: ArrayLike,
    *,
    statistic: Statistic = "mean",
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """How much higher values are than others, replica by replica, e.g. of conditions with the same seeds.

    Args:
        values: float [R].
        others: float [R], of the same replicas in the same order.

    Raises:
        ValueError: for different numbers of replicas; see also `estimate`.
    """
    mine, theirs = _checked(values), _checked(others)
    if mine.shape != theirs.shape:
        raise ValueError(f"{len(mine)} replicas beside {len(theirs)}; the same replicas are wanted")
    return estimate(mine - theirs, statistic=statistic, confidence=confidence, resamples=resamples, seed=seed)


def curve_interval(
    curves: ArrayLike, *, confidence: float = CONFIDENCE, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[Values, Values, Values]:
    """The mean of several curves and its bootstrap interval at each point, by percentiles.

    Args:
        curves: float [R, E], a curve of E episodes for each replica; NaN where undefined.

    Returns:
        mean, low and high, float64 [E]; NaN where no replica has a value, or, for low and high, only one.
    """
    all_curves = np.asarray(curves, np.float64)
    if all_curves.ndim != 2:
        raise ValueError(f"curves are {list(all_curves.shape)}; [R, E] is wanted")
    defined = ~np.isnan(all_curves)
    filled, replicas = np.where(defined, all_curves, 0.0), len(all_curves)
    chosen = np.random.default_rng(seed).integers(replicas, size=(resamples, replicas))
    times = (chosen[:, :, None] == np.arange(replicas)).sum(1)  # how often each resample has each replica
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = filled.sum(0) / defined.sum(0)
        resampled = (times @ filled) / (times @ defined)
    margin = (1 - confidence) / 2
    low, high = np.full((2, all_curves.shape[1]), np.nan)
    several = defined.sum(0) > 1
    if several.any():
        low[several], high[several] = np.nanquantile(resampled[:, several], [margin, 1 - margin], axis=0)
    return middle, low, high


def _interval(
    samples: Sequence[Values], overall: Callable[..., Any], confidence: float, resamples: int, seed: int
) -> tuple[float, float]:
    """Bias-corrected and accelerated where it is defined, else by percentiles."""
    if any(len(sample) < 2 for sample in samples):
        return float("nan"), float("nan")
    if all(np.ptp(sample) == 0 for sample in samples):
        same = float(overall(*samples))
        return same, same
    methods: tuple[Literal["BCa", "percentile"], ...] = ("BCa", "percentile")
    for method in methods if len(samples) == 1 else methods[1:]:
        found = stats.bootstrap(
            samples,
            overall,
            n_resamples=resamples,
            confidence_level=confidence,
            method=method,
            rng=np.random.default_rng(seed),
            vectorized=True,
        ).confidence_interval
        if np.isfinite([found.low, found.high]).all():
            return float(found.low), float(found.high)
    return float("nan"), float("nan")


def _checked(values: ArrayLike) -> Values:
    checked = np.asarray(values, np.float64)
    if checked.ndim != 1 or not len(checked):
        raise ValueError(f"values are {list(checked.shape)}; [R], a number for each replica, is wanted")
    if not np.isfinite(checked).all():
        raise ValueError(f"values are {checked.tolist()}; finite numbers are wanted")
    return checked
