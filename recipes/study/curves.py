"""Published numbers and curves beside ours: appendix A, curves under their own windows, turning points."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Final

import numpy as np
import phases
import verdicts
from numpy.typing import NDArray
from phases import PHASES_BEGIN
from published import EXPERIMENTS, agreement, curve, estimate_window, published_experiment
from results import (
    EPISODES,
    PUBLISHED_EPISODES,
    TOO_FEW,
    Result,
    returns_by_chance,
    table,
    with_interval,
)
from verdicts import curve_prediction, prediction

from cprl.measuring.windows import running_mean

Values = NDArray[np.float64]

FEWEST_POINTS: Final = 10
"""The fewest points of a published curve that are compared."""
RUNS: Final = (1, 2)
"""The numbers of runs of which a published number or curve may be the mean."""
PARTS: Final = ((500, 1000), (-500, None))
"""Parts of a training whose mean return is shown, first and last episode."""
_RESAMPLES: Final = 200


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
    note = "How they are found: `recipes/study/published.py`; candidates are 15, 20 .. 250 episodes."
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
        "`recipes/study/verdicts.py` at each episode by itself; if the published curve is drawn as ours "
        "are, it holds 95 % of its episodes on average. The deviation, its limit and the rule stand in "
        "`recipes/study/verdicts.py`."
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


def appendix(results: Sequence[Result]) -> list[str]:
    """The sections on the study's returns, random and trained; empty without runs of the study."""
    return [*_random(results), *_trained(results)] if results else []


