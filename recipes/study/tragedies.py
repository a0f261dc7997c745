"""Does combat follow a tragedy? Whether a training earns more again while its agents still tag each other.

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
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from measures import ratio
from numpy.lib.stride_tricks import sliding_window_view
from page import section
from published import EXPERIMENT_5
from results import Result
from verdicts import Share, judge_shares

from cprl import presets
from cprl.values.array_types import Bool, Float64

METRICS: Final = ("collective_return", "survival_steps", "peacefulness")
"""The metrics that fall in a tragedy."""
LONG: Final = 300
"""The window of the running means in episodes."""
FALL: Final = 0.2
"""The least fall of a tragedy; all three published metrics fall by a third."""
Definition = tuple[int, float]
"""A window of the running means in episodes, and the least fall of a tragedy."""
DEFINITIONS: Final[tuple[Definition, ...]] = ((LONG, FALL), (LONG, 0.3), (100, FALL), (100, 0.3))
"""The definitions by which tragedy and combat are judged, the main one first."""
RISE: Final = 0.25
"""The least rise of combat; the published return regains more than half of what it lost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Combat:
    """Tragedy and combat of each of R replicas; see the module."""

    tragedy_at: Float64
    """The first episode of the running mean at the bottom of the tragedy, float64 [R]."""
    fall: Float64
    """float64 [R], at most 1."""
    rise: Float64
    """float64 [R]; NaN if the training ends with the tragedy, or nothing fell."""
    peace: Float64
    """float64 [R]; NaN likewise."""
    least_fall: float = FALL
    """The least fall of a tragedy."""

    @property
    def has_tragedy(self) -> Bool:
        """Return the replicas that show a tragedy, bool [R]."""
        return self.fall >= self.least_fall

    @property
    def has_combat(self) -> Bool:
        """Return the replicas that show combat, bool [R]."""
        with np.errstate(invalid="ignore"):
            return self.has_tragedy & (self.rise >= RISE) & (self.peace < 1)


def combat(metrics: Mapping[str, Float64], *, window: int = LONG, least_fall: float = FALL) -> Combat:
    """Look for tragedy and combat in each replica.

    Args:
        metrics: [R, E] by name, one value per episode, not smoothed, of at least three windows; at least
            `METRICS`.
        window: of the running means, in episodes.
        least_fall: of a tragedy.
    """
    curves = np.stack([metrics[name] for name in METRICS])
    smoothed = sliding_window_view(curves, window, axis=2).mean(-1)
    highest = np.maximum.accumulate(smoothed, axis=2)
    least_fallen = ratio(highest - smoothed, highest).min(0)
    at = least_fallen.argmax(1)
    row = np.arange(len(at))
    lowest = smoothed[0, row, at]
    lost = highest[0, row, at] - lowest
    later = np.full((len(METRICS), len(at)), np.nan)
    for replica, first in enumerate(at + window):
        if curves.shape[2] - first >= window:
            later[:, replica] = curves[:, replica, first:].mean(1)
    return Combat(
        tragedy_at=at.astype(np.float64),
        fall=least_fallen[row, at],
        rise=ratio(later[0] - lowest, lost, undefined=np.nan),
        peace=ratio(later[2], highest[2, row, at], undefined=np.nan),
        least_fall=least_fall,
    )


Combats = Mapping[Definition, Combat]


def by_definition(result: Result) -> Combats:
    """Return the `combat` of a run's replicas by each of `DEFINITIONS`; nothing with too few episodes for the
    longest window, or where the game lacks a metric."""
    has_all = set(METRICS) <= set(result.curves)
    is_long = has_all and result.curves["survival_steps"].shape[1] >= 3 * LONG
    return _by_definition(result.curves) if is_long else {}


def _by_definition(curves: Mapping[str, Float64]) -> Combats:
    return {(window, fall): combat(curves, window=window, least_fall=fall) for window, fall in DEFINITIONS}


def _published_combats() -> Combats:
    at = np.arange(0.0, 4740.0)
    return _by_definition({metric: EXPERIMENT_5.drawn_at(metric, at)[None] for metric in METRICS})


def judged_texts(shares: Sequence[Share]) -> tuple[str, str, str]:
    """Return the share of replicas that show something by the main definition, the fewest and the most by
    all, e.g. "0 to 8 of 8 by window and fall", and the verdict on it as a rule."""
    fewest, *_, most = sorted(share.count for share in shares)
    number = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    counts = f"{number} of {shares[0].replicas} by window and fall"
    return str(shares[0]), counts, judge_shares(shares)


