"""Statistics over replicas: means, differences, and their intervals by Student's t; metrics of episodes.

A replica is one independent repetition of a whole training. Episodes and agents within a replica depend on
each other, so a sample has one value per replica, float64 [R]. Intervals by t of means over several samples
have the degrees of freedom of B. L. Welch, "The generalization of 'Student's' problem when several different
population variances are involved" (1947).
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, compress
from math import inf, isclose, isfinite, isnan, nan
from typing import Any, Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike

from cprl.measuring.registry import METRICS, bounds
from cprl.measuring.social import ROUNDING
from cprl.measuring.table import WINDOWS, all_metrics, by_replica
from cprl.values.array_types import Bool, Float64

CONFIDENCE: Final = 0.95


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number with its interval."""

    value: float
    low: float = nan
    high: float = nan
    """The bounds of the interval; NaN for a single replica."""
    replicas: int
    """The replicas of all samples together, or the pairs of a paired difference; 0 for a number that is
    undefined in all episodes, whose value is NaN."""
    p_value: float = nan
    """The probability of a value at least as far from 0 if it were 0, by the same t, two-sided; NaN for a
    single replica."""
    bounds: tuple[float, float] = (-inf, inf)
    """The lowest and highest number that there can be. Student's t knows no bounds: `low` and `high` may pass
    them."""
    episodes: int = 0
    """The episodes of all replicas together; 0 if they were not counted."""
    undefined: int = 0
    """Episodes in which the number is undefined, and which the mean leaves out."""
    differs: bool = False
    """True for a difference that is not 0 by Holm's method in its family."""

    def bounded(self, metric: str, clock: float = inf) -> Self:
        """Return this estimate with the bounds of a metric, which cut the shown interval."""
        return replace(self, bounds=bounds(metric, clock))

    @property
    def interval(self) -> tuple[float, float]:
        """Return the shown interval, which is cut at the bounds."""
        least = min(self.bounds[0], self.value)
        most = max(self.bounds[1], self.value)
        return max(self.low, least), min(self.high, most)  # NaN stays NaN

    def __neg__(self) -> Self:
        """Return the difference with the opposite sign."""
        least, most = self.bounds
        return replace(self, value=0.0 - self.value, low=-self.high, high=-self.low, bounds=(-most, -least))

    @property
    def reach(self) -> float:
        """Return half the width of the interval: for a difference, the smallest that is significant at 5 %
        with these replicas and their spread; NaN for a single replica."""
        return (self.high - self.low) / 2

    def is_within(self, margin: float) -> bool:
        """Return whether the interval of a difference lies within a margin around 0, so that the two are
        equivalent; choose the margin beforehand."""
        return -margin < self.low and self.high < margin

    @property
    def is_cut(self) -> bool:
        return self.interval != (self.low, self.high) and not isnan(self.low)

    def __str__(self) -> str:
        return format(self)

    def __format__(self, form: str) -> str:
        """Return the value, with its interval if there are several replicas, and the number of undefined
        episodes; the formats "" and "+" choose the digits."""
        if not self.replicas:
            return f"undefined in all {self.episodes} episodes"
        numbers = self.value, *self.interval
        form += number_format(*numbers) if form in ("", "+") else ""
        value, low, high = (f"{number:{form}}" for number in numbers)
        text = f"{value} [{low}, {high}]" if np.isfinite([self.low, self.high]).all() else value
        if self.undefined:
            text += f", undefined in {self.undefined} of {self.episodes} episodes"
        return text


CUT_NOTE: Final = "Bounds of a metric cut an interval where Student's t passes them."
"""The note below a table in which an interval `is_cut`."""
ONE_REPLICA_NOTE: Final = "One replica: no interval."


def number_format(*numbers: float) -> str:
    """Return the format of numbers that are shown together, with two or three digits of the largest."""
    largest = max((abs(number) for number in numbers if isfinite(number)), default=0.0)
    if largest < 0.001:
        return ".3g"
    return f",.{next((digits for digits, size in enumerate((100, 10, 0.5)) if largest >= size), 3)}f"