def _random(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        game, study = result.random_game, result.study
        if game is None or study is None or study.random is None:
            continue
        values = returns_by_chance(game)
        rows.append(
            [
                result.name,
                f"{study.number}",
                f"{study.random}",
                with_interval(values),
                f"{values.std(ddof=1):.3g}",
                f"{prediction(values, runs=PUBLISHED_EPISODES)}",
                verdicts.of_number(study.random, values, runs=PUBLISHED_EPISODES),
            ]
        )
    if not rows:
        return []
    head = ["run", "experiment", "published", f"ours, {EPISODES:,} episodes", "standard deviation"]
    head += [f"mean of {PUBLISHED_EPISODES} episodes", "verdict"]
    note = (
        f"The study's programs of random play play {PUBLISHED_EPISODES} episodes, so its scores are held "
        "against the interval of a mean of so many."
    )
    return ["## Appendix A beside ours: random play", "", note, "", *table(head, rows)]


def _trained(results: Sequence[Result]) -> list[str]:
    rows = []
    for result in results:
        study = result.study
        assert study is not None
        values = result.over_training("collective_return")
        cells = [result.name, f"{study.number}", f"{study.trained}", with_interval(values)]
        for runs in RUNS:
            judged = verdicts.of_number(study.trained, values, runs=runs)
            cells += [f"{prediction(values, runs=runs)}", judged] if result.is_whole else ["", TOO_FEW]
        rows.append([*cells, _evaluated(result, "trained")])
    head = ["run", "experiment", "published", "mean over training (at most the study's episodes), ours"]
    head += ["one run", "verdict", "mean of two runs", "verdict", "evaluation at epsilon 0.05, ours"]
    return ["## Appendix A beside ours: mean over training", "", *table(head, rows)]


def returns_of_others(results: Sequence[Result]) -> list[str]:
    """The section on the returns of runs that repeat none of the study's experiments; empty without any.

    A column that no run has an entry for is left out.
    """
    if not results:
        return []
    rows = [
        [
            result.name,
            _evaluated(result, "random"),
            *(_part(result, first, end) for first, end in ((0, 150), (500, 1000), (0, None))),
            _evaluated(result, "trained"),
        ]
        for result in results
    ]
    head = ["run", "random play", "first 150 episodes", "500 to 1000", "whole training", "evaluation"]
    kept = [place for place, cells in enumerate(zip(*rows, strict=True)) if any(cells)]
    whole = [[row[place] for place in kept] for row in (head, *rows)]
    return ["## Collective return", "", *table(whole[0], whole[1:])]


def _part(result: Result, first: int, end: int | None) -> str:
    """The mean of these episodes over replicas; "" if there are too few."""
    values = result.curves["collective_return"]
    return with_interval(values[:, first:end].mean(1)) if values.shape[1] >= (end or 1) else ""


def _evaluated(result: Result, policy: str) -> str:
    """The mean collective return of an evaluation over replicas; "" if there is none."""
    found = result.evaluated(policy)
    return "" if found is None else with_interval(found["collective_return"])


SURVIVED: Final = 990
"""The running mean of survival, in steps of an episode's 1000, below which survival counts as falling."""


def phases_of(results: Sequence[Result]) -> list[str]:
    """The section on phases, those of the published curves first; empty without a run of experiment 5."""
    runs = _of_experiment_5(results)
    if not runs:
        return []
    rows = [["published curves", *_phase_cells(_published_phases())]]
    for result in runs:
        cells = [TOO_FEW, "", "", ""]
        if result.phases:
            cells = _phase_cells(result.phases, _change_intervals(result))
        rows.append([result.name, *cells])
    head = ["curves", "second phase from", "third", "fourth", "phases by their pattern"]
    drawn = ", ".join(map(str, PHASES_BEGIN))
    note = (
        f"The study draws its phases from {drawn} on. See `recipes/study/phases.py` for how ours are found."
    )
    return ["## Phases of experiment 5", "", note, "", *table(head, rows)]


def turning_points_of(results: Sequence[Result]) -> list[str]:
    """The section on the turning points of the mean over replicas; empty without a run of experiment 5."""
    runs = _of_experiment_5(results)
    if not runs:
        return []
    study = runs[0].study
    assert study is not None
    names = "collective_return", "survival_steps"
    rows = [["published curves", *_turning_cells(*(curve(study.curves[name]) for name in names)), ""]]
    for result in runs:
        own = [running_mean(result.curves[name], result.window) for name in names]
        episodes = np.arange(own[0].shape[1], dtype=np.float64)
        lowest = own[1].min(1)
        cells = _turning_cells(*((episodes, curves.mean(0)) for curves in own))
        rows.append([result.name, *cells, f"{lowest.min():.0f} to {lowest.max():.0f}"])
    head = ["curves", "highest return", "at episode", "lowest return after it", "at episode"]
    head += [f"survival first below {SURVIVED} steps", "lowest survival", "lowest of single replicas"]
    return ["## Turning points of experiment 5", "", *table(head, rows)]


def _turning_cells(returns: tuple[Values, Values], survival: tuple[Values, Values]) -> list[str]:
    """The cells of one row; each curve consists of its episodes and its values."""
    at, values = returns
    top = int(values.argmax())
    bottom = top + int(values[top:].argmin())
    falls = survival[1] < SURVIVED
    first = f"{survival[0][falls.argmax()]:.0f}" if falls.any() else "never"
    cells = [f"{values[top]:.0f}", f"{at[top]:.0f}", f"{values[bottom]:.0f}", f"{at[bottom]:.0f}"]
    return [*cells, first, f"{survival[1].min():.0f}"]


def _of_experiment_5(results: Sequence[Result]) -> list[Result]:
    return [result for result in results if result.study and result.study.number == 5]


def _published_phases() -> list[phases.Phase]:
    study = published_experiment("commons")
    assert study is not None
    episodes = np.arange(10, 4745)
    # The curve of survival begins at episode 512; before that no agents deplete the board.
    metrics = {name: np.interp(episodes, *curve(study.curves[name])) for name in phases.METRICS}
    return phases.find_phases(episodes, metrics)


def _change_intervals(result: Result) -> list[str]:
    """In which episodes 95 % of the change points of resampled replicas lie; nothing for a single replica.

    Change points are no means, of which Student's t speaks: replicas are drawn anew, with replacement.
    """
    smoothed = {name: running_mean(result.curves[name]) for name in phases.METRICS}
    replicas, episodes = smoothed[phases.METRICS[0]].shape
    if replicas == 1:
        return []
    rng = np.random.default_rng(0)
    resampled = []
    for _ in range(_RESAMPLES):
        drawn = rng.integers(replicas, size=replicas)
        metrics = {name: curves[drawn] for name, curves in smoothed.items()}
        resampled.append(phases.change_points(np.arange(episodes), metrics))
    return [f" [{low:.0f}, {high:.0f}]" for low, high in np.quantile(resampled, [0.025, 0.975], axis=0).T]


def _phase_cells(divided: Sequence[phases.Phase], intervals: Sequence[str] = ()) -> list[str]:
    cells = [
        f"{phase.first:.0f}{interval}"
        for phase, interval in zip_longest(divided[1:], intervals, fillvalue="")
    ]
    return [*cells, ", ".join(phase.label or "none of them" for phase in divided)]
