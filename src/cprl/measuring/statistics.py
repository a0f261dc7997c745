"""Statistics over replicas: means, differences, and their intervals by Student's t; metrics of episodes.

A replica is one independent repetition of a whole training. Episodes and agents within a replica depend on
each other, so that values are float64 [R], one number per replica. Intervals by t of means over several
samples have the degrees of freedom of B. L. Welch, "The generalization of 'Student's' problem when several
different population variances are involved" (1947).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, isnan
from operator import attrgetter
from statistics import fmean
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl.measuring.episodes import Episode
from cprl.measuring.metrics import bounds
from cprl.measuring.series import Values

CONFIDENCE: Final = 0.95


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its interval."""

    value: float
    low: float
    high: float
    """The bounds of the interval; NaN for a single replica."""
    replicas: int
    """Of all samples together; of paired differences, the pairs."""
    p_value: float = float("nan")
    """How often a value at least as far from 0 would come by chance if it were 0, by the same t, two-sided;
    NaN for a single replica."""
    bounds: tuple[float, float] = (-inf, inf)
    """What the number can be. Student's t knows no bounds: `low` and `high` may pass them."""

    def of(self, metric: str, clock: float = inf) -> Self:
        """This estimate as one of a metric, whose `bounds` cut what is shown of the interval."""
        return replace(self, bounds=bounds(metric, clock))

    def between(self, metric: str, clock: float = inf) -> Self:
        """This difference as one between values of a metric, no larger than its `bounds` are apart."""
        least, most = bounds(metric, clock)
        return replace(self, bounds=(least - most, most - least))

    @property
    def interval(self) -> tuple[float, float]:
        """The interval as it is shown, within the bounds."""
        least = min(self.bounds[0], self.value)
        most = max(self.bounds[1], self.value)
        return max(self.low, least), min(self.high, most)  # NaN stays NaN

    @property
    def is_cut(self) -> bool:
        return self.interval != (self.low, self.high) and not isnan(self.low)

    def __str__(self) -> str:
        return format(self)

    def __format__(self, form: str) -> str:
        """The value with its interval, of a single replica the value alone; "" and "+" choose the digits."""
        numbers = self.value, *self.interval
        form += form_for(*numbers) if form in ("", "+") else ""
        value, low, high = (f"{number:{form}}" for number in numbers)
        return f"{value} [{low}, {high}]" if np.isfinite([self.low, self.high]).all() else value


CUT: Final = "Bounds of a metric cut an interval where Student's t passes them."
"""What a table says once where an interval `is_cut`."""
ONE_REPLICA: Final = "One replica: no interval."


def form_for(*numbers: float) -> str:
    """Return the format of numbers that are shown together, with two or three digits of the largest."""
    largest = max((abs(number) for number in numbers if isfinite(number)), default=0.0)
    if largest < 0.001:
        return ".3g"
    return f",.{next((digits for digits, size in enumerate((100, 10, 0.5)) if largest >= size), 3)}f"


def estimate(values: ArrayLike) -> Estimate:
    """Return the mean over replicas, of float [R], with its 95 % interval by Student's t.

    Raises:
        ValueError: If there are no replicas, or a value is not finite.
    """
    sample = _sample(values)
    return _estimate(float(sample.mean()) + 0.0, sample)  # so that none is -0.0


def difference(values: ArrayLike, reference: ArrayLike, *, paired: bool) -> Estimate:
    """Return the difference between two means over replicas, with its 95 % interval.

    Args:
        values: float [R].
        reference: float [R] if paired, else of any number of replicas.
        paired: Whether replica r of both had the same chance: then the interval is that of the mean of
            differences, else Welch's.

    Raises:
        ValueError: If there are no replicas, a value is not finite, or pairs have unequal numbers of them.
    """
    first, second = _sample(values), _sample(reference)
    if not paired:
        return _estimate(float(first.mean() - second.mean()), first, second)
    if len(first) != len(second):
        raise ValueError(
            f"values has {len(first)} replicas and reference {len(second)}; allowed in pairs: as many"
        )
    return estimate(first - second)