def estimate(values: ArrayLike) -> Estimate:
    """Return the mean over replicas, of float [R], with its 95 % interval by Student's t.

    Raises:
        ValueError: if there are no replicas, or a value is not finite.
    """
    sample = _sample(values)
    return _estimate(float(sample.mean()) + 0.0, sample)  # turns -0.0 into 0.0


def difference(values: ArrayLike, reference: ArrayLike, *, paired: bool) -> Estimate:
    """Return the difference between two means over replicas, with its 95 % interval.

    Args:
        values: float [R].
        reference: float [R] if paired, else of any number of replicas.
        paired: whether replica r of both had the same random numbers: then the interval is that of the mean
            of differences, else Welch's.

    Raises:
        ValueError: if there are no replicas, a value is not finite, or pairs have unequal numbers of them.
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
        p_values: float [M]; NaN is no comparison.

    Returns:
        bool [M].
    """
    p_values = np.asarray(p_values, np.float64)
    order = np.argsort(p_values)  # NaN comes last
    left = np.count_nonzero(~np.isnan(p_values)) - np.arange(len(order))
    with np.errstate(divide="ignore"):
        is_small = p_values[order] <= (1 - CONFIDENCE) / np.maximum(left, 0)
    differs = np.zeros(len(order), bool)
    differs[order] = np.logical_and.accumulate(is_small)
    return differs


HOLM_NOTE: Final = "* not 0 by Holm's method"
"""The meaning of a star after a difference; "for ..." names the comparisons."""


def curve_interval(curves: ArrayLike) -> tuple[Float64, Float64, Float64]:
    """Return the mean of several curves and its 95 % interval by Student's t at each episode.

    Args:
        curves: float [R, E], a curve of E episodes per replica; NaN where undefined.

    Returns:
        Mean, low and high, float64 [E]; NaN without a value, for low and high also with a single one.
    """
    from scipy import stats

    curves = np.asarray(curves, np.float64)
    defined = ~np.isnan(curves)
    replicas = defined.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):  # NaN without a value, and for the interval of one
        middle = np.where(defined, curves, 0.0).sum(0) / replicas
        squares = np.where(defined, curves - middle, 0.0) ** 2
        error = np.sqrt(squares.sum(0) / (replicas - 1) / replicas)
    reach = stats.t.ppf((1 + CONFIDENCE) / 2, replicas - 1) * error
    return middle, middle - reach, middle + reach


def _estimate(value: float, *samples: Float64) -> Estimate:
    """Return a mean, or a difference of means, with its interval by t and Welch's degrees of freedom.

    `scipy.stats.ttest_1samp` and `ttest_ind` give the same, much slower, and warn of samples without spread.
    """
    from scipy.special import stdtr, stdtrit

    plain = Estimate(value=value, replicas=sum(map(len, samples)))
    if any(len(sample) < 2 for sample in samples):
        return plain
    variances = np.array([sample.var(ddof=1) / len(sample) for sample in samples])
    error = float(variances.sum() ** 0.5)
    if not error:
        return replace(plain, low=value, high=value, p_value=float(value == 0))
    freedoms = np.array([len(sample) - 1 for sample in samples])
    freedom = variances.sum() ** 2 / (variances**2 / freedoms).sum()
    reach = float(stdtrit(freedom, (1 + CONFIDENCE) / 2)) * error
    p_value = 2 * float(stdtr(freedom, -abs(value) / error))
    return replace(plain, low=value - reach, high=value + reach, p_value=p_value)


def _sample(values: ArrayLike) -> Float64:
    sample = np.asarray(values, np.float64)
    if sample.ndim != 1 or not len(sample) or not np.isfinite(sample).all():
        raise ValueError(f"values is {sample.tolist()}; allowed: [R], a finite number for each replica")
    return sample


