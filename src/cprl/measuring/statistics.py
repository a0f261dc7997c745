"""Statistics over replicas: means, differences, and their intervals by Student's t; metrics of episodes.

A replica is one independent repetition of a whole training. Episodes and agents within a replica depend on
each other, so that values are float64 [R], one number per replica. Intervals by t of means over several
samples have the degrees of freedom of B. L. Welch, "The generalization of 'Student's' problem when several
different population variances are involved" (1947).
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, compress
from math import inf, isclose, isfinite, isnan, nan
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from cprl.measuring.registry import METRICS, bounds
from cprl.measuring.table import by_replica, clock_of, numbers_in
from cprl.values.arrays import Bool, Float64

CONFIDENCE: Final = 0.95


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its interval."""

    value: float
    low: float = nan
    high: float = nan
    """The bounds of the interval; NaN for a single replica."""
    replicas: int
    """Of all samples together; of paired differences, the pairs; 0 of a number that is undefined in all
    episodes, whose value is NaN."""
    p_value: float = nan
    """How often a value at least as far from 0 would come by chance if it were 0, by the same t, two-sided;
    NaN for a single replica."""
    bounds: tuple[float, float] = (-inf, inf)
    """What the number can be. Student's t knows no bounds: `low` and `high` may pass them."""
    episodes: int = 0
    """Of all replicas together; 0 where nobody counted them."""
    undefined: int = 0
    """Episodes in which the number is undefined; they are no part of a mean."""
    differs: bool = False
    """Of a difference: whether it is not 0 by Holm's method in its family."""

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

    def __neg__(self) -> Self:
        """Return this difference the other way round."""
        least, most = self.bounds
        bounds_of_it = (-most, -least)
        return replace(self, value=0.0 - self.value, low=-self.high, high=-self.low, bounds=bounds_of_it)

    @property
    def reach(self) -> float:
        """How far its interval goes on each side: of a difference, the smallest that so many replicas with as
        much spread would have told from 0 at 5 %, alone; NaN for a single replica."""
        return (self.high - self.low) / 2

    def is_within(self, margin: float) -> bool:
        """Return whether the interval of a difference lies within a margin that was said beforehand on both
        sides of 0, so that the two are equivalent."""
        return -margin < self.low and self.high < margin

    @property
    def is_cut(self) -> bool:
        return self.interval != (self.low, self.high) and not isnan(self.low)

    def __str__(self) -> str:
        return format(self)

    def __format__(self, form: str) -> str:
        """Return the value with its interval, of a single replica the value alone, and in how many episodes
        it is undefined; "" and "+" choose the digits."""
        if not self.replicas:
            return f"undefined in all {self.episodes} episodes"
        numbers = self.value, *self.interval
        form += form_for(*numbers) if form in ("", "+") else ""
        value, low, high = (f"{number:{form}}" for number in numbers)
        text = f"{value} [{low}, {high}]" if np.isfinite([self.low, self.high]).all() else value
        if self.undefined:
            text += f", undefined in {self.undefined} of {self.episodes} episodes"
        return text


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
    first = _sample(values)
    second = _sample(reference)
    if not paired:
        return _estimate(float(first.mean() - second.mean()), first, second)
    if len(first) != len(second):
        raise ValueError(
            f"values has {len(first)} replicas and reference {len(second)}; allowed in pairs: as many"
        )
    return estimate(first - second)


def holm(p_values: ArrayLike) -> Bool:
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
"""What a star after a difference means; "for ..." says which comparisons."""


def curve_interval(curves: ArrayLike) -> tuple[Float64, Float64, Float64]:
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


