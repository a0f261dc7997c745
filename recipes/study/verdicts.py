"""Verdicts on published numbers, curves and claims, beside replicas of ours; each by one rule.

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
share of replicas that do (`share`), against a half.

A claim that can be measured by several definitions has their verdict where all give the same; where they do
not, it says so, "depends on the definition" (`of_definitions`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.statistics import CONFIDENCE

Values = NDArray[np.float64]

FEWEST: Final = 4
"""The fewest replicas that give a verdict."""
READ: Final = 0.01
"""The error of reading a figure, as a share of its curve's range: the published survival of 1000 steps reads
as 1002, half a percent. Where our replicas are all equal, nothing else is left to measure a distance by."""
NOT_CONTRADICTED: Final = "not contradicted"
CONTRADICTED: Final = "contradicted"
DEPENDS: Final = "depends on the definition"


# Where further runs would lie. A confidence interval says where the mean of endlessly many runs lies. A
# published number rests on one run or two, which lie farther from that mean; where they lie, given m replicas
# of ours with mean x and standard deviation s, says the prediction interval for the mean of n further runs,
#     x +- t(m - 1) s sqrt(1 / m + 1 / n),
# with the quantile of Student's t (G. J. Hahn and W. Q. Meeker, "Statistical Intervals" (1991), chapter 4).
# It assumes that the n runs and our m replicas are independent and drawn from the same normal distribution.


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


def prediction(values: Values, *, runs: int | None = 1) -> Prediction:
    """Return the interval in which the mean of `runs` further runs lies with 95 % confidence.

    Args:
        values: one number per replica, [R].
        runs: the number of further runs; None for endlessly many.
    """
    middle, low, high = curve_prediction(values[:, None], runs=runs)
    return Prediction(
        value=float(middle[0]), low=float(low[0]), high=float(high[0]), replicas=len(values), runs=runs
    )


def curve_prediction(curves: Values, *, runs: int | None = 1) -> tuple[Values, Values, Values]:
    """Return `prediction` at each episode by itself.

    Args:
        curves: a curve of E episodes per replica, [R, E]; NaN where undefined.
        runs: the number of further runs; None for endlessly many.

    Returns:
        Mean, low and high, [E]; NaN where no replica has a value, for low and high also where only one has.
    """
    of_runs = 0.0 if runs is None else 1 / runs
    defined = ~np.isnan(curves)
    number = defined.sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.where(defined, curves, 0.0).sum(0) / number
        variance = np.where(defined, (curves - middle) ** 2, 0.0).sum(0) / (number - 1)
        reach = _t(number - 1) * np.sqrt(variance * (1 / number + of_runs))
    return middle, middle - reach, middle + reach


def _t(freedom: NDArray[Any]) -> Values:
    """The quantile of Student's t that encloses 95 %, [...]; NaN without a degree of freedom."""
    from scipy import stats  # takes as long as torch

    different, place = np.unique(freedom, return_inverse=True)
    quantiles = [stats.t.ppf((1 + CONFIDENCE) / 2, one) if one > 0 else np.nan for one in different.tolist()]
    found: Values = np.array(quantiles)[place]
    return found


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of some replicas show something."""

    shown: int
    replicas: int
    low: float
    high: float
    """The bounds of the interval of the probability that a replica shows it, 0 to 1."""

    @property
    def value(self) -> float:
        """The share, 0 to 1."""
        return self.shown / self.replicas

    def __str__(self) -> str:
        """For example "2 of 8 [0.03, 0.65]"."""
        return f"{self.shown} of {self.replicas} [{self.low:.2f}, {self.high:.2f}]"


def share(shown: int, replicas: int) -> Share:
    """A share of replicas with the interval of C. J. Clopper and E. S. Pearson, "The use of confidence or
    fiducial limits illustrated in the case of the binomial" (1934).

    The interval contains the true probability at least as often as its confidence says, however few replicas
    there are; for few it is wide.
    """
    from scipy import stats  # takes as long as torch

    margin = (1 - CONFIDENCE) / 2
    return Share(
        shown=shown,
        replicas=replicas,
        low=float(stats.beta.ppf(margin, shown, replicas - shown + 1)) if shown else 0.0,
        high=float(stats.beta.ppf(1 - margin, shown + 1, replicas - shown)) if shown < replicas else 1.0,
    )


def cannot_be_told(replicas: int) -> str:
    """The verdict that there are too few replicas."""
    return f"cannot be told with {replicas} run{'s' * (replicas != 1)}"


def of_number(published: float, values: Values, *, runs: int = 1) -> str:
    """The verdict on a published number that is the mean of some runs.

    Args:
        published: the number.
        values: the same number of each replica of ours, [R].
        runs: the number of runs that the published one is the mean of.
    """
    if len(values) < FEWEST:
        return cannot_be_told(len(values))
    return NOT_CONTRADICTED if published in prediction(values, runs=runs) else CONTRADICTED


def of_claim(
    low: float, high: float, *, above: float | None = None, below: float | None = None, replicas: int
) -> str:
    """The verdict on the claim that a mean lies above or below a bound.

    Args:
        low: the lower bound of its interval.
        high: the upper bound.
        above: the bound that it is claimed to exceed, or
        below: the bound that it is claimed to stay below.
        replicas: the number of replicas, of several samples the least.
    """
    if above is None:
        assert below is not None
        low, high, above = -high, -low, -below
    if replicas < FEWEST or not (low > above or high < above):
        return cannot_be_told(replicas)
    return NOT_CONTRADICTED if low > above else CONTRADICTED


def of_likeness(low: float, high: float, *, within: tuple[float, float], replicas: int) -> str:
    """The verdict on the claim that a mean lies between two bounds: contradicted if all of its interval, low
    to high, lies outside, not contradicted if all of it lies between, and cannot be told else."""
    inside, outside = within[0] <= low and high <= within[1], high < within[0] or low > within[1]
    if replicas < FEWEST or not (inside or outside):
        return cannot_be_told(replicas)
    return NOT_CONTRADICTED if inside else CONTRADICTED


def of_share(found: Share) -> str:
    """The verdict on the claim that runs show something as a rule, more than half of them."""
    return of_claim(found.low, found.high, above=0.5, replicas=found.replicas)


def of_definitions(each: Sequence[str]) -> str:
    """The verdict on a claim that is measured by several definitions, from the verdict by each: theirs if it
    is one, else that it depends on the definition."""
    first, *others = each
    return first if set(others) <= {first} else DEPENDS


@dataclass(frozen=True, kw_only=True)
class CurveVerdict:
    """The verdict on a published curve as the mean of some runs, and its reasons; see the module."""

    verdict: str
    deviation: float
    """The deviation of the published curve; NaN with too few replicas, like the next two."""
    others: tuple[float, float]
    """The lowest and the highest deviation of our own replicas, or of means of them."""
    limit: float
    """The upper bound of the prediction interval of further deviations."""


def of_curve(published: Values, ours: Values, *, runs: int = 1) -> CurveVerdict:
    """The verdict on a published curve.

    Args:
        published: its value at each of P points.
        ours: the values of each replica there, smoothed in the same way, [R, P], all finite.
        runs: the number of runs of which it is the mean, 1 or 2.
    """
    replicas = len(ours)
    if replicas < FEWEST:
        nothing = float("nan")
        return CurveVerdict(
            verdict=cannot_be_told(replicas), deviation=nothing, others=(nothing, nothing), limit=nothing
        )
    read = READ * float(np.ptp(published))
    own, others = _alone(published, ours, read) if runs == 1 else _in_pairs(published, ours, read)
    limit = _limit(others, replicas)
    contradicted = own > max(1.0, limit, *others)
    return CurveVerdict(
        verdict=CONTRADICTED if contradicted else NOT_CONTRADICTED,
        deviation=own,
        others=(float(min(others)), float(max(others))),
        limit=limit,
    )


def deviation(curve: Values, others: Values, *, runs: int, read: float = 0.0) -> float:
    """The deviation of a curve from others; see the module.

    Args:
        curve: a mean of some runs at each of P points.
        others: single runs there, [R, P].
        runs: the number of runs of which `curve` is the mean.
        read: the error of a value, in its own unit.
    """
    variance = others.var(0, ddof=1) * (1 / runs + 1 / len(others)) + read**2
    return float(np.sqrt(((curve - others.mean(0)) ** 2 / variance).mean()))


def _alone(published: Values, ours: Values, read: float) -> tuple[float, list[float]]:
    """The deviations of the published curve and of each replica, each from all others."""
    everyone = np.concatenate([published[None], ours])
    found = [
        deviation(curve, np.delete(everyone, nth, 0), runs=1, read=read) for nth, curve in enumerate(everyone)
    ]
    return found[0], found[1:]


def _in_pairs(published: Values, ours: Values, read: float) -> tuple[float, list[float]]:
    """The deviations of the published curve, a mean of two runs, and of means of two replicas; from those
    replicas that both leave."""
    own, others = [], []
    for pair in combinations(range(len(ours)), 2):
        rest = np.delete(ours, pair, 0)
        own.append(deviation(published, rest, runs=2, read=read))
        others.append(deviation(ours[list(pair)].mean(0), rest, runs=2, read=read))
    return float(np.median(own)), others


def _limit(deviations: Sequence[float], replicas: int) -> float:
    """The upper bound of the prediction interval of one more deviation, by their logarithms."""
    from scipy import stats  # takes as long as torch

    logs = np.log(deviations)
    quantile = float(stats.t.ppf((1 + CONFIDENCE) / 2, replicas - 1))
    return float(np.exp(logs.mean() + quantile * logs.std(ddof=1) * np.sqrt(1 + 1 / replicas)))