def notes_on(estimates: Iterable[Estimate]) -> list[str]:
    """Return the notes below a table about the intervals of its numbers."""
    defined = [estimate for estimate in estimates if estimate.replicas]
    is_single = bool(defined) and all(estimate.replicas == 1 for estimate in defined)
    return [ONE_REPLICA_NOTE] * is_single + [CUT_NOTE] * any(estimate.is_cut for estimate in defined)


def estimate_if_finite(means: Sequence[float]) -> Estimate:
    """Return the estimate of means that may not be finite: then their mean without an interval, and NaN for
    none."""
    if means and all(map(isfinite, means)):
        return estimate(means)
    with np.errstate(invalid="ignore"):
        value = float(np.mean(means)) if means else nan
    return Estimate(value=value, replicas=len(means))


Labels = tuple[Any, ...]
Key = tuple[Any, ...]
"""The labels of a row, then the name of a number."""


class Family(Mapping[Key, Estimate]):
    """Estimates by labels and number, e.g. `family["trained", "equality"]`; differences of a family are
    judged together by Holm's method.

    Args:
        estimates: by their keys, in the order of pages.
        by: the names of the labels.
        tests: how many differences were tested together, of which one that two numbers share counts once;
            None for estimates that are not tested.
    """

    def __init__(
        self, estimates: Mapping[Key, Estimate], by: Sequence[str] = (), tests: int | None = None
    ) -> None:
        self._estimates = dict(estimates)
        self.by = tuple(by)
        self.tests = tests

    def __getitem__(self, key: Key | str) -> Estimate:
        return self._estimates[key if isinstance(key, tuple) else (key,)]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._estimates)

    def __len__(self) -> int:
        return len(self._estimates)

    def __repr__(self) -> str:
        lines = (f"{', '.join(map(str, key))}: {estimate}" for key, estimate in self.items())
        return "\n".join(lines)

    @property
    def labels(self) -> list[Labels]:
        """Return the labels of its rows, each once, in order."""
        return list(dict.fromkeys(key[:-1] for key in self))

    @property
    def numbers(self) -> list[str]:
        """Return the names of its numbers, each once, in order."""
        return list(dict.fromkeys(key[-1] for key in self))

    def changed(self, change: Callable[[Key, Estimate], Estimate]) -> "Family":
        """Return the same family with changed estimates, e.g. other bounds."""
        estimates = {key: change(key, estimate) for key, estimate in self.items()}
        return Family(estimates, self.by, self.tests)

    def of(self, *labels: Any) -> dict[str, Estimate]:
        """Return the estimates with these labels by number."""
        return {key[-1]: estimate for key, estimate in self.items() if key[:-1] == labels}

    def column(self, number: str) -> dict[Labels, Estimate]:
        """Return the estimates of a number by their labels."""
        return {key[:-1]: estimate for key, estimate in self.items() if key[-1] == number}

    def note(self, of: str) -> str:
        """Return the meaning of bold; `of` says where these differences stand, e.g. "of this table"."""
        assert self.tests is not None
        number = f"the {self.tests} differences" if self.tests != 1 else "the one difference"
        stands = sum(not isnan(estimate.p_value) for estimate in self.values())
        once = ", of which those that two columns have in common count once" if stands > self.tests else ""
        return (
            f"Bold: not 0 by Holm's method for {number} {of}{once} (two-sided t-tests, "
            f"{1 - CONFIDENCE:.0%} for all together); intervals are of single comparisons."
        )

    def table(self) -> pa.Table:
        """Return a row for each estimate: its labels, "number", and the fields of `Estimate`, null where
        undefined."""
        rows = [
            {**dict(zip(self.by, key, strict=False)), "number": key[-1], **estimate_row(estimate)}
            for key, estimate in self.items()
        ]
        return pa.Table.from_pylist(rows)


ESTIMATE_COLUMNS: Final = ("value", "low", "high", "p_value", "replicas", "episodes", "undefined", "differs")
"""The fields of an estimate that a row of a table has."""


