"""Search and its points: the values of factors at which a metric is best."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from cprl.arguments import BLOCK, integer, object_of, refusal
from cprl.commons.game import Game
from cprl.experiment import Experiment
from cprl.measuring import social
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.studies.factors import Distribution, Factor, levels_of
from cprl.studies.naming import level_text, named, short_names
from cprl.studies.study import Study
from cprl.studies.trials import trials_of

SAMPLERS: Final = ("tpe", "random", "gp")
_TRIES: Final = 100
"""Random combinations of levels of which one has to fit."""
Sampler = str | Callable[[int], Any]
"""One of `SAMPLERS`, or what makes a sampler of Optuna from a seed."""


@dataclass(frozen=True, eq=False)
class Search:
    """What is searched, and by which metric.

    Args:
        experiment: what every point is, but for its factors.
        factors: as those of a `Study`: distributions, lists of values, or tables of named levels.
        points: how many are tried, those that came twice included.
        metric: by a name of docs/metrics.md, e.g. "collective_return"; or "return_0" of an agent.
        direction: which values of it are better.
        over: the episodes that count: those of the evaluation, or the last ones of the training.
        last: how many of the training.
        at_once: points that are proposed without the values of each other. Other numbers propose other
            points, so it does not depend on the number of jobs.
        sampler: "tpe", "random" or "gp" (wants scipy and torch, which are there), or a function that makes
            a sampler of Optuna from a seed.
        replicas: see `Study`.
        block: see `Study`.
        name: by default that of the experiment.

    Raises:
        ValueError: for whatever does not fit.
    """

    experiment: Experiment
    factors: Mapping[str, Factor]
    points: int = field(kw_only=True)
    metric: str = field(default="collective_return", kw_only=True)
    direction: Literal["maximise", "minimise"] = field(default="maximise", kw_only=True)
    over: Literal["evaluation", "training"] = field(default="evaluation", kw_only=True)
    last: int = field(default=30, kw_only=True)
    at_once: int = field(default=4, kw_only=True)
    sampler: Sampler = field(default="tpe", kw_only=True)
    replicas: int | None = field(default=None, kw_only=True)
    block: int = field(default=BLOCK, kw_only=True)
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        object_of("experiment", self.experiment, Experiment, "an Experiment")
        for own, most in (("points", 100_000), ("last", 2**31 - 1), ("at_once", 4096)):
            integer(own, getattr(self, own), 1, most)
        allowed_of = {"direction": ("maximise", "minimise"), "over": ("evaluation", "training")}
        for own, allowed in allowed_of.items():
            if getattr(self, own) not in allowed:
                raise refusal(own, getattr(self, own), " or ".join(map(repr, allowed)))
        if not callable(self.sampler) and self.sampler not in SAMPLERS:
            raise refusal("sampler", self.sampler, f"{', '.join(SAMPLERS)}, or a function of a seed")
        _check_metric(self.metric, self.experiment)
        drawn = self._drawn()
        object.__setattr__(self, "factors", drawn.factors)
        object.__setattr__(self, "name", drawn.name)

    def study_of(self, points: Sequence["Point"]) -> Study:
        """The study of these points, as named conditions; those that came twice once, and none that was
        refused."""
        kept = [own for own in points if not own.is_repeated and not own.reason]
        return self._study(conditions={own.name: own.changes for own in kept})

    def _drawn(self) -> Study:
        """The study of one random combination of levels, the first that fits; some may contradict each
        other, which is no reason to refuse a search of the others."""
        refused = []
        for nth in range(_TRIES):
            try:
                experiment = replace(self.experiment, seed=self.experiment.seed + nth)
                return self._study(self.factors, draws=1, experiment=experiment)
            except ValueError as error:
                refused.append(error)
        raise refused[0]

    def _study(self, factors: Mapping[str, Factor] | None = None, **others: Any) -> Study:
        how: dict[str, Any] = {
            "experiment": self.experiment,
            "replicas": self.replicas,
            "block": self.block,
            "name": self.name,
        }
        return Study(factors=factors or {}, **{**how, **others})

    def point(self, number: int, proposed: Mapping[str, Any]) -> "Point":
        """The point with these levels."""
        changes: dict[str, Any] = {}
        for name, own in self.factors.items():
            is_drawn = isinstance(own, Distribution)
            changes |= {name: proposed[name]} if is_drawn else labels(name, own)[proposed[name]]
        short = short_names(self.factors)
        levels = {short[name]: proposed[name] for name in self.factors}
        return Point(number=number, name=named(levels), levels=dict(proposed), changes=changes)


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a search."""

    number: int
    name: str
    """Of its condition."""
    levels: Mapping[str, Any]
    """By factor: a number, or the text of a level."""
    changes: Mapping[str, Any]
    """What it changes in the experiment, by path."""
    value: float | None = None
    """The mean of the metric over replicas; None where a run of it failed, it is undefined, or refused."""
    is_repeated: bool = False
    """Whether it equals an earlier one, whose runs count."""
    reason: str = ""
    """Why the experiment refuses these levels together; such a point is not run."""


def value_of(search: Search, point: Point, runs: Path) -> float | None:
    """The metric of a point, the mean of its replicas; None if a run of it has not finished, or the
    experiment refuses it."""
    if point.reason:
        return None
    found: list[float] = []
    for trial in trials_of(search.study_of([replace(point, is_repeated=False)])):
        run = runs / trial.name
        if trial.state(runs) != "finished":
            return None
        if search.over == "evaluation":
            curves = as_curves(read_table(run / "evaluation" / "trained.parquet"))
        else:
            curves = {name: own[:, -search.last :] for name, own in curves_of(run).items()}
        if search.metric not in curves:
            raise refusal("metric", search.metric, f"what the game reports: {', '.join(sorted(curves))}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of replicas in which it is never defined
            found += np.nanmean(curves[search.metric], 1).tolist()
    value = float(np.mean(found))
    return value if math.isfinite(value) else None


def labels(name: str, factor: Factor) -> dict[str, Mapping[str, Any]]:
    """What each level of a factor changes, by the text that Optuna has for it."""
    levels = levels_of(name, factor)
    texts = [level_text(own.value) for own in levels]
    if len(set(texts)) < len(texts):
        texts = [f"{nth}: {text}" for nth, text in enumerate(texts)]
    return {text: own.changes for text, own in zip(texts, levels, strict=True)}


def _check_metric(metric: object, experiment: Experiment) -> None:
    """Refuses a metric that a game of cprl cannot report."""
    if not isinstance(metric, str) or not metric:
        raise refusal("metric", metric, "the name of a metric, e.g. 'collective_return'")
    if not isinstance(experiment.game, Game):
        return
    known = [*social.METRICS, *(f"return_{agent}" for agent in range(experiment.game.agents))]
    if metric not in known and not (experiment.game.institutions and metric.startswith("institutions/")):
        raise refusal("metric", metric, ", ".join(known))
