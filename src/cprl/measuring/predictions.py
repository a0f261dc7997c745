"""Where further runs would lie: prediction intervals for the mean of some runs, beside the replicas of ours.

A confidence interval says where the mean of endlessly many runs lies. A published number rests on one run or
two, which lie farther from that mean; where they lie, given m replicas of ours with mean x and standard
deviation s, says the prediction interval for the mean of n further runs,

    x +- t(m - 1) s sqrt(1 / m + 1 / n),

with the quantile of Student's t (G. J. Hahn and W. Q. Meeker, "Statistical Intervals" (1991), chapter 4). It
assumes that the n runs and our m replicas are independent and drawn from the same normal distribution.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl import arguments
from cprl.measuring.statistics import CONFIDENCE

Values = NDArray[np.float64]

_BELOW_ONE: Final = np.nextafter(1.0, 0.0).item()


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Where the mean of further runs lies."""

    value: float
    """The mean of our replicas."""
    low: float
    high: float
    """The bounds of the interval; NaN for a single replica."""
    replicas: int
    """Of ours."""
    runs: int | None
    """The number of further runs; None for endlessly many, that is, the confidence interval of the mean."""

    def __contains__(self, value: float) -> bool:
        """Whether a number lies in the interval."""
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        """The interval alone, e.g. "[150, 160]"; "" for a single replica."""
        return f"[{self.low:.4g}, {self.high:.4g}]" if np.isfinite([self.low, self.high]).all() else ""


def prediction(values: ArrayLike, *, runs: int | None = 1, confidence: float = CONFIDENCE) -> Prediction:
    """The interval in which the mean of `runs` further runs lies with this confidence.

    Args:
        values: float [R], one number per replica, finite.
        runs: the number of further runs; None for endlessly many.
        confidence: between 0 and 1, exclusive.

    Raises:
        ValueError: if there are no replicas, a value is not finite, or an argument is out of range.
    """
    own = arguments.floats("values", values)
    if own.ndim != 1 or not len(own):
        raise ValueError(f"values is {list(own.shape)}; allowed: [R], one number per replica")
    if not np.isfinite(own).all():
        raise arguments.refusal("values", own.tolist(), "finite numbers")
    middle, low, high = curve_prediction(own[:, None], runs=runs, confidence=confidence)
    return Prediction(
        value=float(middle[0]), low=float(low[0]), high=float(high[0]), replicas=len(own), runs=runs
    )


def curve_prediction(
    curves: ArrayLike, *, runs: int | None = 1, confidence: float = CONFIDENCE
) -> tuple[Values, Values, Values]:
    """`prediction` at each episode by itself.

    Args:
        curves: float [R, E], a curve of E episodes per replica; NaN where undefined.
        runs: see `prediction`.
        confidence: see `prediction`.

    Returns:
        Mean, low and high, float64 [E]; NaN where no replica has a value, for low and high also where only
        one has.

    Raises:
        ValueError: if `curves` is not [R, E] with at least one replica and without infinity, or an argument
            is out of range.
    """
    own = arguments.floats("curves", curves)
    if own.ndim != 2 or not len(own):
        raise ValueError(f"curves is {list(own.shape)}; allowed: [R, E], a curve per replica")
    if np.isinf(own).any():
        raise ValueError("curves holds infinity; allowed: finite numbers, and NaN where undefined")
    arguments.number("confidence", confidence, low=0, high=_BELOW_ONE, above=True, allowed="above 0, below 1")
    of_runs = 0.0 if runs is None else 1 / arguments.integer("runs", runs, 1)
    defined = ~np.isnan(own)
    number = defined.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.where(defined, own, 0.0).sum(0) / number
        variance = np.where(defined, (own - middle) ** 2, 0.0).sum(0) / (number - 1)
        reach = _t(number - 1, confidence) * np.sqrt(variance * (1 / number + of_runs))
    return middle, middle - reach, middle + reach


def _t(freedom: NDArray[Any], confidence: float) -> Values:
    """The quantile of Student's t that encloses `confidence`, [...]; NaN without a degree of freedom."""
    from scipy import stats  # takes as long as torch

    different, place = np.unique(freedom, return_inverse=True)
    quantiles = [stats.t.ppf((1 + confidence) / 2, one) if one > 0 else np.nan for one in different.tolist()]
    found: Values = np.array(quantiles)[place]
    return found
