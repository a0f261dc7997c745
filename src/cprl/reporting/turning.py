"""Phases and turning points of experiment 5, compared with those of the published curves."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from cprl.measuring import phases
from cprl.measuring.published import PHASES_BEGIN, curve, published_experiment
from cprl.reporting.markdown import table
from cprl.reporting.result import TOO_FEW, Result, Values
from cprl.runs.curves import running_mean

SURVIVED: Final = 990
"""The running mean of survival, in steps of an episode's 1000, below which survival counts as falling."""


def phases_of(results: Sequence[Result]) -> list[str]:
    """The section on phases, those of the published curves first; empty without a run of experiment 5."""
    runs = _of_experiment_5(results)
    if not runs:
        return []
    rows = [["published curves", *_phase_cells(*_published_phases())]]
    for result in runs:
        cells = _phase_cells(*result.phases) if result.phases else [TOO_FEW, "", "", ""]
        rows.append([result.name, *cells])
    head = ["curves", "second phase from", "third", "fourth", "phases by their pattern"]
    drawn = ", ".join(map(str, PHASES_BEGIN))
    note = f"The study draws its phases from {drawn} on. See `cprl.measuring.phases` for how ours are found."
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


def _published_phases() -> tuple[list[phases.ChangePoint], list[phases.Phase]]:
    study = published_experiment("commons")
    assert study is not None
    episodes = np.arange(10, 4745)
    # The curve of survival begins at episode 512; before that no agents deplete the board.
    metrics = {name: np.interp(episodes, *curve(study.curves[name])) for name in phases.METRICS}
    return phases.find_phases(episodes, metrics)


def _phase_cells(changes: Sequence[phases.ChangePoint], found: Sequence[phases.Phase]) -> list[str]:
    cells = [
        f"{change.episode:.0f}"
        + (f" [{change.low:.0f}, {change.high:.0f}]" if np.isfinite(change.low) else "")
        for change in changes
    ]
    return [*cells, ", ".join(phase.label or "none of them" for phase in found)]
