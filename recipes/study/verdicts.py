"""When is a published number, curve or claim contradicted by replicas of ours? A rule for each.

Every verdict is one of

    not contradicted                what was published is what further runs of ours might show
    contradicted                    it is not
    cannot be told with n runs      n replicas are too few

"Not contradicted" is no proof: it says that our replicas do not speak against it. Fewer than `FEWEST`
replicas never give another verdict than the last: with three the prediction interval of one run is already
two and a half times as wide as with endlessly many, and of three nothing can be left out.

A number is contradicted if it lies outside the prediction interval, at 95 %, of the mean of as many runs as
it rests on (`prediction`); if our replicas and the published runs are drawn from one normal
distribution, that happens in 5 % of cases.

A curve is contradicted if its deviation is too large. The deviation of a curve is the root mean square, over
episodes, of its distance to the mean of the others in units of the standard error that a prediction has
there, about 1 for a curve like the others. The published curve's is compared with our own replicas', each
left out in turn and held against all others, the published one among them: so all are treated alike, and if
the published one is drawn as ours are, its deviation is the largest of R + 1 with probability 1 / (R + 1),
whatever the distribution. It is contradicted if it is the largest, above 1, and also lies above the 95 %
prediction interval of the logarithms of ours; made-up runs show how often that happens to curves drawn as
ours are, see docs/results.md. For a mean of two runs, means of two replicas are left out in turn, and the
published curve is held against the same remaining replicas, the median over these.

A claim that something is larger or smaller than something else is contradicted if the 95 % interval of the
mean difference (Student's t) lies on the other side, not contradicted if it lies on the side claimed, and
cannot be told else. A claim that runs show something as a rule is judged likewise by the interval of the
share of replicas that do (`Share`), against a half.

A claim that can be measured by several definitions has their verdict where all give the same; where they do
not, it says so, "depends on the definition" (`judge_shares`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import inf, nan
from typing import Final

import numpy as np

from cprl.measuring.statistics import CONFIDENCE, curve_interval
from cprl.values.array_types import Float64

FEWEST: Final = 4
"""The fewest replicas that give a verdict."""
READING_ERROR: Final = 0.01
"""The error of reading a figure, as a share of its curve's range: the published survival of 1000 steps reads
as 1002, half a percent. Where our replicas are all equal, nothing else is left to measure a distance by."""
NOT_CONTRADICTED: Final = "not contradicted"
CONTRADICTED: Final = "contradicted"
DEPENDS: Final = "depends on the definition"


# Where further runs would lie. A confidence interval says where the mean of endlessly many runs lies. A
# published number rests on one run or two, which lie farther from that mean; where they lie, given m replicas
# of ours with mean x and standard deviation s, says the prediction interval for the mean of n further runs,
#     x +- t(m - 1) s sqrt(1 / m + 1 / n),
# with the quantile of Student's t (G. J. Hahn and W. Q. Meeker, "Statistical Intervals" (1991), chapter 4):
# the confidence interval, sqrt(1 + m / n) times as wide.
# It assumes that the n runs and our m replicas are independent and drawn from the same normal distribution.


@dataclass(frozen=True)
class Prediction:
    """The interval in which the mean of further runs lies; NaN for a single replica."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return bool(self.low <= value <= self.high)

    def __str__(self) -> str:
        """Return the interval, e.g. "[150, 160]"; "" for a single replica."""
        return f"[{self.low:.4g}, {self.high:.4g}]" if np.isfinite(self.low) else ""


def prediction(values: Float64, *, runs: int = 1) -> Prediction:
    """Return the interval in which the mean of `runs` further runs lies with 95 % confidence.

    Args:
        values: one number per replica, [R].
    """
    low, high = curve_prediction(values[:, None], runs=runs)
    return Prediction(float(low[0]), float(high[0]))


