"""What do agents harvest, at random and trained, beside appendix A of the study?"""

from collections.abc import Sequence
from typing import Final

from curves import RUNS, beside
from measures import with_interval
from page import section
from random_play import EPISODES, random_returns
from results import TOO_FEW, Result
from verdicts import judge_number, prediction

RETURN: Final = "collective_return"
RANDOM_EPISODES: Final = 100
"""The episodes of the study's random score: its programs of random play, test_random.py, play so many."""
PARTS: Final = {"500 to 1000": (500, 1000), "last 500": (-500, None)}
"""Parts of a training whose mean return is shown, first and last episode."""


def appendix(results: Sequence[Result]) -> list[str]:
    """Return the sections on the study's returns, random and trained; nothing without runs of the study."""
    random = ["run", "experiment", "published", f"ours, {EPISODES:,} episodes", "standard deviation"]
    random += [f"mean of {RANDOM_EPISODES} episodes", "verdict"]
    random_rows = [_random_cells(result) for result in results if result.random_game]
    note = (
        f"The study's programs of random play play {RANDOM_EPISODES} episodes, so its scores are held "
        "against the interval of a mean of so many."
    )
    trained = ["run", "experiment", "published", "mean over training (at most the study's episodes), ours"]
    for runs in RUNS:
        trained += [runs, "verdict"]
    trained.append("evaluation at epsilon 0.05, ours")
    return [
        *section("Appendix A beside ours: random play", random, random_rows, note),
        *section("Appendix A beside ours: mean over training", trained, list(map(_trained_cells, results))),
    ]


def _random_cells(result: Result) -> list[str]:
    study = result.study
    values = random_returns(result.random_game)
    return [
        result.name,
        str(study.number),
        str(study.random),
        with_interval(values),
        f"{values.std(ddof=1):.3g}",
        str(prediction(values, runs=RANDOM_EPISODES)),
        judge_number(study.random, values, runs=RANDOM_EPISODES),
    ]


def _trained_cells(result: Result) -> list[str]:
    study = result.study
    values = result.over_training(RETURN)
    cells = [result.name, str(study.number), str(study.trained), with_interval(values)]
    for runs in RUNS.values():
        verdict = judge_number(study.trained, values, runs=runs)
        cells += [str(prediction(values, runs=runs)), verdict] if result.is_whole else ["", TOO_FEW]
    return [*cells, _evaluated(result, "trained")]


def parts(results: Sequence[Result]) -> list[str]:
    """Return the section on the return in parts of a training; nothing without runs of the study."""
    rows = []
    for result in results:
        pair = beside(result, RETURN)
        if pair is None:
            continue
        first = [f"{pair.episodes[0]:.0f}", f"{pair.published[0]:.4g}", with_interval(pair.ours[:, 0])]
        cells = [result.name, *first]
        for begin, end in PARTS.values():
            cells += [_published_part(result, begin, end), _part(result, begin, end) or TOO_FEW]
        rows.append(cells)
    head = ["run", "first point at episode", "published", "ours, same window"]
    for part in PARTS:
        head += [f"{part}, published", "ours"]
    note = "Apples; intervals are of the mean over replicas."
    return section("Collective return in parts of the training", head, rows, note)


def _published_part(result: Result, begin: int, end: int | None) -> str:
    """Return the published curve's mean over episodes of the part; the window blurs its edges."""
    episodes, values = result.study.curve(RETURN)
    if end is None:
        begin += result.study.episodes - result.window
        end = result.study.episodes + result.window
    is_inside = (episodes >= begin) & (episodes <= end - result.window)
    return f"{values[is_inside].mean():.4g}"


def returns_of_others(results: Sequence[Result]) -> list[str]:
    """Return the section on the returns of runs that repeat none of the study's experiments; nothing without
    any. A column that no run has an entry for is left out."""
    columns = {
        "run": [result.name for result in results],
        "random play": [_evaluated(result, "random") for result in results],
        "first 150 episodes": [_part(result, 0, 150) for result in results],
        "500 to 1000": [_part(result, 500, 1000) for result in results],
        "whole training": [_part(result, 0, None) for result in results],
        "evaluation": [_evaluated(result, "trained") for result in results],
    }
    columns = {head: cells for head, cells in columns.items() if any(cells)}
    return section("Collective return", list(columns), list(zip(*columns.values(), strict=True)))


def _part(result: Result, begin: int, end: int | None) -> str:
    """Return the mean of these episodes over replicas; "" if there are too few."""
    values = result.curves[RETURN]
    is_whole = values.shape[1] >= (end or -begin)
    return with_interval(values[:, begin:end].mean(1)) if is_whole else ""


def _evaluated(result: Result, policy: str) -> str:
    """Return the mean collective return of an evaluation over replicas; "" if there is none."""
    means = result.evaluated(policy)
    return "" if means is None else with_interval(means[RETURN])
