"""Combat: whether a training, after a tragedy, earns more again while its agents still tag each other.

The phases of `phases` depend on the number of change points and on a threshold of a line's
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

A tragedy here is a fall of the study's three metrics; in `cprl.measuring.outcome` it ends below random play.

How many replicas do depends on the window and on the fall that counts, and no definition is the right one. So
whatever is said of a share of replicas is said by each of `DEFINITIONS`.
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
from verdicts import Share, share

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


Definition = tuple[int, float]
"""A window of the running means in episodes, and the least fall of a tragedy."""


DEFINITIONS: Final[tuple[Definition, ...]] = ((LONG, FALL), (LONG, 0.3), (100, FALL), (100, 0.3))
"""By which tragedy and combat are judged, the main one first."""


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
    least_fall: float = FALL
    """Of a tragedy."""

    @property
    def tragedy(self) -> Bools:
        """The replicas that show a tragedy, bool [R]."""
        return self.fall >= self.least_fall

    @property
    def combat(self) -> Bools:
        """The replicas that show combat, bool [R]."""
        with np.errstate(invalid="ignore"):
            return self.tragedy & (self.rise >= RISE) & (self.peace < 1)


def combat(metrics: Mapping[str, Values], *, window: int = LONG, least_fall: float = FALL) -> Combat:
    """Looks for tragedy and combat in each replica.

    Args:
        metrics: [R, E] by name, one value per episode, not smoothed, of at least three windows; at least
            `METRICS`.
        window: of the running means, in episodes.
        least_fall: of a tragedy.
    """
    curves = [metrics[name] for name in METRICS]
    smoothed = [sliding_window_view(curve, window, axis=1).mean(-1) for curve in curves]
    highest = [np.maximum.accumulate(curve, axis=1) for curve in smoothed]
    falls = np.stack([_share(top - own, top) for own, top in zip(smoothed, highest, strict=True)])
    together = falls.min(0)
    at = together.argmax(1)
    row = np.arange(len(at))
    later_return, later_peace = (_after(curve, at + window, window) for curve in (curves[0], curves[2]))
    lowest, top = smoothed[0][row, at], highest[0][row, at]
    return Combat(
        tragedy_at=at.astype(np.float64),
        fall=together[row, at],
        rise=_share(later_return - lowest, top - lowest, undefined=np.nan),
        peace=_share(later_peace, highest[2][row, at], undefined=np.nan),
        least_fall=least_fall,
    )


def _after(curve: Values, first: NDArray[np.int64], least: int) -> Values:
    """The mean of each replica's episodes from `first` on, [R]; NaN where fewer than `least` follow."""
    return np.array(
        [own[at:].mean() if len(own) - at >= least else np.nan for own, at in zip(curve, first, strict=True)]
    )


def _share(part: Values, whole: Values, *, undefined: float = 0.0) -> Values:
    shares: Values = np.divide(part, whole, out=np.full(np.shape(part), undefined), where=whole > 0)
    return shares


def by_definition(result: Result) -> dict[Definition, Combat]:
    """`combat` of a run's replicas by each of `DEFINITIONS`; empty with too few episodes for the longest
    window, or where the game lacks a metric."""
    if not set(METRICS) <= set(result.curves) or result.curves["survival_steps"].shape[1] < 3 * LONG:
        return {}
    metrics = {name: result.curves[name] for name in METRICS}
    return {own: combat(metrics, window=own[0], least_fall=own[1]) for own in DEFINITIONS}


def shares_by_definition(each: Sequence[Share]) -> str:
    """From the fewest to the most replicas that show something, over definitions: "0 to 8 of 8 by window and
    fall"."""
    shown = [one.shown for one in each]
    fewest, most = min(shown), max(shown)
    number = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    return f"{number} of {each[0].replicas} by window and fall"


