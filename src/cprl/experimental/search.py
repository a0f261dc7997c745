"""run_search: search for good values of an experiment with Optuna.

Optuna proposes points, which are combinations of values, from the results of earlier points. Each point is
run as a condition of a study. Optuna's storage is in `optuna/` in the directory of the search; the runs are
those of the study. A search that was stopped resumes the runs of points that have no value yet.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import pyarrow.compute as pc

from cprl.commons.game import Game
from cprl.experiment import Experiment
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME_EQUALITY, INSTITUTIONS, SOCIAL_METRICS
from cprl.measuring.table import by_replica, complete, stored_metrics
from cprl.measuring.tracker import custom_metric_name
from cprl.measuring.windows import last_of
from cprl.runs.episodes import read_episodes, read_rows
from cprl.runs.files import RunLock, digest_of
from cprl.studies.executors import Executor
from cprl.studies.factors import Distribution, Factor, Integers, LogUniform, levels_of
from cprl.studies.run import StudyResult, run_study
from cprl.studies.study import (
    RUNS,
    Replicas,
    Study,
    condition_name,
    directory_of,
    level_text,
    unique_name,
)
from cprl.studies.trials import TrialOutcome, trials_of
from cprl.system.defaults import LAST_EPISODES, REPLICAS_PER_RUN
from cprl.system.output import say
from cprl.values import DirectoryName, Positive, Range, Value, refusal

FOLDER: Final = "optuna"
"""The folder of Optuna's storage in the search's directory."""
JOURNAL: Final = "journal.log"
"""The file of Optuna's storage."""
Direction = Literal["maximise", "minimise"]
Episodes = Literal["evaluation", "training"]
SamplerName = Literal["tpe", "random", "gp"]
_TRIES: Final = 100
"""The number of random combinations of which at least one must be a valid experiment."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """A point of a search: one combination of values that Optuna proposed."""

    number: int
    """The number of Optuna's trial for this point."""
    name: str
    """The name of the point's condition. Equal points have the same condition."""
    levels: Mapping[str, Any]
    """The level of each factor, by factor: a number, or the text of a level."""
    changes: Mapping[str, Any]
    """The changes in the experiment, by path."""
    checksum: str = ""
    """The checksum of its condition."""
    reason: str = ""
    """The reason why the experiment refuses this combination, which is then not run; "" if it does not."""
    value: float | None = None
    """The mean of the metric over replicas; None if a run failed, the metric is undefined, or the point is
    refused."""


@dataclass(frozen=True, eq=False)
class Search(Value, stored=False):
    """A search: the experiment, the factors that are varied, and the metric whose best value is searched.

    Args:
        experiment: the experiment that all points start from.
        factors: the values to try, as for a `Study`: distributions, lists of values, or named levels.
        points: the number of points that Optuna proposes. Equal points count each time, but run once.
        metric: a metric of docs/metrics.md, e.g. "collective_return", "income" or "agent_0/return".
        direction: whether high or low values of the metric are better.
        over: the episodes that count: those of the evaluation, or the last ones of the training.
        last: the number of last episodes of the training.
        at_once: the number of points that are proposed together, without knowing each other's values. It
            changes which points are proposed, so choose it independently of the number of jobs.
        sampler: "tpe", "random" or "gp", or a function that returns a sampler of Optuna for a seed.
        replicas: the number of replicas of each point; see `Study`, also for `block` and `name`.
    """

    experiment: Experiment
    factors: Mapping[str, Factor]
    points: Annotated[int, Range(1, 100_000)] = field(kw_only=True)
    metric: str = field(default=COLLECTIVE_RETURN, kw_only=True)
    direction: Direction = field(default="maximise", kw_only=True)
    over: Episodes = field(default="evaluation", kw_only=True)
    last: Positive = field(default=30, kw_only=True)
    at_once: Annotated[int, Range(1, 4096)] = field(default=4, kw_only=True)
    sampler: SamplerName | Callable[[int], Any] = field(default="tpe", kw_only=True)
    replicas: Replicas | None = field(default=None, kw_only=True)
    block: Replicas = field(default=REPLICAS_PER_RUN, kw_only=True)
    name: DirectoryName | Literal[""] = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        game = self.experiment.game
        is_of_law = self.metric.startswith(INSTITUTIONS) or self.metric == INCOME_EQUALITY
        if isinstance(game, Game) and not (game.institutions and is_of_law):
            metrics = [
                *SOCIAL_METRICS,
                *map(custom_metric_name, self.experiment.metrics),
                *(f"agent_{agent}/return" for agent in range(game.agents)),
            ]
            if self.metric not in metrics:
                raise refusal("metric", self.metric, ", ".join(metrics))
        one = self._one_point()
        object.__setattr__(self, "factors", one.factors)
        object.__setattr__(self, "name", one.name)

    def _one_point(self) -> Study:
        """Return the study of one random point, to check the search before it runs.

        Some combinations of levels may be invalid. So it tries several, and raises if none is valid.
        """
        refused = []
        for number in range(_TRIES):
            experiment = replace(self.experiment, seed=self.experiment.seed + number)
            try:
                return Study(experiment, self.factors, draws=1, **self._plain())
            except ValueError as error:
                refused.append(error)
        raise refused[0]

    def _plain(self) -> dict[str, Any]:
        return {"replicas": self.replicas, "block": self.block, "name": self.name}

    def study_of(self, points: Sequence[Point]) -> Study:
        """Return the study of some points, as named conditions: equal points once, refused points not."""
        conditions = {point.name: point.changes for point in points if not point.reason}
        return Study(self.experiment, conditions=conditions, **self._plain())

    def identity(self, out: Path) -> str:
        """Return a text that identifies the search in its directory. It does not depend on `points`, so a
        search can be continued with more points."""
        sampler = getattr(self.sampler, "__qualname__", str(self.sampler))
        rules = self.metric, self.direction, self.over, self.last, self.at_once, sampler
        text = json.dumps([self._one_point().to_config(out), rules], sort_keys=True)
        return f"{self.name} {digest_of(text, size=6)}"