def _estimate(value: float, *samples: Float64) -> Estimate:
    """Return a mean, or the difference of two, with its interval by t, of the degrees of freedom of Welch.

    `scipy.stats.ttest_1samp` and `ttest_ind` give the same, much slower, and warn of samples without spread.
    """
    from scipy.special import stdtr, stdtrit

    one = Estimate(value=value, replicas=sum(map(len, samples)))
    if any(len(sample) < 2 for sample in samples):
        return one
    parts = np.array([sample.var(ddof=1) / len(sample) for sample in samples])
    error = float(parts.sum() ** 0.5)
    if not error:
        return replace(one, low=value, high=value, p_value=float(value == 0))
    freedoms = np.array([len(sample) - 1 for sample in samples])
    freedom = parts.sum() ** 2 / (parts**2 / freedoms).sum()
    reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * error
    p_value = 2 * float(stdtr(freedom, -abs(value) / error))
    return replace(one, low=value - reach, high=value + reach, p_value=p_value)


def _sample(values: ArrayLike) -> Float64:
    sample = np.asarray(values, np.float64)
    if sample.ndim != 1 or not len(sample) or not np.isfinite(sample).all():
        raise ValueError(f"values is {sample.tolist()}; allowed: [R], a finite number for each replica")
    return sample


def notes_on(estimates: Iterable[Estimate]) -> list[str]:
    """Return what a table of numbers says once of their intervals."""
    shown = [one for one in estimates if one.replicas]
    is_single = bool(shown) and all(one.replicas == 1 for one in shown)
    return [ONE_REPLICA] * is_single + [CUT] * any(one.is_cut for one in shown)


def estimate_if_finite(means: Sequence[float]) -> Estimate:
    """Return the estimate of means that may not be finite; then it is their mean, without an interval, and
    NaN of none."""
    if means and all(map(isfinite, means)):
        return estimate(means)
    with np.errstate(invalid="ignore"):
        value = float(np.mean(means)) if means else nan
    return Estimate(value=value, replicas=len(means))


Labels = tuple[Any, ...]
Key = tuple[Any, ...]
"""The labels of a row, then the name of a number."""


class Family(Mapping[Key, Estimate]):
    """Estimates by labels and number, e.g. `family["trained", "equality"]`; of differences, those that Holm's
    method judges together.

    Args:
        estimates: by their keys, in the order of pages.
        by: the names of the labels.
        name: of differences, which they are, e.g. "differences from random".
        tests: how many differences were tested together; one that two numbers have in common counts once.
    """

    def __init__(
        self, estimates: Mapping[Key, Estimate], by: Sequence[str] = (), name: str = "", tests: int = 0
    ) -> None:
        self._estimates = dict(estimates)
        self.by = tuple(by)
        self.name = name
        self.tests = tests

    def __getitem__(self, key: Key | str) -> Estimate:
        return self._estimates[key if isinstance(key, tuple) else (key,)]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._estimates)

    def __len__(self) -> int:
        return len(self._estimates)

    def __repr__(self) -> str:
        lines = (f"{', '.join(map(str, key))}: {one}" for key, one in self.items())
        return "\n".join(lines)

    @property
    def labels(self) -> list[Labels]:
        """The labels of its rows, each once, in order."""
        return list(dict.fromkeys(key[:-1] for key in self))

    @property
    def numbers(self) -> list[str]:
        """The names of its numbers, each once, in order."""
        return list(dict.fromkeys(key[-1] for key in self))

    def changed(self, change: Callable[[Key, Estimate], Estimate]) -> "Family":
        """Return the same family of changed estimates, e.g. of other bounds."""
        estimates = {key: change(key, one) for key, one in self.items()}
        return Family(estimates, self.by, self.name, self.tests)

    def of(self, *labels: Any) -> dict[str, Estimate]:
        """Return the estimates with these labels by number."""
        return {key[-1]: one for key, one in self.items() if key[:-1] == labels}

    def note(self, of: str) -> str:
        """Return what bold means; `of` says where these differences stand, e.g. "of this table"."""
        number = f"the {self.tests} differences" if self.tests != 1 else "the one difference"
        stands = sum(not isnan(one.p_value) for one in self.values())
        once = ", of which those that two columns have in common count once" if stands > self.tests else ""
        return (
            f"Bold: not 0 by Holm's method for {number} {of}{once} (two-sided t-tests, "
            f"{1 - CONFIDENCE:.0%} for all together); intervals are of single comparisons."
        )

    def table(self) -> pa.Table:
        """Return a row for each estimate: its labels, "number", and the fields of `Estimate`, null where
        undefined."""
        rows = [
            {**dict(zip(self.by, key, strict=False)), "number": key[-1], **numbers_of(one)}
            for key, one in self.items()
        ]
        return pa.Table.from_pylist(rows)