def estimate_row(estimate: Estimate) -> dict[str, float | None]:
    """Return the `ESTIMATE_COLUMNS` of an estimate, None for NaN."""
    values = {name: getattr(estimate, name) for name in ESTIMATE_COLUMNS}
    return {name: None if isnan(value) else value for name, value in values.items()}


def estimates(table: pa.Table, numbers: Sequence[str] | str = (), by: Sequence[str] | str = ()) -> Family:
    """Return the mean of numbers over replicas, each with its interval by Student's t.

    A replica's value is its mean over the episodes in which a number is defined.

    Args:
        table: of episodes or of windows, see `cprl.measuring.table`.
        numbers: the names of the numbers; by default `all_metrics` of the table.
        by: the labels that are kept apart.
    """
    keys = _as_tuple(by)
    names = _as_tuple(numbers) or tuple(all_metrics(table))
    clock = _clock_of(table)
    samples = {name: samples_of(table, name, keys) for name in names}
    labels = dict.fromkeys(chain.from_iterable(samples.values()))
    means = {}
    for row in labels:
        for name in names:
            if row in samples[name]:
                means[*row, name] = samples[name][row].estimate.bounded(name, clock)
    return Family(means, keys)


Reference = Mapping[str, Any] | Callable[[dict[str, Any]], Mapping[str, Any]]
"""The labels that a row is compared with: some with their values, or a function of the row's labels."""


def differences(
    table: pa.Table,
    numbers: Sequence[str] | str,
    by: Sequence[str] | str,
    reference: Reference,
    *,
    paired: bool = True,
) -> Family:
    """Return how much more each number is than that of its reference, with its interval by Student's t.

    Rows that are their own reference, or whose reference is missing, have no difference.

    Args:
        table: the table, see `estimates`.
        numbers: the names of the numbers.
        by: the labels that are kept apart.
        paired: whether replica r of both had the same random numbers: then the interval is that of the mean
            of the replicas' differences, else Welch's.
    """
    keys = _as_tuple(by)
    clock = _clock_of(table)
    changes: dict[Key, Estimate] = {}
    for name in _as_tuple(numbers):
        samples = samples_of(table, name, keys)
        for labels, sample in samples.items():
            row = dict(zip(keys, labels, strict=True))
            reference_labels = reference(row) if callable(reference) else reference
            reference_row = {**row, **reference_labels}
            reference_key = tuple(reference_row[key] for key in keys)
            if reference_key == labels or reference_key not in samples:
                continue
            values = sample.values
            reference_values = samples[reference_key].values
            if paired:
                change = _weighted_sum([(1.0, values), (-1.0, reference_values)])
            elif values and reference_values:
                change = difference(list(values.values()), list(reference_values.values()), paired=False)
            else:
                continue
            if change.replicas:
                least, most = bounds(name, clock)
                changes[(*labels, name)] = replace(change, bounds=(least - most, most - least))
    return judge_family(changes, keys)


CellWeights = Mapping[Any, float]
"""The weights of the rows of a contrast, which sum to 0, by their labels; a single label stands without a
tuple."""


def contrasts(
    table: pa.Table,
    numbers: Sequence[str] | str,
    by: Sequence[str] | str,
    weights: Mapping[str, CellWeights],
) -> Family:
    """Return weighted sums of numbers within each replica, by contrast and number, over the replicas with a
    value in each row of a weight.

    Args:
        table: the table, see `estimates`.
        numbers: the names of the numbers.
        by: the labels that are kept apart.
        weights: the weights by the name of each contrast, see `mean_difference`.
    """
    keys = _as_tuple(by)
    sums: dict[Key, Estimate] = {}
    for number in _as_tuple(numbers):
        samples = samples_of(table, number, keys)
        for name, cells in weights.items():
            weighted_values = []
            for label, weight in cells.items():
                labels = label if isinstance(label, tuple) else (label,)
                if weight:
                    weighted_values.append((weight, samples[labels].values))
            contrast = _weighted_sum(weighted_values)
            if contrast.replicas:
                sums[name, number] = contrast
    return judge_family(sums, ["contrast"])