@dataclass(frozen=True, eq=False)
class SearchResult(StudyResult):
    """The state of a search after a call of `run_search`."""

    search: Search
    points: tuple[Point, ...] = field(repr=False)

    @property
    def ranked(self) -> list[Point]:
        """Return the points that have a value, without repetitions, the best one first."""
        by_name = {point.name: point for point in self.points if point.value is not None}
        sign = -1.0 if self.search.direction == "maximise" else 1.0
        return sorted(by_name.values(), key=lambda point: sign * (point.value or 0.0))


def run_search(
    search: Search,
    out: Path | str | None = None,
    *,
    on: Executor | None = None,
    runs: Path | str | None = None,
    progress: bool = True,
    results: bool = True,
    last: int = LAST_EPISODES,
    again: str = "",
) -> SearchResult:
    """Run a search. You can stop it at any moment and call it again, also with more points.

    The arguments are those of `run_study`. The next call tries points again whose runs failed.

    Raises:
        RunLockedError: if another process runs a search in the same directory.
        ValueError: if the experiment refuses every point.
    """
    out = directory_of(search.study_of([]), out)
    pool = out / RUNS if runs is None else Path(runs)
    run = partial(run_study, out=out, on=on, runs=pool, progress=progress, last=last, again=again)
    failed: list[TrialOutcome] = []
    with _optuna() as optuna:
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        with RunLock(out / FOLDER):
            proposals = _Proposals(search, out, optuna)
            while batch := proposals.next_batch():
                if progress:
                    say(proposals.heading(batch))
                fitting = [point.name for point in batch if not point.reason]
                if fitting:
                    failed += run(search.study_of(proposals.points), only=fitting, results=False).failed
                proposals.record_values(batch, pool)
            points = proposals.points
            if all(point.reason for point in points):
                reason = f"the first, {points[0].name}: {points[0].reason}"
                raise ValueError(f"none of the search's {len(points)} points fits; {reason}")
            valued = [point.name for point in points if point.value is not None]
            result = run(search.study_of(points), only=valued, results=results)
    return SearchResult(**{**vars(result), "failed": tuple(failed)}, search=search, points=tuple(points))


