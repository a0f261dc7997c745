"""The study's claims on experiment 5, four agents, and whether combat persists under other settings."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import presets
from cprl.measuring.combat import FALL, LONG, METRICS, RISE, Combat, combat
from cprl.measuring.published import PHASED_RECIPE, PHASES_BEGIN, curve, published_experiment
from cprl.measuring.shares import share
from cprl.population import Learning
from cprl.reporting import verdicts
from cprl.reporting.claims import Claim, more, number, rule, side, undefined_in, where
from cprl.reporting.markdown import table
from cprl.reporting.result import Result
from cprl.runs.curves import running_mean

Values = NDArray[np.float64]

LAST: Final = 500
EXPLORED, TRAGIC, FOUGHT = PHASES_BEGIN
"""The episodes at which the study's phases of exploration, tragedy and combat end."""


def of_experiment_5(result: Result) -> Iterator[Claim]:
    """Exploration, tragedy, combat, cultivation."""
    curves, returns = result.curves, running_mean(result.curves["collective_return"], result.window)
    episodes, ends = returns.shape[1], result.exploration_ends
    if ends is not None and 0 < int(ends) < episodes:
        best, after = returns[:, : int(ends)].max(1), returns[:, int(ends) :].max(1)
        measure = f"highest running mean before and after episode {ends:.0f}, where exploration ends"
        yield more("the highest returns come in exploration", measure, best, after, paired=True)
    if curves["equality"].shape[1] >= EXPLORED:
        for metric, claim, sign in (("peacefulness", "rises", 1), ("equality", "falls slowly", -1)):
            values = _climb(curves[metric][:, :EXPLORED])
            yield side(
                f"exploration: {metric} {claim}",
                f"climb of its line over the first {EXPLORED} episodes",
                values,
                published=_published_climb(result, metric),
                **{"above" if sign > 0 else "below": 0.0},
            )
    survival = running_mean(curves["survival_steps"], result.window).min(1)
    at, values = _published(result, "survival_steps")
    falls = number(
        "survival falls to 612 steps", "lowest running mean", survival, published=float(values.min())
    )
    yield where(episodes > at[values.argmin()], falls)
    found = combat_of(result)
    if found is not None:
        yield rule("tragedy", "return, survival and peacefulness fall together", found.tragedy)
        yield rule("combat follows", "return rises again, peacefulness below its peak", found.combat)
    if episodes >= FOUGHT + LAST:
        ratio = _unrest(returns[:, TRAGIC:FOUGHT]) / _unrest(returns[:, FOUGHT:])
        at, values = _published(result, "collective_return")
        theirs = np.interp(np.arange(at[-1]), at, values)[None]
        yield side(
            "combat is volatile, cultivation is not",
            f"scatter of running means about their line, episodes {TRAGIC} to {FOUGHT} over later ones",
            ratio,
            above=1,
            published=float((_unrest(theirs[:, TRAGIC:FOUGHT]) / _unrest(theirs[:, FOUGHT:]))[0]),
        )
        at, values = _published(result, "equality")
        late = float(values[at >= at[-1] - LAST].mean())
        equality = curves["equality"][:, -LAST:]
        yield number(
            "equality about 0.87 in the end",
            f"mean of the last 500 episodes{undefined_in(equality)}",
            np.nanmean(equality, axis=1),
            published=late,
        )
    yield from _tagging(result)


def _tagging(result: Result) -> Iterator[Claim]:
    shots, tagged = result.of_agents("shots"), result.of_agents("tagged")
    if shots is None or tagged is None or shots.shape[1] < EXPLORED + LAST:
        return
    parts = {"the first 450 episodes": slice(0, EXPLORED)}
    if shots.shape[1] >= FOUGHT + LAST:
        parts[f"episodes {TRAGIC} to {FOUGHT}"] = slice(TRAGIC, FOUGHT)
    late = _per(tagged[:, -LAST:], shots[:, -LAST:])
    for name, part in parts.items():
        yield more(
            "cultivation: efficient tagging",
            f"tags per shot, last 500 episodes and {name}",
            late,
            _per(tagged[:, part], shots[:, part]),
            paired=True,
        )


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
        "and peace, below 1, for combat; bold where all three hold. See `cprl.measuring.combat`. "
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


def _published(result: Result, metric: str) -> tuple[Values, Values]:
    assert result.study is not None
    return curve(result.study.curves[metric])


def _published_climb(result: Result, metric: str) -> float:
    at, values = _published(result, metric)
    inside = at <= EXPLORED
    return float(np.polyfit(at[inside], values[inside], 1)[0] * EXPLORED)


def _climb(curves: Values) -> Values:
    """The climb of the straight line through each curve from its first to its last episode, [R, E] to [R];
    episodes in which it is undefined are left out."""
    episodes = curves.shape[1]
    at = np.arange(episodes)
    return np.array([np.polyfit(at[~np.isnan(own)], own[~np.isnan(own)], 1)[0] * episodes for own in curves])


def _unrest(curves: Values) -> Values:
    """The standard deviation of each curve about its straight line, [R, E] to [R]."""
    at = np.arange(curves.shape[1])
    return np.array([(own - np.polyval(np.polyfit(at, own, 1), at)).std() for own in curves])


def _per(part: Values, whole: Values) -> Values:
    """The sum of one over that of the other, [R, E, N] each to [R]."""
    ratio: Values = part.sum((1, 2)) / np.maximum(whole.sum((1, 2)), 1)
    return ratio