def _weighted_sum(weighted_values: Sequence[tuple[float, Mapping[int, float]]]) -> Estimate:
    """Return the estimate of a weighted sum of values by replica, over the replicas that have all of them."""
    replicas = set.intersection(*(set(values) for _, values in weighted_values))
    sums = dict.fromkeys(sorted(replicas), 0.0)
    for weight, values in weighted_values:
        for replica in sums:
            sums[replica] += weight * values[replica]
    return estimate_if_finite(list(sums.values()))


def main_effect(levels: Mapping[Any, Any], level: Any, first: Any) -> CellWeights:
    """Return the signs of rows in the effect of a factor: 1 at a level, -1 at the one it is compared with.

    Args:
        levels: the level of each row, by its labels.
    """
    return {row: float(at == level) - float(at == first) for row, at in levels.items()}


def crossed(first: CellWeights, second: CellWeights) -> CellWeights:
    """Return the signs of rows in the interaction of two effects: the products of theirs."""
    return {row: sign * second[row] for row, sign in first.items()}


def mean_difference(signs: CellWeights) -> CellWeights:
    """Return the weights of the mean over rows of sign 1 minus that over as many rows of sign -1."""
    rows = sum(sign > 0 for sign in signs.values())
    return {row: sign / rows for row, sign in signs.items()}


@dataclass
class Sample:
    """The values of a number in several replicas."""

    values: dict[int, float] = field(default_factory=dict)
    """The mean of each replica in which the number is defined."""
    episodes: int = 0
    undefined: int = 0

    @property
    def estimate(self) -> Estimate:
        means = list(self.values.values())
        return replace(estimate_if_finite(means), episodes=self.episodes, undefined=self.undefined)


def samples_of(table: pa.Table, number: str, by: Sequence[str]) -> dict[Labels, Sample]:
    """Return the values of a number in each replica, by labels."""
    samples: dict[Labels, Sample] = defaultdict(Sample)
    for row in by_replica(table, number, by).to_pylist():
        sample = samples[tuple(row[name] for name in by)]
        sample.episodes += row["episodes"]
        sample.undefined += row["undefined"]
        if row["value"] is not None:
            sample.values[row["replica"]] = row["value"]
    return samples


def _as_tuple(names: Sequence[str] | str) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _clock_of(table: pa.Table) -> float:
    """Return the steps of an episode that the clock ended; infinity if there is none."""
    columns = {*table.column_names}
    if WINDOWS in columns or not {"terminated", "steps"} <= columns:
        return inf
    steps = table.filter(pc.invert(table["terminated"]))["steps"]
    return float(pc.max(steps).as_py()) if len(steps) else inf


def judge_family(differences: Mapping[Key, Estimate], by: Sequence[str] = ()) -> Family:
    """Return differences as a family, judged together by Holm's method.

    A difference that equals that of the metric in `Metric.same_as` is the same test, and counts once.
    """
    tests: dict[Key, list[Key]] = {}
    for key, change in differences.items():
        if isnan(change.p_value):
            continue
        metric = METRICS.get(key[-1])
        same = (*key[:-1], metric.same_as if metric else None)
        if same in tests and _is_same(change, differences[same]):
            tests[same].append(key)
        else:
            tests[key] = [key]
    differ = holm([differences[key].p_value for key in tests])
    marked = set(chain.from_iterable(compress(tests.values(), differ)))
    family = {key: replace(change, differs=key in marked) for key, change in differences.items()}
    return Family(family, by, len(tests))


def _is_same(first: Estimate, second: Estimate) -> bool:
    """Return whether two estimates are equal up to the rounding of payments."""
    pairs = zip((first.value, first.low, first.high), (second.value, second.low, second.high), strict=True)
    return all(isclose(a, b, rel_tol=ROUNDING, abs_tol=ROUNDING) for a, b in pairs)