def curve_prediction(curves: Float64, *, runs: int = 1) -> tuple[Float64, Float64]:
    """Return the bounds of `prediction` at each episode by itself, [E]; NaN where fewer than two replicas
    have a value.

    Args:
        curves: a curve of E episodes per replica, [R, E]; NaN where undefined.
    """
    middle, low, high = curve_interval(curves)
    replicas = (~np.isnan(curves)).sum(0)
    reach = (high - low) / 2 * np.sqrt(1 + replicas / runs)
    return middle - reach, middle + reach


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of some replicas show something.

    Its interval is that of C. J. Clopper and E. S. Pearson, "The use of confidence or fiducial limits
    illustrated in the case of the binomial" (1934): it contains the true probability at least as often as its
    confidence says, however few replicas there are; for few it is wide.
    """

    count: int
    replicas: int

    @property
    def interval(self) -> tuple[float, float]:
        """Return the bounds of the probability that a replica shows it, 0 to 1."""
        from scipy import stats  # takes as long as torch

        return stats.binomtest(self.count, self.replicas).proportion_ci(CONFIDENCE)

    def __str__(self) -> str:
        """Return e.g. "2 of 8 [0.03, 0.65]"."""
        low, high = self.interval
        return f"{self.count} of {self.replicas} [{low:.2f}, {high:.2f}]"


def cannot_be_told(replicas: int) -> str:
    """Return the verdict that there are too few replicas."""
    return f"cannot be told with {replicas} run{'s' * (replicas != 1)}"


def judge_number(published: float, values: Float64, *, runs: int = 1) -> str:
    """Return the verdict on a published number that is the mean of some runs.

    Args:
        values: the same number of each replica of ours, [R].
    """
    if len(values) < FEWEST:
        return cannot_be_told(len(values))
    return NOT_CONTRADICTED if published in prediction(values, runs=runs) else CONTRADICTED


def judge_bounds(low: float, high: float, *, least: float = -inf, most: float = inf, replicas: int) -> str:
    """Return the verdict on the claim that a number lies between two bounds.

    It is contradicted if all of the number's interval, low to high, lies outside, not contradicted if all of
    it lies between, and cannot be told else.

    Args:
        replicas: the number of replicas, of several samples the least.
    """
    is_inside = least < low and high < most
    is_outside = high < least or low > most
    if replicas < FEWEST or not (is_inside or is_outside):
        return cannot_be_told(replicas)
    return NOT_CONTRADICTED if is_inside else CONTRADICTED


def judge_shares(shares: Sequence[Share]) -> str:
    """Return the verdict on the claim that runs show something as a rule, more than half of them, by each
    definition of it: theirs if it is one, else that it depends on the definition."""
    verdicts = {judge_bounds(*share.interval, least=0.5, replicas=share.replicas) for share in shares}
    return verdicts.pop() if len(verdicts) == 1 else DEPENDS


@dataclass(frozen=True, kw_only=True)
class CurveVerdict:
    """The verdict on a published curve as the mean of some runs, and its reasons; see the module."""

    verdict: str
    deviation: float = nan
    """The deviation of the published curve; NaN with too few replicas, like the next two."""
    others: tuple[float, float] = (nan, nan)
    """The lowest and the highest deviation of our own replicas, or of means of them."""
    limit: float = nan
    """The upper bound of the prediction interval of further deviations."""


def judge_curve(published: Float64, ours: Float64, *, runs: int = 1) -> CurveVerdict:
    """Return the verdict on a published curve.

    Args:
        published: its value at each of P points.
        ours: the values of each replica there, smoothed in the same way, [R, P], all finite.
        runs: the number of runs of which it is the mean, 1 or 2.
    """
    replicas = len(ours)
    if replicas < FEWEST:
        return CurveVerdict(verdict=cannot_be_told(replicas))
    error = READING_ERROR * float(np.ptp(published))
    deviations = _single_deviations if runs == 1 else _pair_deviations
    published_deviation, others = deviations(published, ours, error)
    limit = _limit(others, replicas)
    verdict = CONTRADICTED if published_deviation > max(1.0, limit, *others) else NOT_CONTRADICTED
    return CurveVerdict(
        verdict=verdict,
        deviation=published_deviation,
        others=(min(others), max(others)),
        limit=limit,
    )


def deviation(curve: Float64, others: Float64, *, runs: int, error: float = 0.0) -> float:
    """Return the deviation of a curve from others; see the module.

    Args:
        curve: a mean of some runs at each of P points.
        others: single runs there, [R, P].
        runs: the number of runs of which `curve` is the mean.
        error: of reading a value, in its own unit.
    """
    variance = others.var(0, ddof=1) * (1 / runs + 1 / len(others)) + error**2
    return float(np.sqrt(((curve - others.mean(0)) ** 2 / variance).mean()))


def _single_deviations(published: Float64, ours: Float64, error: float) -> tuple[float, list[float]]:
    """Return the deviations of the published curve and of each replica, each from all others."""
    curves = np.concatenate([published[None], ours])
    first, *others = (
        deviation(curve, np.delete(curves, place, 0), runs=1, error=error)
        for place, curve in enumerate(curves)
    )
    return first, others


def _pair_deviations(published: Float64, ours: Float64, error: float) -> tuple[float, list[float]]:
    """Return the deviations of the published curve, a mean of two runs, and of means of two replicas; from
    those replicas that both leave."""
    published_ones = []
    pairs = []
    for pair in combinations(range(len(ours)), 2):
        rest = np.delete(ours, pair, 0)
        published_ones.append(deviation(published, rest, runs=2, error=error))
        pairs.append(deviation(ours[list(pair)].mean(0), rest, runs=2, error=error))
    return float(np.median(published_ones)), pairs


def _limit(deviations: Sequence[float], replicas: int) -> float:
    """Return the upper bound of the prediction interval of one more deviation, by their logarithms."""
    from scipy import stats  # takes as long as torch

    logs = np.log(deviations)
    quantile = stats.t.ppf((1 + CONFIDENCE) / 2, replicas - 1)
    return float(np.exp(logs.mean() + quantile * logs.std(ddof=1) * np.sqrt(1 + 1 / replicas)))
