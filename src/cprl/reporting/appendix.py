"""Appendix A beside ours, and the returns of runs that repeat none of the study's experiments."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.predictions import prediction
from cprl.reporting import verdicts
from cprl.reporting.claims import with_interval
from cprl.reporting.curves import RUNS
from cprl.reporting.markdown import table
from cprl.reporting.random_play import EPISODES, PUBLISHED_EPISODES, returns_by_chance
from cprl.reporting.result import TOO_FEW, Result

Values = NDArray[np.float64]


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