class _Proposals:
    """The points of a search: it asks Optuna for new ones and reports their values to Optuna."""

    def __init__(self, search: Search, out: Path, optuna: Any) -> None:
        self._search = search
        self._optuna = optuna
        self._failed = optuna.trial.TrialState.FAIL
        path = str(out / FOLDER / JOURNAL)
        backends = optuna.storages.journal
        Path(f"{path}.lock").unlink(missing_ok=True)  # of a process that died: whoever lives holds our lock
        # The other kind of lock wants symbolic links.
        backend = backends.JournalFileBackend(path, lock_obj=backends.JournalFileOpenLock(path))
        self._study = optuna.create_study(
            study_name=search.identity(out),
            storage=optuna.storages.JournalStorage(backend),
            direction=search.direction.replace("se", "ze"),
            load_if_exists=True,
        )
        self._by_number: dict[int, Point] = {}
        self._open: list[Point] = []
        for trial in self._study.trials:
            if trial.params.keys() == search.factors.keys():
                point = self._add(trial.number, trial.params, trial.value)
                self._open += [] if trial.state.is_finished() else [point]
            elif not trial.state.is_finished():  # it was stopped while it was proposed
                self._study.tell(trial.number, state=self._failed)

    @property
    def points(self) -> list[Point]:
        """Return all points so far, ordered by number."""
        return list(self._by_number.values())

    def next_batch(self) -> list[Point]:
        """Return the points to run next; [] at the end. The first batch has the points that were stopped."""
        batch = self._open
        self._open = []
        first = len(self._study.trials)
        at_once = self._search.at_once
        end = math.ceil((first if batch else first + 1) / at_once) * at_once
        for number in range(first, min(end, self._search.points)):
            self._study.sampler = self._sampler(number)
            trial = self._study.ask(self._space())
            batch.append(self._add(number, trial.params))
            if batch[-1].reason:
                trial.set_user_attr("reason", batch[-1].reason)
        return batch

    def record_values(self, batch: Sequence[Point], runs: Path) -> None:
        """Report the values of a batch to Optuna. Points whose runs failed stay open for the next call."""
        for point in batch:
            value = value_of(self._search, point, runs)
            if point.reason or (value is not None and not math.isfinite(value)):
                self._study.tell(point.number, state=self._failed)
            elif value is not None:
                self._study.tell(point.number, value)
                self._by_number[point.number] = replace(point, value=value)

    def heading(self, batch: Sequence[Point]) -> str:
        """Return a line about the next batch and the best value so far."""
        search = self._search
        is_high = self._search.direction == "maximise"
        values = [point.value for point in self.points if point.value is not None]
        best = f", best {search.metric} so far {(max if is_high else min)(values):.6g}" if values else ""
        first = batch[0].number + 1
        final = batch[-1].number + 1
        return f"{search.name}: points {first} to {final} of {search.points}{best}"

    def _add(self, number: int, params: Mapping[str, Any], value: float | None = None) -> Point:
        """Add the point of a trial of Optuna, and return it; a refused point gets the reason instead of
        raising, as later points may be valid."""
        factors = self._search.factors
        changes: dict[str, Any] = {}
        for name, factor in factors.items():
            is_drawn = isinstance(factor, Distribution)
            changes |= {name: params[name]} if is_drawn else _labelled(name, factor)[params[name]]
        name = condition_name({factor: params[factor] for factor in factors})
        point = Point(number=number, name=name, levels={**params}, changes=changes, value=value)
        try:
            checksum = self._search.study_of([point]).all_conditions[0].checksum
        except ValueError as error:
            point = replace(point, reason=str(error))
        else:
            names = {other.name for other in self.points}  # of six digits, and points may differ in the next
            new = replace(point, name=unique_name(name, names), checksum=checksum)
            same = next((other for other in self.points if other.checksum == checksum), new)
            point = replace(new, name=same.name, changes=same.changes)
        self._by_number[number] = point
        return point

    def _space(self) -> dict[str, Any]:
        """Return the distribution of Optuna for each factor."""
        kinds = self._optuna.distributions
        space: dict[str, Any] = {}
        for name, factor in self._search.factors.items():
            if isinstance(factor, Integers):
                space[name] = kinds.IntDistribution(factor.low, factor.high)
            elif isinstance(factor, Distribution):
                is_log = isinstance(factor, LogUniform)
                space[name] = kinds.FloatDistribution(factor.low, factor.high, log=is_log)
            else:
                space[name] = kinds.CategoricalDistribution([*_labelled(name, factor)])
        return space

    def _sampler(self, number: int) -> Any:
        """Return the sampler of a point.

        Its random numbers depend only on the seed and the point's number. So a search that was stopped
        proposes the same points.
        """
        text = f"{self._search.experiment.seed} {number}"
        seed = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest())
        samplers = self._optuna.samplers
        sampler = self._search.sampler
        if callable(sampler):
            return sampler(seed)
        if sampler == "tpe":
            return samplers.TPESampler(seed=seed, constant_liar=True)
        return {"random": samplers.RandomSampler, "gp": samplers.GPSampler}[sampler](seed=seed)


def _labelled(name: str, factor: Factor) -> dict[str, Mapping[str, Any]]:
    """Return the changes of each level of a factor, by the text that Optuna stores for the level."""
    labelled: dict[str, Mapping[str, Any]] = {}
    for level in levels_of(name, factor):
        labelled[unique_name(level_text(level.value), labelled)] = level.changes
    return labelled


def value_of(search: Search, point: Point, runs: Path) -> float | None:
    """Return the mean of the metric over the replicas of a point; NaN if it is undefined.

    None if a run of the point is not finished, or if the experiment refuses the point.
    """
    if point.reason:
        return None
    means: list[float] = []
    for trial in trials_of(search.study_of([point]), runs):
        run = trial.directory
        if trial.state() != "finished":
            return None
        if search.over == "evaluation":
            rows = read_rows(run / "evaluation" / "trained.parquet")
        else:
            rows = last_of(read_episodes(run), search.last)
        try:
            values = by_replica(rows, search.metric)["value"]
        except KeyError as error:
            reported = ", ".join(sorted(stored_metrics(complete(rows).schema)))
            raise refusal(
                "metric", search.metric, f"what the game reports: {reported}, agent_0/return and so on"
            ) from error
        means += pc.fill_null(values, math.nan).to_pylist()
    return float(np.mean(means))


@contextmanager
def _optuna() -> Iterator[Any]:
    """Import Optuna, which logs nothing but errors while it is used."""
    try:
        import optuna
    except ModuleNotFoundError as error:
        cure = 'run pip install "cprl[optuna]"'
        raise ModuleNotFoundError(f"Optuna is not installed; {cure}", name="optuna") from error
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        yield optuna
    finally:
        optuna.logging.set_verbosity(before)