NUMBERS: Final = ("value", "low", "high", "p_value", "replicas", "episodes", "undefined", "differs")
"""What a row of a table has of an estimate."""


def numbers_of(one: Estimate) -> dict[str, float | None]:
    """Return the `NUMBERS` of an estimate, None where one is NaN."""
    values = {name: getattr(one, name) for name in NUMBERS}
    return {name: None if isnan(value) else value for name, value in values.items()}


def estimates(table: pa.Table, numbers: Sequence[str] | str = (), by: Sequence[str] | str = ()) -> Family:
    """Return the mean of numbers over replicas, each with its interval by Student's t.

    A replica's value is its mean over the episodes in which a number is defined.

    Args:
        table: of episodes or of windows, see `cprl.measuring.table`.
        numbers: their names; by default all `numbers_in` the table.
        by: the labels that are kept apart.
    """
    keys = _listed(by)
    names = _listed(numbers) or tuple(numbers_in(table))
    clock = clock_of(table)
    samples = {name: _samples(table, name, keys) for name in names}
    labels = dict.fromkeys(chain.from_iterable(samples.values()))
    means = {
        (*each, name): samples[name][each].estimate.of(name, clock)
        for each in labels
        for name in names
        if each in samples[name]
    }
    return Family(means, keys)


Reference = Mapping[str, Any] | Callable[[dict[str, Any]], Mapping[str, Any]]
"""The labels of what a row is compared with: some with their values, or a function of the row's labels."""


def differences(
    table: pa.Table,
    numbers: Sequence[str] | str,
    by: Sequence[str] | str,
    reference: Reference,
    *,
    paired: bool = True,
    family: str = "",
) -> Family:
    """Return how much more each number is than that of its reference, with its interval by Student's t.

    Rows whose reference is themselves, or is not there, have no difference.

    Args:
        table: as in `estimates`.
        numbers: likewise, their names.
        by: likewise, the labels that are kept apart.
        paired: whether replica r of both had the same chance: then the interval is that of the mean of the
            replicas' differences, else Welch's.
        family: what the differences of this call are, which Holm's method judges all together.
    """
    keys = _listed(by)
    clock = clock_of(table)
    changes: dict[Key, Estimate] = {}
    for name in _listed(numbers):
        samples = _samples(table, name, keys)
        for labels, sample in samples.items():
            row = dict(zip(keys, labels, strict=True))
            other = {**row, **(reference(row) if callable(reference) else reference)}
            home = tuple(other[key] for key in keys)
            if home == labels or home not in samples:
                continue
            values = sample.values
            usual = samples[home].values
            if paired:
                change = _weighted_sum([(1.0, values), (-1.0, usual)])
            elif values and usual:
                change = difference(list(values.values()), list(usual.values()), paired=False)
            else:
                continue
            if change.replicas:
                changes[(*labels, name)] = change.between(name, clock)
    return judged(changes, keys, family)


Weights = Mapping[Any, float]
"""What the rows of a contrast count in it, by their labels; together 0. Of one label, its value alone."""