def sections(results: Sequence[Result]) -> list[str]:
    """Return the sections on combat in every run on the board of experiment 5, replica by replica, and by
    each definition; nothing without such a run."""
    combats_of = {result: by_definition(result) for result in results if _is_commons(result)}
    runs = [(result, combats) for result, combats in combats_of.items() if combats]
    if not runs:
        return []
    names = _differing([result for result, _ in runs])
    main = DEFINITIONS[0]
    published = _published_combats()
    blank = [""] * len(names)
    rows = [["published curves", *blank, *_combat_cells(published[main])]]
    counts = [["published curves", *_count_cells([published])]]
    for result, combats in runs:
        settings = _settings(result)
        cells = [result.name, *(str(settings.get(name, "")) for name in names), *_combat_cells(combats[main])]
        rows.append([*cells, *judged_texts(shares_of([combats], "has_combat"))])
        counts.append([result.name, *_count_cells([combats]), *_rules([combats])])
    if len(runs) > 1:
        every = [combats for _, combats in runs]
        rows.append(["all runs", *blank, "", "", "", *judged_texts(shares_of(every, "has_combat"))])
        counts.append(["all runs", *_count_cells(every), *_rules(every)])
    head = ["curves", *names, "fall", "rise", "peace"]
    head += ["replicas with combat", "by all four definitions", "combat as a rule"]
    note = (
        f"Of each replica: the fall of a tragedy, at least {FALL:g}; the rise after it, at least {RISE:g}, "
        "and peace, below 1, for combat; bold where all three hold. See `recipes/study/tragedies.py`. "
        "The columns before are the settings in which the runs differ. "
        f"Falls are of running means over {LONG} episodes. "
        "The study says that combat stayed under every discount, loss and optimiser that it tried."
    )
    count_head = ["curves", "replicas", *(f"window {window}, fall {fall:g}" for window, fall in DEFINITIONS)]
    count_head += ["tragedy as a rule", "combat as a rule"]
    count_note = (
        "Replicas with a tragedy / with combat, by running means over so many episodes and the least fall "
        f"that counts. The rise is {RISE:g} throughout. A verdict is given where all four agree."
    )
    return [
        *section("Combat, replica by replica", head, rows, note),
        *section("Tragedy and combat by window and fall", count_head, counts, count_note),
    ]


def shares_of(runs: Sequence[Combats], what: str) -> list[Share]:
    """Return how many replicas of all runs show a tragedy or combat by each definition."""
    shares = []
    for definition in DEFINITIONS:
        is_shown = np.concatenate([getattr(combats[definition], what) for combats in runs])
        shares.append(Share(count=int(is_shown.sum()), replicas=len(is_shown)))
    return shares


def _count_cells(runs: Sequence[Combats]) -> list[str]:
    tragedies = shares_of(runs, "has_tragedy")
    combats = shares_of(runs, "has_combat")
    counts = [f"{one.count} / {other.count}" for one, other in zip(tragedies, combats, strict=True)]
    return [str(tragedies[0].replicas), *counts]


def _rules(runs: Sequence[Combats]) -> list[str]:
    """Return the verdicts on tragedy and combat as a rule."""
    return [judge_shares(shares_of(runs, what)) for what in ("has_tragedy", "has_combat")]


def _combat_cells(combat: Combat) -> list[str]:
    """Return the fall, rise and peace of each replica, bold where it shows combat."""

    def cell(value: float, is_bold: bool) -> str:
        if not np.isfinite(value):
            return "none"
        return f"**{value:.2f}**" if is_bold else f"{value:.2f}"

    return [
        ", ".join(map(cell, values, combat.has_combat)) for values in (combat.fall, combat.rise, combat.peace)
    ]


def _is_commons(result: Result) -> bool:
    """Return whether a run is of experiment 5, or of a study on its board."""
    board = getattr(result.experiment.game, "map", None)
    return result.study == EXPERIMENT_5 or board == presets.game("commons").map


def _settings(result: Result) -> dict[str, Any]:
    """Return the algorithm of the first agent that learns and its settings, by name; rules count as published
    or as run."""
    settings = {"rules": result.variant}
    for value in (result.algorithm, getattr(result.algorithm, "settings", None)):
        if value is not None:
            settings |= {field.name: getattr(value, field.name) for field in fields(value)}
    settings.pop("settings", None)
    return settings


def _differing(results: Sequence[Result]) -> list[str]:
    """Return the settings in which runs differ, but for those that all runs with the same rules share: they
    belong to the variant of the study."""
    tables = [_settings(result) for result in results]
    values: dict[str, dict[object, set[str]]] = {}
    for table in tables:
        for name in dict.fromkeys(key for other in tables for key in other):
            values.setdefault(name, {}).setdefault(table["rules"], set()).add(repr(table.get(name)))
    varied = [name for name, by_rules in values.items() if max(map(len, by_rules.values())) > 1]
    return ["rules"] * (len(values["rules"]) > 1) + varied
