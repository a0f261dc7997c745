"""How far are our training curves from the published ones? Each in the published curve's own window."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np
from measures import with_interval
from page import section
from results import TOO_FEW, Result
from verdicts import READING_ERROR, curve_prediction, judge_curve, prediction

from cprl.values.array_types import Float64

FEWEST_POINTS: Final = 10
"""The fewest points of a published curve that are compared."""
RUNS: Final = {"one run": 1, "mean of two runs": 2}
"""The numbers of runs of which a published curve may be the mean."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beside:
    """A published curve, and ours at its points."""

    episodes: Float64
    """[P]"""
    published: Float64
    """[P]"""
    ours: Float64
    """Running means of each replica over the published curve's window, [R, P]."""


def beside(result: Result, metric: str) -> Beside | None:
    """Return a published curve and ours at the episodes that both have; None if there are too few, or the
    metric of a replica is undefined in a whole window."""
    smoothed = result.smoothed(metric)
    episodes, published = result.study.curve(metric)
    is_in_both = episodes < smoothed.shape[1]
    is_short = result.curves[metric].shape[1] <= result.window
    if is_short or is_in_both.sum() < FEWEST_POINTS or np.isnan(smoothed).any():
        return None
    at = episodes[is_in_both]
    ours = np.stack([np.interp(at, np.arange(len(curve)), curve) for curve in smoothed])
    return Beside(episodes=at, published=published[is_in_both], ours=ours)


def sections(results: Sequence[Result]) -> list[str]:
    """Return the sections on the distances from the published curves, and the verdicts on them; nothing
    without runs of the study."""
    distances = ["episodes", "correlation", "mean absolute difference", "of the published curve's range"]
    distances += ["mean, published", "mean, ours", *RUNS]
    verdicts = []
    for runs in RUNS:
        verdicts += [f"{runs}: episodes in its interval", "deviation (ours)", f"verdict, {runs}"]
    note = (
        "Of the published curve as one run, and as the mean of two. The interval is that of "
        "`recipes/study/verdicts.py` at each episode by itself; if the published curve is drawn as ours "
        "are, it holds 95 % of its episodes on average. The deviation, its limit and the rule stand in "
        "`recipes/study/verdicts.py`."
    )
    compared = [
        ([result.name, metric], beside(result, metric))
        for result in results
        for metric in result.study.curves
    ]
    distance_rows = [[*names, *(_distance_cells(pair) if pair else [TOO_FEW])] for names, pair in compared]
    verdict_rows = [[*names, *(_verdict_cells(pair) if pair else [TOO_FEW])] for names, pair in compared]
    return [
        *section("Published curves beside ours", ["run", "metric", *distances], distance_rows),
        *section("Verdicts on the published curves", ["run", "metric", *verdicts], verdict_rows, note),
    ]


def agreement(beside: Beside) -> tuple[float, float]:
    """Return Pearson's correlation, and the mean absolute difference, of a published curve and our mean."""
    ours = beside.ours.mean(0)
    correlation = np.corrcoef(ours, beside.published)[0, 1]
    return float(correlation), float(np.abs(ours - beside.published).mean())


def _distance_cells(beside: Beside) -> list[str]:
    published = beside.published
    correlation, difference = agreement(beside)
    levels = beside.ours.mean(1)
    return [
        f"{beside.episodes[0]:.0f} to {beside.episodes[-1]:.0f}",
        f"{correlation:.2f}" if isfinite(correlation) else "",
        f"{difference:.3g}",
        f"{difference / np.ptp(published):.0%}",
        f"{published.mean():.4g}",
        with_interval(levels),
        *(str(prediction(levels, runs=runs)) for runs in RUNS.values()),
    ]


def _verdict_cells(beside: Beside) -> Iterator[str]:
    published = beside.published
    margin = READING_ERROR * np.ptp(published)
    for runs in RUNS.values():
        judged = judge_curve(published, beside.ours, runs=runs)
        low, high = curve_prediction(beside.ours, runs=runs)
        is_inside = (low - margin <= published) & (published <= high + margin)
        others = "{:.2f} to {:.2f}, limit {:.2f}".format(*judged.others, judged.limit)
        has_enough = isfinite(judged.deviation)
        yield f"{is_inside.mean():.0%}" if has_enough else ""
        yield f"{judged.deviation:.2f} ({others})" if has_enough else ""
        yield judged.verdict