def combat_section(results: Sequence[Result]) -> list[str]:
    """The section on combat in every run on the board of experiment 5, replica by replica; empty without
    one."""
    runs = [(one, found) for one in results if _is_commons(one) and (found := by_definition(one))]
    if not runs:
        return []
    names = _differing([one for one, _ in runs])
    main = DEFINITIONS[0]
    rows = [["published curves", *[""] * len(names), *_combat_cells(_published_combat()[main]), "", "", ""]]
    for result, found in runs:
        settings = _settings(result)
        rows.append(
            [
                result.name,
                *(f"{settings.get(name, '')}" for name in names),
                *_combat_cells(found[main]),
                *_judged([found], "combat"),
            ]
        )
    if len(runs) > 1:
        of_all = _judged([found for _, found in runs], "combat")
        rows.append(["all runs", *[""] * (len(names) + 3), *of_all])
    head = ["curves", *names, "fall", "rise", "peace"]
    head += ["replicas with combat", "by all four definitions", "combat as a rule"]
    note = (
        f"Of each replica: the fall of a tragedy, at least {FALL:g}; the rise after it, at least {RISE:g}, "
        "and peace, below 1, for combat; bold where all three hold. See `recipes/study/tragedies.py`. "
        "The columns before are the settings in which the runs differ. "
        f"Falls are of running means over {LONG} episodes. "
        "The study says that combat stayed under every discount, loss and optimiser that it tried."
    )
    section = ["## Combat, replica by replica", "", note, "", *table(head, rows)]
    return [*section, *_definitions_section(runs)]


def _definitions_section(runs: Sequence[tuple[Result, Mapping[Definition, Combat]]]) -> list[str]:
    """How many replicas show a tragedy, and combat, by each window and fall."""
    found: list[tuple[str, list[Mapping[Definition, Combat]]]]
    found = [("published curves", [_published_combat()]), *((one.name, [each]) for one, each in runs)]
    if len(runs) > 1:
        found.append(("all runs", [each for _, each in runs]))
    rows = []
    for name, each in found:
        counts = [
            f"{_shown(each, own, 'tragedy').shown} / {_shown(each, own, 'combat').shown}"
            for own in DEFINITIONS
        ]
        as_a_rule = [_judged(each, what)[-1] for what in ("tragedy", "combat")]
        replicas = _shown(each, DEFINITIONS[0], "tragedy").replicas
        rows.append([name, f"{replicas}", *counts, *(as_a_rule if name != "published curves" else ["", ""])])
    head = ["curves", "replicas", *(f"window {window}, fall {fall:g}" for window, fall in DEFINITIONS)]
    head += ["tragedy as a rule", "combat as a rule"]
    note = (
        "Replicas with a tragedy / with combat, by running means over so many episodes and the least fall "
        f"that counts. The rise is {RISE:g} throughout. A verdict is given where all four agree."
    )
    return ["## Tragedy and combat by window and fall", "", note, "", *table(head, rows)]


def _shown(each: Sequence[Mapping[Definition, Combat]], own: Definition, what: str) -> Share:
    """How many replicas of all runs show a tragedy or combat by a definition."""
    shown = np.concatenate([getattr(found[own], what) for found in each])
    return share(int(shown.sum()), len(shown))


def _judged(each: Sequence[Mapping[Definition, Combat]], what: str) -> tuple[str, str, str]:
    """The share of replicas by the main definition, the range by all, and the verdict on it as a rule."""
    main, *_ = shares = [_shown(each, own, what) for own in DEFINITIONS]
    verdict = verdicts.of_definitions([verdicts.of_share(one) for one in shares])
    return f"{main}", shares_by_definition(shares), verdict


def _combat_cells(found: Combat) -> list[str]:
    """The fall, rise and peace of each replica, bold where it shows combat."""

    def cell(values: Values) -> str:
        return ", ".join(
            (f"**{value:.2f}**" if shown else f"{value:.2f}") if np.isfinite(value) else "none"
            for value, shown in zip(values, found.combat, strict=True)
        )

    return [cell(found.fall), cell(found.rise), cell(found.peace)]


def _published_combat() -> dict[Definition, Combat]:
    study = published_experiment(PHASED_RECIPE)
    assert study is not None
    at = np.arange(0.0, 4740.0)
    metrics = {metric: np.interp(at, *curve(study.curves[metric]))[None] for metric in METRICS}
    return {own: combat(metrics, window=own[0], least_fall=own[1]) for own in DEFINITIONS}


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


def _differing(results: Sequence[Result]) -> list[str]:
    """The settings in which runs differ, but for those that all runs with the same rules share: they belong
    to the variant of the study."""
    tables = [_settings(result) for result in results]
    names = dict.fromkeys(name for one in tables for name in one)

    def values(name: str, rules: object) -> set[str]:
        return {repr(one.get(name)) for one in tables if one["rules"] == rules}

    variants = {one["rules"] for one in tables}
    varied = [name for name in names if any(len(values(name, rules)) > 1 for rules in variants)]
    return ["rules"] * (len(variants) > 1) + varied
