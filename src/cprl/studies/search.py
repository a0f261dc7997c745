"""run_search: a search by Optuna, which proposes points from the values of those that were run before.

What was run is in the run directories, as it is for a study; Optuna itself keeps nothing. Point n depends on
the seed, n, and the values of the points before its batch alone, so a search that was stopped anywhere
proposes the same points again, finds their runs finished, and continues as if nothing had happened.
"""

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from cprl.arguments import object_of, switch
from cprl.arguments import path as path_of
from cprl.runs.files import write_json
from cprl.studies.directory import RUNS, directory_of, write_study
from cprl.studies.driver import Driver, as_driver, check_executor
from cprl.studies.execution import check_comparison, results_of
from cprl.studies.executors import Executor, InProcess
from cprl.studies.factors import Distribution, Integers, LogUniform
from cprl.studies.points import Point, Search, labels, value_of
from cprl.studies.study import Study
from cprl.studies.tables.comparing import LAST
from cprl.studies.tables.table import StudyTable
from cprl.studies.trials import Outcome, Trial, trials_of

FILE_NAME: Final = "search.json"
JOURNAL: Final = "optuna.journal"
"""For Optuna's own tools, e.g. its dashboard; written after each batch and never read."""


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
    allow: Sequence[str] = (),
    progress: bool = True,
    results: bool = True,
    last: int = LAST,
    again: str = "",
) -> SearchResult:
    """Runs a search; may be stopped at any moment, and called again, with more points too.

    Args:
        search: what is searched.
        out: see `cprl.studies.run_study`.
        on: see `cprl.studies.run_study`.
        runs: see `cprl.studies.run_study`.
        allow: see `cprl.studies.run_study`.
        progress: see `cprl.studies.run_study`.
        results: see `cprl.studies.run_study`.
        last: see `cprl.studies.run_study`; what the search itself looks at is in `Search`.
        again: see `cprl.studies.run_study`.

    Raises:
        ModuleNotFoundError: where Optuna is not installed.
        ValueError: for whatever does not fit, before anything is written.
    """
    object_of("search", search, Search, "a Search")
    check_executor(on)
    switch("results", results)
    check_comparison(last)
    optuna = _optuna()
    asked = _Asked(search, optuna)
    batch = asked.first_batch()
    study = search.study_of(batch)
    out = directory_of(study, out)
    folder = out / RUNS if runs is None else path_of("runs", runs)
    failed: list[Outcome] = []
    with as_driver(study, trials_of(study), out, folder, allow=allow, progress=progress) as driver:
        while batch:
            failed += _run_batch(search, batch, driver, on or InProcess(), of=asked)
            asked.tell([value_of(search, own, folder) for own in batch])
            study = search.study_of(asked.points)
            write_study(study, out)
            write_json(out / FILE_NAME, _as_table(search, asked.points))
            _write_journal(optuna, asked.study, out / JOURNAL)
            batch = asked.next_batch()
        trials = trials_of(study)
        how: Any = {"last": last, "again": again}
        table = results_of(study, trials, out, folder, **how) if results else None
    return SearchResult(search, study, out, folder, tuple(asked.points), tuple(trials), tuple(failed), table)


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
        """The first points of which one fits.

        Raises:
            ValueError: where the experiment refuses every point of the search.
        """
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


def _run_batch(
    search: Search, batch: Sequence[Point], driver: Driver, executor: Executor, *, of: _Asked
) -> tuple[Outcome, ...]:
    new = [own for own in batch if not own.is_repeated and not own.reason]
    if not new:
        return ()
    values = [own.value for own in of.points if own.value is not None]
    best = max(values, default=None) if search.direction == "maximise" else min(values, default=None)
    so_far = "" if best is None else f", best {search.metric} so far {best:.6g}"
    numbers = f"points {batch[0].number + 1} to {batch[-1].number + 1} of {search.points}"
    return driver.run(trials_of(search.study_of(new)), executor, title=f"{search.name}: {numbers}{so_far}")


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