def holm(p_values: ArrayLike) -> NDArray[np.bool_]:
    """Return which of several differences are not 0, with a level of 5 % for a mistake in any of them.

    S. Holm, "A simple sequentially rejective multiple test procedure" (1979): the smallest of m p-values is
    compared with level / m, the next one with level / (m - 1) and so on, up to the first that is larger.

    Args:
        p_values: float [M]; those that are NaN are no comparisons.

    Returns:
        bool [M].
    """
    p_values = np.asarray(p_values, np.float64)
    order = np.argsort(p_values)  # NaN last
    left = np.count_nonzero(~np.isnan(p_values)) - np.arange(len(order))
    with np.errstate(divide="ignore"):
        is_small = p_values[order] <= (1 - CONFIDENCE) / np.maximum(left, 0)
    differs = np.zeros(len(order), bool)
    differs[order] = np.logical_and.accumulate(is_small)
    return differs


HOLM: Final = "* not 0 by Holm's method"
"""What a star of `starred` means; "for ..." says which comparisons."""


def starred(differences: Sequence[Estimate], form: str = "") -> list[str]:
    """Return the texts of all differences that are compared in one place, with a star where `holm` says that
    one is not 0.

    Args:
        form: of the value alone, e.g. "+.3g"; by default the value has its interval.
    """
    are_apart = holm([difference.p_value for difference in differences])
    return [
        (f"{difference.value:{form}}" if form else str(difference)) + " *" * bool(is_apart)
        for difference, is_apart in zip(differences, are_apart, strict=True)
    ]


def curve_interval(curves: ArrayLike) -> tuple[Values, Values, Values]:
    """Return the mean of several curves and its 95 % interval by Student's t at each episode.

    Args:
        curves: float [R, E], a curve of E episodes per replica; NaN where undefined.

    Returns:
        Mean, low and high, float64 [E]; NaN where no replica has a value, for low and high also where only
        one has.
    """
    from scipy import stats

    curves = np.asarray(curves, np.float64)
    defined = ~np.isnan(curves)
    replicas = defined.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN of none, and of one its interval
        middle = np.where(defined, curves, 0.0).sum(0) / replicas
        squares = np.where(defined, curves - middle, 0.0) ** 2
        error = np.sqrt(squares.sum(0) / (replicas - 1) / replicas)
    reach = stats.t.ppf((1 + CONFIDENCE) / 2, replicas - 1) * error
    return middle, middle - reach, middle + reach


def _estimate(value: float, *samples: Values) -> Estimate:
    """A mean or a difference of means with its interval by t, of the degrees of freedom of Welch."""
    from scipy import stats

    low = high = p_value = float("nan")
    if all(len(sample) > 1 for sample in samples):
        parts = [float(sample.var(ddof=1)) / len(sample) for sample in samples]
        low, high, p_value = value, value, float(value == 0)
        if error := sum(parts) ** 0.5:
            freedoms = [len(sample) - 1 for sample in samples]
            of_parts = zip(parts, freedoms, strict=True)
            freedom = sum(parts) ** 2 / sum(part**2 / of_part for part, of_part in of_parts)
            reach = float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error
            low, high = value - reach, value + reach
            p_value = 2 * float(stats.t.sf(abs(value) / error, freedom))
    replicas = sum(map(len, samples))
    return Estimate(value=value, low=low, high=high, replicas=replicas, p_value=p_value)


