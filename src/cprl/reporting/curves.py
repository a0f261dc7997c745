"""The published curves beside ours, each under its own window: tables of windows, distances and verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.predictions import curve_prediction, prediction
from cprl.measuring.published import EXPERIMENTS, agreement, curve
from cprl.measuring.running_means import estimate_window
from cprl.reporting import verdicts
from cprl.reporting.claims import with_interval
from cprl.reporting.markdown import table
from cprl.reporting.result import TOO_FEW, Result
from cprl.runs.curves import running_mean

Values = NDArray[np.float64]

FEWEST_POINTS: Final = 10
"""The fewest points of a published curve that are compared."""
RUNS: Final = (1, 2)
"""The numbers of runs of which a published number or curve may be the mean."""
PARTS: Final = ((500, 1000), (-500, None))
"""Parts of a training whose mean return is shown, first and last episode."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Beside:
    """A published curve, and ours at its points."""

    at: Values
    """The episodes, [P]."""
    published: Values
    """[P]"""
    ours: Values
    """Running means of each replica over the published curve's window, [R, P]."""


def beside(result: Result, metric: str) -> Beside | None:
    """A published curve and ours at the episodes that both have; None if there are too few, or the metric of
    a replica is undefined in a whole window."""
    assert result.study is not None
    own = running_mean(result.curves[metric], result.window)
    at, published = curve(result.study.curves[metric])
    both = at <= own.shape[1] - 1
    if result.curves[metric].shape[1] <= result.window or both.sum() < FEWEST_POINTS or np.isnan(own).any():
        return None
    episodes = np.arange(own.shape[1])
    ours = np.stack([np.interp(at[both], episodes, values) for values in own])
    return Beside(at=at[both], published=published[both], ours=ours)


def windows() -> list[str]:
    """The section on the windows of the published curves."""
    rows = []
    for study in EXPERIMENTS:
        for metric, name in study.curves.items():
            found = estimate_window(*curve(name))
            rows.append(
                [
                    f"{study.number}",
                    metric,
                    f"{found.window_episodes}",
                    f"{found.better_by_nats:.1f}",
                    f"{found.nats[100]:.0f}",
                ]
            )
    head = ["experiment", "metric", "window, episodes", "nats better than the next", "than 100"]
    note = "How they are found: `cprl.measuring.running_means`; candidates are 15, 20 .. 250 episodes."
    return ["## Windows of the published curves", "", note, "", *table(head, rows)]


def distances(results: Sequence[Result]) -> list[str]:
    """The section on the distances between the published curves and ours; empty without runs of the study."""
    rows = []
    for result, metric in _compared(results):
        found = beside(result, metric)
        if found is None:
            rows.append([result.name, metric, TOO_FEW, *[""] * 8])
            continue
        assert result.study is not None
        own, published = running_mean(result.curves[metric], result.window).mean(0), found.published
        correlation, off = agreement(result.study.curves[metric], own)
        levels = found.ours.mean(1)
        rows.append(
            [
                result.name,
                metric,
                f"{found.at[0]:.0f} to {found.at[-1]:.0f}",
                f"{correlation:.2f}" if np.isfinite(correlation) else "",
                f"{off:.3g}",
                f"{off / np.ptp(published):.0%}",
                f"{published.mean():.4g}",
                with_interval(levels),
                *(f"{prediction(levels, runs=runs)}" for runs in RUNS),
            ]
        )
    head = ["run", "metric", "episodes", "correlation", "mean absolute difference"]
    head += ["of the published curve's range", "mean, published", "mean, ours", "one run", "mean of two runs"]
    return _section("Published curves beside ours", "", head, rows)


def judged(results: Sequence[Result]) -> list[str]:
    """The section with a verdict on each published curve; empty without runs of the study."""
    rows = []
    for result, metric in _compared(results):
        found = beside(result, metric)
        if found is None:
            rows.append([result.name, metric, TOO_FEW, *[""] * 6])
            continue
        cells = [result.name, metric]
        for runs in RUNS:
            of_curve = verdicts.of_curve(found.published, found.ours, runs=runs)
            _, low, high = curve_prediction(found.ours, runs=runs)
            margin = verdicts.READ * np.ptp(found.published)
            inside = (low - margin <= found.published) & (found.published <= high + margin)
            others = "{:.2f} to {:.2f}, limit {:.2f}".format(*of_curve.others, of_curve.limit)
            told = np.isfinite(of_curve.deviation)
            cells += [
                f"{inside.mean():.0%}" if told else "",
                f"{of_curve.deviation:.2f} ({others})" if told else "",
                of_curve.verdict,
            ]
        rows.append(cells)
    head = ["run", "metric"]
    for what in ("one run", "mean of two runs"):
        head += [f"{what}: episodes in its interval", "deviation (ours)", f"verdict, {what}"]
    note = (
        "Of the published curve as one run, and as the mean of two. The interval is that of "
        "`cprl.measuring.predictions` at each episode by itself; if the published curve is drawn as ours "
        "are, it holds 95 % of its episodes on average. The deviation, its limit and the rule stand in "
        "`cprl.reporting.verdicts`."
    )
    return _section("Verdicts on the published curves", note, head, rows)


def parts(results: Sequence[Result]) -> list[str]:
    """The section on the mean collective return in parts of a training; empty without runs of the study."""
    rows = []
    for result, metric in _compared(results, only=("collective_return",)):
        found = beside(result, metric)
        if found is None:
            continue
        own = result.curves[metric]
        first = [f"{found.published[0]:.4g}", with_interval(found.ours[:, 0])]
        cells = [result.name, f"{found.at[0]:.0f}", *first]
        for begin, end in PARTS:
            part = own[:, begin:end]
            whole = own.shape[1] >= (end or -begin)
            cells += [_published_part(result, begin, end), with_interval(part.mean(1)) if whole else TOO_FEW]
        rows.append(cells)
    head = ["run", "first point at episode", "published", "ours, same window"]
    head += ["500 to 1000, published", "ours", "last 500, published", "ours"]
    note = "Apples; intervals are of the mean over replicas."
    return _section("Collective return in parts of the training", note, head, rows)


def _published_part(result: Result, begin: int, end: int | None) -> str:
    """The published curve's mean over episodes of the part; the window blurs its edges."""
    assert result.study is not None
    at, values = curve(result.study.curves["collective_return"])
    if end is None:
        begin = result.study.episodes + begin - result.window
    inside = (at >= begin) & (at <= (np.inf if end is None else end - result.window))
    return f"{values[inside].mean():.4g}"


def _compared(results: Sequence[Result], only: Sequence[str] = ()) -> list[tuple[Result, str]]:
    return [
        (result, metric)
        for result in results
        if result.study
        for metric in result.study.curves
        if not only or metric in only
    ]


def _section(title: str, note: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    if not rows:
        return []
    return [f"## {title}", "", *([note, ""] if note else []), *table(head, rows)]
