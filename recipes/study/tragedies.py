"""Combat: whether a training, after a tragedy, earns more again while its agents still tag each other.

The phases of `cprl.measuring.phases` depend on the number of change points and on a threshold of a line's
slope: between the lines that the study draws, its own collective return rises by a hair too little to be
called combat, and with four or five change points the pattern breaks. This measure has neither. It looks at
running means over `LONG` episodes, long enough that a level that only wanders does not pass for a fall and a
recovery, and compares three moments of each replica:

    tragedy   the episode at which collective return, survival and peacefulness together stand furthest below
              the highest that each has had before: the one that has fallen least decides
    fall      by how much that one has fallen by then, as a share of its highest
    rise      by how much the collective return lies higher in the mean of all later episodes, as a share of
              what it had fallen
    peace     the peacefulness of all later episodes over its highest before

A replica shows a tragedy if the fall is at least `FALL`, and combat if it also rises by at least `RISE` and
its peace stays below 1: the agents earn more again, but not because they have stopped tagging.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Final

import numpy as np
import verdicts
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from published import PHASED_RECIPE, curve, published_experiment
from results import Result, table
from verdicts import share

from cprl import presets
from cprl.population import Learning

Values = NDArray[np.float64]
Bools = NDArray[np.bool_]


METRICS: Final = ("collective_return", "survival_steps", "peacefulness")
"""The metrics that fall in a tragedy."""


LONG: Final = 300
"""The window of the running means in episodes."""


FALL: Final = 0.2
"""The least fall of a tragedy; all three published metrics fall by a third."""


RISE: Final = 0.25
"""The least rise of combat; the published return regains more than half of what it lost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Combat:
    """Tragedy and combat of each of R replicas; see the module."""

    tragedy_at: Values
    """The first episode of the running mean at the bottom of the tragedy, float64 [R]."""
    fall: Values
    """float64 [R], at most 1."""
    rise: Values
    """float64 [R]; NaN if the training ends with the tragedy, or nothing fell."""
    peace: Values
    """float64 [R]; NaN likewise."""

    @property
    def tragedy(self) -> Bools:
        """The replicas that show a tragedy, bool [R]."""
        return self.fall >= FALL

    @property
    def combat(self) -> Bools:
        """The replicas that show combat, bool [R]."""
        with np.errstate(invalid="ignore"):
            return self.tragedy & (self.rise >= RISE) & (self.peace < 1)


def combat(metrics: Mapping[str, Values]) -> Combat:
    """Looks for tragedy and combat in each replica.

    Args:
        metrics: [R, E] by name, one value per episode, not smoothed, of at least 3 `LONG` episodes; at least
            `METRICS`.
    """
    curves = [metrics[name] for name in METRICS]
    smoothed = [sliding_window_view(curve, LONG, axis=1).mean(-1) for curve in curves]
    highest = [np.maximum.accumulate(curve, axis=1) for curve in smoothed]
    falls = np.stack([_share(top - own, top) for own, top in zip(smoothed, highest, strict=True)])
    together = falls.min(0)
    at = together.argmax(1)
    row = np.arange(len(at))
    later_return, later_peace = (_after(curve, at + LONG) for curve in (curves[0], curves[2]))
    lowest, top = smoothed[0][row, at], highest[0][row, at]
    return Combat(
        tragedy_at=at.astype(np.float64),
        fall=together[row, at],
        rise=_share(later_return - lowest, top - lowest, undefined=np.nan),
        peace=_share(later_peace, highest[2][row, at], undefined=np.nan),
    )


def _after(curve: Values, first: NDArray[np.int64]) -> Values:
    """The mean of each replica's episodes from `first` on, [R]; NaN where fewer than `LONG` follow."""
    return np.array(
        [own[at:].mean() if len(own) - at >= LONG else np.nan for own, at in zip(curve, first, strict=True)]
    )


def _share(part: Values, whole: Values, *, undefined: float = 0.0) -> Values:
    shares: Values = np.divide(part, whole, out=np.full(np.shape(part), undefined), where=whole > 0)
    return shares


