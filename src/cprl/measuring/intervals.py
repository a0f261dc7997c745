"""The bounds of intervals, by Student's t and by bootstrap, of samples that are checked already."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


def bootstrap_interval(
    samples: Sequence[Values], overall: Callable[..., Any], confidence: float, resamples: int, seed: int
) -> tuple[float, float]:
    """The bias-corrected and accelerated (BCa) interval where it is defined, else the percentile interval.

    Args:
        samples: [R] each, resampled separately.
        overall: the statistic of all samples, given as arguments; vectorised, with `axis`.
        confidence: of the interval.
        resamples: the number of resamples.
        seed: of the resampling.

    Returns:
        Low and high; NaN where a sample has one value, and where neither interval is defined.
    """
    from scipy import stats

    if any(len(sample) < 2 for sample in samples):
        return float("nan"), float("nan")
    if all(np.ptp(sample) == 0 for sample in samples):
        same = float(overall(*samples))
        return same, same
    methods: tuple[Literal["BCa", "percentile"], ...] = ("BCa", "percentile")
    for method in methods if len(samples) == 1 else methods[1:]:
        with warnings.catch_warnings():  # where it is undefined, which is seen from the outcome
            warnings.simplefilter("ignore", RuntimeWarning)
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


def t_interval(samples: Sequence[Values], weights: Sequence[float], confidence: float) -> tuple[float, float]:
    """The interval of a weighted sum of means by Student's t, with the degrees of freedom of Welch.

    Args:
        samples: [R] each, independent.
        weights: of the mean of each sample.
        confidence: of the interval.

    Returns:
        Low and high; NaN where a sample has one value.
    """
    from scipy import stats

    if any(len(sample) < 2 for sample in samples):
        return float("nan"), float("nan")
    middle = sum(weight * float(own.mean()) for weight, own in zip(weights, samples, strict=True))
    parts = [
        weight**2 * float(own.var(ddof=1)) / len(own) for weight, own in zip(weights, samples, strict=True)
    ]
    if sum(parts) == 0:
        return middle, middle
    freedom = sum(parts) ** 2 / sum(
        part**2 / (len(own) - 1) for part, own in zip(parts, samples, strict=True)
    )
    reach = float(stats.t.ppf((1 + confidence) / 2, freedom)) * sum(parts) ** 0.5
    return middle - reach, middle + reach
