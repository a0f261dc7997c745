"""Statistics over replicas: means, differences, and their intervals by Student's t.

A replica is one independent repetition of a whole training. Episodes and agents within a replica depend on
each other, so that values are float64 [R], one number per replica. Intervals by t of means over several
samples have the degrees of freedom of B. L. Welch, "The generalization of 'Student's' problem when several
different population variances are involved" (1947).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl import arguments
from cprl.checks import shown

Values = NDArray[np.float64]

CONFIDENCE: Final = 0.95
_BELOW_ONE: Final = np.nextafter(1.0, 0.0).item()


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its interval."""

    value: float
    low: float
    high: float
    """The bounds of the interval; NaN for a single replica."""
    replicas: int
    """Of all samples together; of paired differences, the pairs."""

    def __str__(self) -> str:
        """The value with its interval, of a single replica the value alone."""
        has_interval = np.isfinite([self.low, self.high]).all()
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]" if has_interval else f"{self.value:.4g}"


def estimate(values: ArrayLike, *, confidence: float = CONFIDENCE) -> Estimate:
    """The mean over replicas with its interval by Student's t.

    Args:
        values: float [R].
        confidence: The confidence of the interval, between 0 and 1, exclusive.

    Raises:
        ValueError: If there are no replicas, a value is not finite, or an argument is out of range.
    """
    sample = _checked(values)
    _check_confidence(confidence)
    low, high = _t_interval([sample], [1.0], confidence)
    # + 0.0, so that none is -0.0
    return Estimate(value=float(sample.mean()) + 0.0, low=low, high=high, replicas=len(sample))


def difference(
    values: ArrayLike,
    reference: ArrayLike,
    *,
    paired: bool,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """The difference between two means over replicas, with its interval.

    Args:
        values: float [R].
        reference: float [R] if paired, else of any number of replicas.
        paired: Whether replica r of both had the same chance: then the interval is that of the mean of
            differences, else Welch's.
        confidence: The confidence of the interval, between 0 and 1, exclusive.

    Raises:
        ValueError: See `estimate`; for pairs of unequal numbers of replicas.
    """
    samples = [_checked(values), _checked(reference)]
    if paired:
        if len(samples[0]) != len(samples[1]):
            raise ValueError(
                f"values has {len(samples[0])} replicas and reference {len(samples[1])}; allowed in pairs: "
                "as many"
            )
        return estimate(samples[0] - samples[1], confidence=confidence)
    _check_confidence(confidence)
    low, high = _t_interval(samples, [1.0, -1.0], confidence)
    value = float(samples[0].mean() - samples[1].mean())
    return Estimate(value=value, low=low, high=high, replicas=sum(map(len, samples)))


def curve_interval(curves: ArrayLike, *, confidence: float = CONFIDENCE) -> tuple[Values, Values, Values]:
    """The mean of several curves and its interval by Student's t at each episode.

    Args:
        curves: float [R, E], a curve of E episodes per replica; NaN where undefined.
        confidence: The confidence of the interval, between 0 and 1, exclusive.

    Returns:
        Mean, low and high, float64 [E]; NaN where no replica has a value, for low and high also where only
        one has.

    Raises:
        ValueError: If `curves` is not [R, E] with at least one replica and without infinity, or an argument
            is out of range.
    """
    from scipy import stats

    all_curves = arguments.floats("curves", curves)
    if all_curves.ndim != 2 or not len(all_curves):
        raise ValueError(f"curves is {list(all_curves.shape)}; allowed: [R, E], a curve per replica")
    if np.isinf(all_curves).any():
        raise ValueError("curves holds infinity; allowed: finite numbers, and NaN where undefined")
    _check_confidence(confidence)
    defined = ~np.isnan(all_curves)
    replicas = defined.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN of none, and of one its interval
        middle = np.where(defined, all_curves, 0.0).sum(0) / replicas
        squares = np.where(defined, all_curves - middle, 0.0) ** 2
        error = np.sqrt(squares.sum(0) / (replicas - 1) / replicas)
    reach = stats.t.ppf((1 + confidence) / 2, replicas - 1) * error
    return middle, middle - reach, middle + reach


def _t_interval(
    samples: Sequence[Values], weights: Sequence[float], confidence: float
) -> tuple[float, float]:
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


def _check_confidence(confidence: float) -> None:
    arguments.number("confidence", confidence, low=0, high=_BELOW_ONE, above=True, allowed="above 0, below 1")


def _checked(values: ArrayLike) -> Values:
    checked = arguments.floats("values", values)
    if checked.ndim != 1 or not len(checked):
        raise ValueError(f"values is {list(checked.shape)}; allowed: [R], one number per replica")
    if not np.isfinite(checked).all():
        raise ValueError(f"values is {shown(checked.tolist())}; allowed: finite numbers")
    return checked
