"""Statistics over replicas: means, differences, and their intervals by Student's t or by bootstrap.

A replica is one independent repetition of a whole training. Episodes and agents within a replica depend on
each other, so the bootstrap resamples replicas, never episodes. Values are float64 [R], one number per
replica. Inter-quartile means and stratified bootstrap intervals follow R. Agarwal et al., "Deep Reinforcement
Learning at the Edge of the Statistical Precipice" (2021). Intervals by t of means over several samples have
the degrees of freedom of B. L. Welch, "The generalization of 'Student's' problem when several different
population variances are involved" (1947).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from cprl import arguments
from cprl.arguments import Interval as Interval
from cprl.checks import shown
from cprl.measuring.intervals import Values, bootstrap_interval, t_interval
from cprl.memory import check_memory

Statistic = Literal["mean", "iqm"]

_BY_CHANCE: Final = {
    2: "two",
    3: "three",
    4: "five",
    6: "seven",
    8: "eight",
    10: "ten",
    16: "twelve",
    50: "twenty",
}
"""By the number of replicas, in one of how many cases the bootstrap's interval of a difference of nothing
excludes 0: python docs/verdict_rates.py --differences."""

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 2000
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


def excluded_by_chance(interval: Interval, replicas: int) -> str:
    """In how many cases an interval excludes 0 where there is no difference, e.g. "one in twenty".

    Intervals by Student's t do in one of twenty. Bootstraps of a few replicas are too narrow, and do more
    often.

    Args:
        interval: how the interval is computed.
        replicas: of each condition.

    Raises:
        ValueError: for anything else.
    """
    arguments.choice("interval", interval, get_args(Interval))
    replicas = arguments.integer("replicas", replicas, 1)
    cases = [own for fewest, own in _BY_CHANCE.items() if fewest <= max(replicas, 2)]
    return f"one in {'twenty' if interval == 't' else cases[-1]}"


def mean(values: ArrayLike, axis: int = -1) -> Any:
    """The mean, float64 [...]."""
    return np.mean(_some(values, axis), axis=axis)


def inter_quartile_mean(values: ArrayLike, axis: int = -1) -> Any:
    """The mean of the middle half, float64 [...]: of R values it ignores the floor(R / 4) at each end."""
    from scipy import stats  # takes as long as torch

    return stats.trim_mean(_some(values, axis), 0.25, axis=axis)


def _some(values: ArrayLike, axis: int) -> Values:
    """Values as float64, at least one along the axis."""
    found = arguments.floats("values", values)
    axis = arguments.integer("axis", axis, -found.ndim)
    if not found.ndim or not -found.ndim <= axis < found.ndim or not found.shape[axis]:
        raise ValueError(f"values is {list(found.shape)} and axis is {axis}; allowed: at least one value")
    return found


_STATISTICS: Final[dict[Statistic, Callable[..., Any]]] = {"mean": mean, "iqm": inter_quartile_mean}


def estimate(
    *strata: ArrayLike,
    statistic: Statistic = "mean",
    interval: Interval | None = None,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """A statistic over replicas with its interval; stratified if there are several strata.

    Each stratum (a board, an experiment) is resampled separately and has the same weight, whatever its number
    of replicas: the value is the mean of the statistics of all strata.

    Args:
        strata: float [R] each.
        statistic: "mean", or "iqm" for the inter-quartile mean.
        interval: see `Interval`; by default "t" for means, and "bca" for inter-quartile means, which have no
            other.
        confidence: The confidence of the interval, between 0 and 1, exclusive.
        resamples: The number of bootstrap resamples.
        seed: The seed of the resampling.

    Raises:
        ValueError: If there are no replicas, a value is not finite, or an argument is out of range.
        MemoryError: If there are too many resamples.
    """
    samples = [_checked(stratum) for stratum in strata]
    if not samples:
        raise ValueError("there are no values; allowed: at least one stratum")
    arguments.choice("statistic", statistic, _STATISTICS)
    if interval is None:
        interval = "t" if statistic == "mean" else "bca"
    arguments.choice("interval", interval, get_args(Interval))
    if interval == "t" and statistic != "mean":
        raise ValueError(f'interval is "t" and statistic is {shown(statistic)}; allowed: "mean", or "bca"')
    resamples, seed = _bootstrap(confidence, resamples, seed, max(map(len, samples)))
    of_one = _STATISTICS[statistic]

    def overall(*parts: Values, axis: int = -1) -> Any:
        return sum(of_one(part, axis=axis) for part in parts) / len(parts)

    if interval == "t":
        low, high = t_interval(samples, [1 / len(samples)] * len(samples), confidence)
    else:
        low, high = bootstrap_interval(samples, overall, confidence, resamples, seed)
    replicas = sum(len(sample) for sample in samples)
    return Estimate(value=float(overall(*samples)), low=low, high=high, replicas=replicas)


def difference(
    values: ArrayLike,
    reference: ArrayLike,
    *,
    paired: bool,
    interval: Interval = "t",
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """The difference between two means over replicas, with its interval.

    Args:
        values: float [R].
        reference: float [R] if paired, else of any number of replicas.
        paired: Whether replica r of both had the same chance: then the interval is that of the mean of
            differences; else both are resampled separately, or the interval is Welch's.
        interval: See `Interval`.
        confidence: The confidence of the interval, between 0 and 1, exclusive.
        resamples: The number of bootstrap resamples.
        seed: The seed of the resampling.

    Raises:
        ValueError: See `estimate`; for pairs of unequal numbers of replicas.
    """
    samples = [_checked(values), _checked(reference)]
    how: dict[str, Any] = {"confidence": confidence, "resamples": resamples, "seed": seed}
    if paired:
        if len(samples[0]) != len(samples[1]):
            raise ValueError(
                f"values has {len(samples[0])} replicas and reference {len(samples[1])}; allowed in pairs: "
                "as many"
            )
        return estimate(samples[0] - samples[1], interval=interval, **how)
    arguments.choice("interval", interval, get_args(Interval))
    resamples, seed = _bootstrap(confidence, resamples, seed, max(map(len, samples)))

    def overall(own: Values, other: Values, axis: int = -1) -> Any:
        return own.mean(axis) - other.mean(axis)

    if interval == "t":
        low, high = t_interval(samples, [1.0, -1.0], confidence)
    else:
        low, high = bootstrap_interval(samples, overall, confidence, resamples, seed)
    value = float(overall(samples[0], samples[1]))
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


def _bootstrap(confidence: float, resamples: int, seed: int, numbers: int) -> tuple[int, int]:
    """Resamples and seed, after checking them; `numbers`: those that each resample holds."""
    _check_confidence(confidence)
    resamples, seed = arguments.integer("resamples", resamples, 1, 2**40), arguments.seed(seed)
    check_memory(f"resamples is {resamples:,}: they", 8 * resamples * numbers, "fewer resamples")
    return resamples, seed


def _check_confidence(confidence: float) -> None:
    arguments.number("confidence", confidence, low=0, high=_BELOW_ONE, above=True, allowed="above 0, below 1")


def _checked(values: ArrayLike) -> Values:
    checked = arguments.floats("values", values)
    if checked.ndim != 1 or not len(checked):
        raise ValueError(f"values is {list(checked.shape)}; allowed: [R], one number per replica")
    if not np.isfinite(checked).all():
        raise ValueError(f"values is {shown(checked.tolist())}; allowed: finite numbers")
    return checked