def contrasts(
    table: pa.Table,
    numbers: Sequence[str] | str,
    by: Sequence[str] | str,
    weights: Mapping[str, Weights],
    *,
    family: str = "",
) -> Family:
    """Return weighted sums of numbers within each replica, by the name of the contrast and the number, over
    the replicas that have a value in each row that counts.

    Args:
        table: as in `estimates`.
        numbers: likewise, their names.
        by: likewise, the labels that are kept apart.
        weights: by the name of each contrast, see `mean_difference`.
        family: what the contrasts of this call are, which Holm's method judges all together.
    """
    keys = _listed(by)
    sums: dict[Key, Estimate] = {}
    for number in _listed(numbers):
        samples = _samples(table, number, keys)
        for name, of_rows in weights.items():
            rows = {labels if isinstance(labels, tuple) else (labels,): of_rows[labels] for labels in of_rows}
            parts = [(weight, samples[labels].values) for labels, weight in rows.items() if weight]
            one = _weighted_sum(parts)
            if one.replicas:
                sums[name, number] = one
    return judged(sums, ["contrast"], family)


def _weighted_sum(parts: Sequence[tuple[float, Mapping[int, float]]]) -> Estimate:
    """Return the estimate of a weighted sum of values by replica, over the replicas that have all of them."""
    replicas = set.intersection(*(set(values) for _, values in parts))
    sums = [sum(weight * values[replica] for weight, values in parts) for replica in sorted(replicas)]
    return estimate_if_finite(sums)


def main_effect(levels: Mapping[Any, Any], level: Any, first: Any) -> Weights:
    """Return the signs of rows in the effect of a factor: 1 at a level, -1 at the one it is compared with.

    Args:
        levels: the level of each row, by its labels.
    """
    return {row: float(at == level) - float(at == first) for row, at in levels.items()}


def crossed(one: Weights, other: Weights) -> Weights:
    """Return the signs of rows in the interaction of two effects: the products of theirs."""
    return {row: sign * other[row] for row, sign in one.items()}


def mean_difference(signs: Weights) -> Weights:
    """Return the weights of the mean over rows of sign 1 minus that over as many rows of sign -1."""
    rows = sum(sign > 0 for sign in signs.values())
    return {row: sign / rows for row, sign in signs.items()}


@dataclass
class _Sample:
    """A number of some replicas."""

    values: dict[int, float] = field(default_factory=dict)
    """The mean of each replica in which it is defined."""
    episodes: int = 0
    undefined: int = 0

    @property
    def estimate(self) -> Estimate:
        means = list(self.values.values())
        return replace(estimate_if_finite(means), episodes=self.episodes, undefined=self.undefined)


def _samples(table: pa.Table, number: str, by: Sequence[str]) -> dict[Labels, _Sample]:
    """Return a number of the replicas of each choice of labels."""
    samples: dict[Labels, _Sample] = defaultdict(_Sample)
    for row in by_replica(table, number, by).to_pylist():
        sample = samples[tuple(row[name] for name in by)]
        sample.episodes += row["episodes"]
        sample.undefined += row["undefined"]
        if row["value"] is not None:
            sample.values[row["replica"]] = row["value"]
    return samples


def _listed(names: Sequence[str] | str) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def judged(differences: Mapping[Key, Estimate], by: Sequence[str] = (), name: str = "") -> Family:
    """Return differences as a family, each with whether it is not 0 by Holm's method for all of them.

    One that equals that of the metric which its own is `same_as` is the same test, and counts once.
    """
    tests: dict[Key, list[Key]] = {}
    for key, one in differences.items():
        if isnan(one.p_value):
            continue
        metric = METRICS.get(key[-1])
        same = (*key[:-1], metric.same_as if metric else None)
        is_same = same in tests and _is_same(one, differences[same])
        tests.setdefault(same if is_same else key, []).append(key)
    differ = holm([differences[key].p_value for key in tests])
    marked = set(chain.from_iterable(compress(tests.values(), differ)))
    family = {key: replace(one, differs=key in marked) for key, one in differences.items()}
    return Family(family, by, name or f"these {len(tests)} differences", len(tests))


_ROUNDING: Final = 1e-6
"""What payments of float32 round off, of a value."""


def _is_same(one: Estimate, other: Estimate) -> bool:
    pairs = zip((one.value, one.low, one.high), (other.value, other.low, other.high), strict=True)
    return all(isclose(a, b, rel_tol=_ROUNDING, abs_tol=_ROUNDING) for a, b in pairs)
