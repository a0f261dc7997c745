"""run_search: a search by Optuna, which proposes points from the values of those that were run before.

What was run is in the run directories, as it is for a study; Optuna itself keeps nothing. Point n depends on
the seed, n, and the values of the points before its batch alone, so a search that was stopped anywhere
proposes the same points again, finds their runs finished, and continues as if nothing had happened.
"""

import hashlib
import math
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from cprl.arguments import BLOCK, integer, refusal
from cprl.checks import checked, instance
from cprl.commons.game import Game
from cprl.experiment import Experiment
from cprl.measuring import social
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.runs.files import write_json
from cprl.studies.executors import Executor, InProcess
from cprl.studies.factors import Distribution, Factor, Integers, LogUniform, levels_of
from cprl.studies.run import Driver, check_comparison, results_of
from cprl.studies.study import RUNS, Study, directory_of, level_text, named, short_names, write_study
from cprl.studies.tables.comparing import LAST
from cprl.studies.tables.table import StudyTable
from cprl.studies.trials import Outcome, Trial, trials_of

FILE_NAME: Final = "search.json"
JOURNAL: Final = "optuna.journal"
"""For Optuna's own tools, e.g. its dashboard; written after each batch and never read."""


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
        name: by default that of the experiment.
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
        checked("experiment", self.experiment, instance(Experiment, "an Experiment"))
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


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search has found."""

    search: Search
    study: Study
    """Of all points, as named conditions."""
    out: Path
    runs: Path
    points: tuple[Point, ...] = field(repr=False)
    trials: tuple[Trial, ...] = field(repr=False)
    failed: tuple[Outcome, ...]
    table: StudyTable | None = field(repr=False)
    """What came out; None if nothing has finished, and where no results were asked for."""

    @property
    def ranked(self) -> list[Point]:
        """The points with a value, each once, the best first."""
        known = [own for own in self.points if own.value is not None and not own.is_repeated]
        sign = -1.0 if self.search.direction == "maximise" else 1.0
        return sorted(known, key=lambda own: sign * (own.value or 0.0))


def run_search(
    search: Search,
    out: Path | str | None = None,
    *,
    on: Executor | None = None,
    runs: Path | str | None = None,
    progress: bool = True,
    results: bool = True,
    last: int = LAST,
    again: str = "",
) -> SearchResult:
    """Runs a search; may be stopped at any moment, and called again, with more points too."""
    check_comparison(last)
    optuna = _optuna()
    asked = _Asked(search, optuna)
    batch = asked.first_batch()
    study = search.study_of(batch)
    out = directory_of(study, out)
    folder = out / RUNS if runs is None else Path(runs)
    failed: list[Outcome] = []
    driver = Driver(out, folder, on or InProcess(), progress=progress)
    with driver.running(study):
        while batch:
            failed += _run_batch(search, batch, driver, of=asked)
            asked.tell([value_of(search, own, folder) for own in batch])
            study = search.study_of(asked.points)
            write_study(study, out)
            write_json(out / FILE_NAME, _as_table(search, asked.points))
            _write_journal(optuna, asked.study, out / JOURNAL)
            batch = asked.next_batch()
        table = results_of(study, out, folder, last=last, again=again) if results else None
    trials = tuple(trials_of(study))
    return SearchResult(search, study, out, folder, tuple(asked.points), trials, tuple(failed), table)


class _Asked:
    """What Optuna has proposed so far."""

    def __init__(self, search: Search, optuna: Any) -> None:
        self._search, self._optuna, self._space = search, optuna, _space_of(search, optuna)
        with _quiet(optuna):
            self.study = optuna.create_study(direction=search.direction.replace("se", "ze"))
        self.points: list[Point] = []
        """Those that were told."""
        self._waiting: list[tuple[Any, Point]] = []
        self._first: dict[str, Point] = {}
        """By checksum, the first point that has it."""

    def first_batch(self) -> list[Point]:
        """The first points of which one fits."""
        while batch := self.next_batch():
            if not all(own.reason for own in batch):
                return batch
            self.tell([None] * len(batch))
        raise ValueError(
            f"none of the search's {len(self.points)} points fits; the first, {self.points[0].name}: "
            f"{self.points[0].reason}"
        )

    def next_batch(self) -> list[Point]:
        """The next points, at most `at_once` of them."""
        first = len(self.points)
        for number in range(first, min(first + self._search.at_once, self._search.points)):
            self.study.sampler = _sampler(self._optuna, self._search, number)
            trial = self.study.ask(self._space)
            self._waiting.append((trial, self._named(self._search.point(number, trial.params))))
        return [point for _, point in self._waiting]

    def _named(self, point: Point) -> Point:
        """A point that is known as such, or one whose name no other one has; with the reason where the
        experiment refuses its levels together, since later ones may fit."""
        try:
            checksum = self._search.study_of([point]).all_conditions[0].checksum
        except ValueError as error:
            return replace(point, reason=str(error))
        if checksum in self._first:
            first = self._first[checksum]
            return replace(point, name=first.name, changes=first.changes, is_repeated=True)
        if any(own.name == point.name for own in self._first.values()):  # they differ in the seventh digit
            point = replace(point, name=f"{point.name}, point {point.number}")
        self._first[checksum] = point
        return point

    def tell(self, values: Sequence[float | None]) -> None:
        """Tells Optuna the values of the batch."""
        failed = self._optuna.trial.TrialState.FAIL
        for (trial, point), value in zip(self._waiting, values, strict=True):
            self.study.tell(trial, value, state=failed if value is None else None)
            self.points.append(replace(point, value=value))
        self._waiting = []


def _space_of(search: Search, optuna: Any) -> dict[str, Any]:
    """The distribution of each factor as Optuna has it."""
    kinds, found = optuna.distributions, {}
    for name, own in search.factors.items():
        if isinstance(own, Integers):
            found[name] = kinds.IntDistribution(own.low, own.high)
        elif isinstance(own, Distribution):
            found[name] = kinds.FloatDistribution(own.low, own.high, log=isinstance(own, LogUniform))
        else:
            found[name] = kinds.CategoricalDistribution(list(labels(name, own)))
    return found


def _run_batch(search: Search, batch: Sequence[Point], driver: Driver, *, of: _Asked) -> tuple[Outcome, ...]:
    new = [own for own in batch if not own.is_repeated and not own.reason]
    if not new:
        return ()
    values = [own.value for own in of.points if own.value is not None]
    best = max(values, default=None) if search.direction == "maximise" else min(values, default=None)
    so_far = "" if best is None else f", best {search.metric} so far {best:.6g}"
    numbers = f"points {batch[0].number + 1} to {batch[-1].number + 1} of {search.points}"
    return driver.run(trials_of(search.study_of(new)), f"{search.name}: {numbers}{so_far}")


def _sampler(optuna: Any, search: Search, number: int) -> Any:
    """A new sampler for each point, whose chance depends on the seed and the point's number alone."""
    text = f"{search.experiment.seed} {number}"
    seed = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest())
    if callable(search.sampler):
        return search.sampler(seed)
    if search.sampler == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    if search.sampler == "gp":
        return optuna.samplers.GPSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed, constant_liar=True)


def _as_table(search: Search, points: Sequence[Point]) -> dict[str, Any]:
    columns = ("number", "name", "value", "is_repeated", "reason")
    return {
        **{own: getattr(search, own) for own in ("metric", "direction", "over", "last", "at_once")},
        "points": [
            {**{own: getattr(point, own) for own in columns}, "levels": dict(point.levels)}
            for point in points
        ],
    }


def _write_journal(optuna: Any, study: Any, path: Path) -> None:
    """Writes what Optuna knows into a file that its own tools read."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".optuna-") as folder, _quiet(optuna):
        partial = Path(folder) / path.name
        backend = optuna.storages.journal.JournalFileBackend(str(partial))
        optuna.copy_study(
            from_study_name=study.study_name,
            from_storage=study._storage,
            to_storage=optuna.storages.JournalStorage(backend),
            to_study_name="search",
        )
        partial.replace(path)


@contextmanager
def _quiet(optuna: Any) -> Iterator[None]:
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(before)


def _optuna() -> Any:
    try:
        import optuna
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'Optuna is not installed; run pip install "cprl[optuna]"', name="optuna"
        ) from error
    return optuna