def _sample(values: ArrayLike) -> Values:
    sample = np.asarray(values, np.float64)
    if sample.ndim != 1 or not len(sample) or not np.isfinite(sample).all():
        raise ValueError(f"values is {sample.tolist()}; allowed: [R], a finite number for each replica")
    return sample


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A metric with one value per episode, over the episodes of several replicas."""

    estimate: Estimate | None
    """The estimate over replicas of each replica's mean over the episodes in which the metric is defined.
    Replicas without such an episode are left out; None if no replica has one."""
    undefined: int
    """Episodes of all replicas in which the metric is undefined; they are not part of a mean."""
    episodes: int
    """Episodes of all replicas."""

    def __str__(self) -> str:
        if self.estimate is None:
            return f"undefined in all {self.episodes}"
        value = f"{self.estimate}"
        return f"{value}, undefined in {self.undefined} of {self.episodes}" if self.undefined else value


def signed(difference: Estimate | None) -> str:
    """Return a difference as a cell of a table; "" where there is none."""
    return "" if difference is None else f"{difference:+}"


def notes_on(measures: Sequence[Measured]) -> list[str]:
    """Return what a table of metrics says once of its intervals."""
    estimates = [measured.estimate for measured in measures if measured.estimate is not None]
    is_single = bool(estimates) and all(estimate.replicas == 1 for estimate in estimates)
    return [ONE_REPLICA] * is_single + [CUT] * any(estimate.is_cut for estimate in estimates)


ByReplica = Mapping[int, Sequence[float]]
"""The values of a metric by replica, at least one per episode, NaN where undefined."""


def over_replicas(values: ByReplica, metric: str = "", clock: float = inf) -> Measured:
    """Estimate a metric, which may be named, see `bounds`; a mean that is not finite has no interval."""
    means = list(_means(values).values())
    return Measured(
        estimate=estimate_if_finite(means).of(metric, clock) if means else None,
        undefined=sum(isnan(value) for episodes in values.values() for value in episodes),
        episodes=sum(map(len, values.values())),
    )


def difference_paired(
    values: ByReplica, reference: ByReplica, metric: str = "", clock: float = inf
) -> Estimate | None:
    """Return how much more the mean of a metric is, paired by replica, over the replicas in which both are
    defined; None if there is none."""
    means = _means(values)
    others = _means(reference)
    pairs = [means[replica] - others[replica] for replica in means if replica in others]
    return estimate_if_finite(pairs).between(metric, clock) if pairs else None


def _means(values: ByReplica) -> dict[int, float]:
    """Return the mean of each replica over the episodes in which the metric is defined, if there are any."""
    defined = {
        replica: [value for value in episodes if not isnan(value)] for replica, episodes in values.items()
    }
    with np.errstate(invalid="ignore"):  # of infinite values of both signs
        return {
            replica: fmean(episodes) if all(map(isfinite, episodes)) else float(np.mean(episodes))
            for replica, episodes in defined.items()
            if episodes
        }


def estimate_if_finite(means: Sequence[float]) -> Estimate:
    """Return the estimate of means that may not be finite; then it is their mean, without an interval."""
    if all(map(isfinite, means)):
        return estimate(means)
    with np.errstate(invalid="ignore"):
        value = float(np.mean(means))
    return Estimate(value=value, low=float("nan"), high=float("nan"), replicas=len(means))


def institution_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """Return the metrics of institutions over replicas, by name, of episodes by replica."""
    return _measures(played, attrgetter("of_institutions"))


def social_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """Return the social metrics over replicas, by name, of episodes by replica."""
    return _measures(played, attrgetter("social"))


def _measures(
    played: Mapping[int, Sequence[Episode]], metrics_of: Callable[[Episode], dict[str, float]]
) -> dict[str, Measured]:
    clock = clock_of(played)
    metrics = by_metric(played, metrics_of)
    return {name: over_replicas(values, name, clock) for name, values in metrics.items()}


def clock_of(played: Mapping[int, Sequence[Episode]]) -> float:
    """Return the steps of an episode that the clock ended, infinity where none was."""
    episodes = (episode for of_replica in played.values() for episode in of_replica)
    return max((episode.steps for episode in episodes if not episode.terminated), default=inf)


def by_metric(
    played: Mapping[int, Sequence[Episode]], metrics_of: Callable[[Episode], dict[str, float]]
) -> dict[str, dict[int, list[float]]]:
    """Return the values of each metric by replica, of episodes by replica."""
    by_replica = {replica: list(map(metrics_of, episodes)) for replica, episodes in played.items()}
    names = next(iter(by_replica.values()))[0]
    return {
        name: {replica: [one[name] for one in episodes] for replica, episodes in by_replica.items()}
        for name in names
    }


def agents_without_harvest(played: Mapping[int, Sequence[Episode]]) -> tuple[int, int] | None:
    """Count the agents of all episodes without a harvest, which sustainability leaves out, and all agents;
    None if the game reports no harvest."""
    harvests = [episode.harvest for episodes in played.values() for episode in episodes]
    apples = [apples for harvest in harvests if harvest is not None for apples in harvest.tolist()]
    return (apples.count(0), len(apples)) if apples else None