def combat_of(result: Result) -> Combat | None:
    """`combat` of a run's replicas; None with too few episodes, or where the game lacks a metric."""
    if not set(METRICS) <= set(result.curves) or result.curves["survival_steps"].shape[1] < 3 * LONG:
        return None
    return combat({name: result.curves[name] for name in METRICS})


def combat_section(results: Sequence[Result]) -> list[str]:
    """The section on combat in every run on the board of experiment 5, replica by replica; empty without
    one."""
    runs = [(one, found) for one in results if _is_commons(one) and (found := combat_of(one))]
    if not runs:
        return []
    names = _differing(runs)
    rows = [["published curves", *[""] * len(names), *_combat_cells(_published_combat()), "", ""]]
    for result, found in runs:
        settings = _settings(result)
        shown = share(int(found.combat.sum()), len(found.combat))
        rows.append(
            [
                result.name,
                *(f"{settings.get(name, '')}" for name in names),
                *_combat_cells(found),
                f"{shown}",
                verdicts.of_share(shown),
            ]
        )
    total = share(
        sum(int(found.combat.sum()) for _, found in runs), sum(len(found.combat) for _, found in runs)
    )
    if len(runs) > 1:
        rows.append(["all runs", *[""] * (len(names) + 3), f"{total}", verdicts.of_share(total)])
    head = ["curves", *names, "fall", "rise", "peace", "replicas with combat", "combat as a rule"]
    note = (
        f"Of each replica: the fall of a tragedy, at least {FALL:g}; the rise after it, at least {RISE:g}, "
        "and peace, below 1, for combat; bold where all three hold. See `recipes/study/tragedies.py`. "
        "The columns before are the settings in which the runs differ. "
        "The study says that combat stayed under every discount, loss and optimiser that it tried."
    )
    return ["## Combat, replica by replica", "", note, "", *table(head, rows)]


def _combat_cells(found: Combat) -> list[str]:
    """The fall, rise and peace of each replica, bold where it shows combat."""

    def cell(values: Values) -> str:
        return ", ".join(
            (f"**{value:.2f}**" if shown else f"{value:.2f}") if np.isfinite(value) else "none"
            for value, shown in zip(values, found.combat, strict=True)
        )

    return [cell(found.fall), cell(found.rise), cell(found.peace)]


def _published_combat() -> Combat:
    study = published_experiment(PHASED_RECIPE)
    assert study is not None
    at = np.arange(0.0, 4740.0)
    return combat({metric: np.interp(at, *curve(study.curves[metric]))[None] for metric in METRICS})


def _is_commons(result: Result) -> bool:
    """Whether a run is of experiment 5, or of a study on its board."""
    board = getattr(result.experiment.game, "map", None)
    repeated = result.study is not None and result.study.recipe == PHASED_RECIPE
    return repeated or board == presets.game("commons").map


def _settings(result: Result) -> dict[str, Any]:
    """The algorithm of the first agent that learns and its settings, by name; rules count as published or as
    run."""
    specs = [spec for spec in result.experiment.agents if isinstance(spec, Learning)]
    found: dict[str, Any] = {"rules": result.variant}
    if specs:
        algorithm = specs[0].algorithm
        for value in (algorithm, getattr(algorithm, "settings", None)):
            if is_dataclass(value):
                found |= {
                    one.name: getattr(value, one.name) for one in fields(value) if one.name != "settings"
                }
    return found


def _differing(runs: Sequence[tuple[Result, Combat]]) -> list[str]:
    """The settings in which runs differ, but for those that all runs with the same rules share: they belong
    to the variant of the study."""
    tables = [_settings(result) for result, _ in runs]
    names = dict.fromkeys(name for one in tables for name in one)

    def values(name: str, rules: object) -> set[str]:
        return {repr(one.get(name)) for one in tables if one["rules"] == rules}

    variants = {one["rules"] for one in tables}
    varied = [name for name in names if any(len(values(name, rules)) > 1 for rules in variants)]
    return ["rules"] * (len(variants) > 1) + varied
