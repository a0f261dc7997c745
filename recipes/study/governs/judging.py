"""Did a study find what was expected of it? Each expectation beside its outcome, the failed ones first.

    python recipes/study/governs/judging.py --study recipes/study/governs/changes.py

To be run in the root of the repository: reads docs/results/studies/NAME/table.parquet and frozen.parquet, and
bounds.csv of sheet.py, and writes docs/results/studies/NAME/judged.md. asking.py says by which rules
expectations are judged.

A difference is the mean of some conditions minus that of others in each replica, with its 95 % interval by
Student's t over replicas. "Frozen at 0.05" is the evaluation of the study's table, "frozen at 0.1" that of
frozen.py, "while learning" the last 32 episodes of each replica, two of each world.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from math import inf, isnan, nan
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tyro
from asking import RESULTS, WORLDS, Expectation
from bounds import BOUNDS, Bound, bound_of, read_bounds
from finished import module_of, name_among
from page import section
from schedules import exploration_at_end

from cprl import Study
from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY, title
from cprl.measuring.statistics import Estimate, difference, estimate, holm
from cprl.measuring.table import by_replica, where
from cprl.studies.study import Condition
from cprl.studies.tables.tidy_table import EVALUATION_PART, TRAINING_PART, StudyTable
from cprl.values.array_types import Float64

LAST: Final = 2 * WORLDS
"""Episodes at the end of a training."""
Measure = Literal["frozen at 0.05", "frozen at 0.1", "while learning"]
FROZEN: Final = "frozen at 0.05"
MORE_EXPLORATION: Final = "frozen at 0.1"
LEARNING: Final = "while learning"
MEASURES: Final[tuple[Measure, ...]] = (FROZEN, MORE_EXPLORATION, LEARNING)
Verdict = Literal["failed", "cannot be told", "as expected"]
VERDICTS: Final[tuple[Verdict, ...]] = ("failed", "cannot be told", "as expected")


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What the conditions of a study came to, and those of other studies beside it."""

    table: StudyTable
    frozen: pa.Table | None = None
    """The table of frozen.py; None where agents have not been played again."""
    others: Path = RESULTS
    """The directory of other studies, for conditions "STUDY/CONDITION"."""
    _windows: dict[str, pa.Table] = field(default_factory=dict, repr=False)

    @classmethod
    def read(cls, study: str, results: Path = RESULTS) -> "Outcomes":
        """Read the tables of a study."""
        frozen = results / study / "frozen.parquet"
        return cls(
            table=StudyTable.read(results / study / "table.parquet"),
            frozen=pq.read_table(frozen) if frozen.exists() else None,
            others=results,
        )

    def values(self, condition: str, metric: str = INCOME, measure: Measure = FROZEN) -> dict[int, float]:
        """Return the mean of a metric in each replica of a condition, by the replica; {} if nobody has
        measured it."""
        if condition not in self.table.design.conditions:
            study, slash, name = condition.partition("/")
            if not slash:
                raise ValueError(f"the study {self.table.design.name} has no condition {condition!r}")
            return outcomes_of(study, self.others).values(name, metric, measure)
        rows = where(self._rows(measure), condition=condition)
        names = rows["metric"].unique().to_pylist()
        name = name_among(names, metric)
        if measure == MORE_EXPLORATION and name not in names:
            return {}  # frozen.parquet has the metrics of single agents for some conditions alone
        if names and name not in names:
            raise ValueError(f"metric is {metric!r}; allowed for {condition}: {', '.join(names)}")
        rows = where(rows, metric=name) if measure == MORE_EXPLORATION else by_replica(rows, name)
        means = dict(zip(rows["replica"].to_pylist(), rows["value"].to_pylist(), strict=True))
        return {replica: value for replica, value in sorted(means.items()) if value is not None}

    def _rows(self, measure: Measure) -> pa.Table:
        if measure not in self._windows:
            self._windows[measure] = self._read_rows(measure)
        return self._windows[measure]

    def _read_rows(self, measure: Measure) -> pa.Table:
        if measure == FROZEN:
            return self.table.windows(EVALUATION_PART)
        if measure == LEARNING:
            return self.table.windows(TRAINING_PART, last=LAST)
        if self.frozen is None:
            return self.table.rows.slice(0, 0)
        return where(self.frozen, exploration=0.1)


@cache
def outcomes_of(study: str, results: Path = RESULTS) -> Outcomes:
    """Return `Outcomes.read`, read once."""
    return Outcomes.read(study, results)


def means_of(
    outcomes: Outcomes, conditions: Sequence[str], metric: str, measure: Measure
) -> dict[int, float]:
    """Return the mean over conditions in each replica that all of them have."""
    values = [outcomes.values(condition, metric, measure) for condition in conditions]
    replicas = sorted(set.intersection(*map(set, values)))
    return {replica: float(np.mean([by[replica] for by in values])) for replica in replicas}


def contrast(outcomes: Outcomes, expectation: Expectation, measure: Measure) -> Float64:
    """Return the difference that an expectation is about, in each replica that all conditions have, [R]."""
    more = means_of(outcomes, expectation.more, expectation.metric, measure)
    less = means_of(outcomes, expectation.less, expectation.metric, measure)
    return np.array([more[replica] - less[replica] for replica in more if replica in less])


def one_sided(values: Float64, at_least: float) -> float:
    """Return the p of a mean above a number by Student's t, if it were the number."""
    change = estimate(values - at_least)
    return change.p_value / 2 if change.value > 0 else 1 - change.p_value / 2


def p_values(values: Float64, margin: float) -> tuple[float, float]:
    """Return the p of a difference that lies within a margin around 0, and that of one which lies beyond.

    The first is that of two one-sided tests (TOST); the second the smaller one of two, either way.
    """
    within = max(one_sided(values, -margin), one_sided(-values, -margin))
    beyond = min(one_sided(values, margin), one_sided(-values, margin))
    return within, beyond


@dataclass(frozen=True, kw_only=True)
class Judged:
    """An expectation beside its outcome."""

    expectation: Expectation
    changes: Mapping[Measure, Estimate]
    """The difference by measure; one that nobody has measured is not there."""
    p_value: float
    """Its p in the family of its study, see `asking`."""
    verdict: Verdict

    @property
    def measure(self) -> Measure:
        """Return the measure of the primary outcome."""
        return LEARNING if self.expectation.part == TRAINING_PART else FROZEN

    @property
    def change(self) -> Estimate:
        """Return the difference in the primary outcome."""
        return self.changes[self.measure]


def p_of(expectation: Expectation, values: Float64) -> float:
    """Return the p of an expectation in the family of its study."""
    if len(values) < 2:
        return nan
    if expectation.sign != "same":
        return estimate(values).p_value
    return min(1.0, 2 * min(p_values(values, expectation.margin)))


def verdict_of(expectation: Expectation, values: Float64, *, is_significant: bool) -> Verdict:
    """Return the verdict on an expectation."""
    if not is_significant:
        return "cannot be told"
    if expectation.sign == "same":
        within, beyond = p_values(values, expectation.margin)
        return "as expected" if within < beyond else "failed"
    is_more = bool(values.mean() > 0)
    return "as expected" if is_more == (expectation.sign == "more") else "failed"


def judge(outcomes: Outcomes, expectations: Sequence[Expectation]) -> list[Judged]:
    """Return all expectations whose conditions have run with their verdicts, in their order."""
    judged: list[Judged] = []
    primary: list[Float64] = []
    for expectation in expectations:
        differences = {measure: contrast(outcomes, expectation, measure) for measure in MEASURES}
        changes = {measure: estimate(values) for measure, values in differences.items() if len(values)}
        values = differences[LEARNING if expectation.part == TRAINING_PART else FROZEN]
        if not len(values):
            continue
        primary.append(values)
        judged.append(
            Judged(
                expectation=expectation,
                changes=changes,
                p_value=p_of(expectation, values),
                verdict="cannot be told",
            )
        )
    are_significant = holm([one.p_value for one in judged])
    return [
        replace(one, verdict=verdict_of(one.expectation, values, is_significant=bool(significant)))
        for one, values, significant in zip(judged, primary, are_significant, strict=True)
    ]


UNMEASURED: Final = "not measured"


def change_text(change: Estimate | None) -> str:
    """Return a difference with its interval."""
    return UNMEASURED if change is None else f"{change:+}"


def second_outcome(expectations: Sequence[Expectation]) -> list[Expectation]:
    """Return the same expectations of the end of the training, where agents still learn."""
    return [replace(one, part=TRAINING_PART) for one in expectations]


def counts_text(judged: Sequence[Judged]) -> str:
    """Return how many expectations have which verdict."""
    counts = [f"{sum(one.verdict == verdict for one in judged)} {verdict}" for verdict in VERDICTS]
    return f"of {len(judged)} expectations {', '.join(counts)}"


def judged_lines(
    judged: Sequence[Judged], second: Sequence[Judged], expectations: Sequence[Expectation]
) -> list[str]:
    """Return the sections of the verdicts in Markdown, failed expectations first, and what has not run.

    Args:
        judged: by the primary outcome.
        second: by the `second_outcome`.
    """
    failed = [one.expectation.label for one in second if one.verdict == "failed"]
    lines = [
        f"By the primary outcome, {counts_text(judged)}: one family. Differences are of income, in apples an "
        "episode, where nothing else is said; the primary one is bold, and p is its.",
        "",
    ]
    if any(one.measure == FROZEN for one in judged):
        lines += [
            f"By the second outcome, while agents learn, {counts_text(second)}: a family of its own. Failed "
            f"there: {'; '.join(failed) or 'none'}.",
            "",
        ]
    head = ["difference", "expected", "because", *MEASURES, "p", "replicas"]
    for verdict in VERDICTS:
        rows = [_cells(one) for one in judged if one.verdict == verdict]
        lines += section(verdict.capitalize(), head, rows)
    known = [one.expectation for one in judged]
    missing = [one.label for one in expectations if one not in known]
    return lines + ([f"Not run: {'; '.join(missing)}.", ""] if missing else [])


def _cells(one: Judged) -> list[str]:
    expectation = one.expectation
    label = expectation.label
    if expectation.metric != INCOME:
        label += f", {title(expectation.metric)}"
    texts = {measure: change_text(one.changes.get(measure)) for measure in MEASURES}
    texts[one.measure] = f"**{texts[one.measure]}**"
    p_value = "one replica" if isnan(one.p_value) else f"{one.p_value:.2g}"
    return [label, expectation.sign, expectation.why, *texts.values(), p_value, str(one.change.replicas)]


CONDITION_COLUMNS: Final = (
    *("condition", "replicas", "income frozen at 0.05", "income frozen at 0.1", "income while learning"),
    *("frozen at 0.05 - while learning", "equality of income", "survival, turns"),
    *("harvest, of the most possible", "of the best known", "exploration at the end"),
)


def condition_lines(study: Study, outcomes: Outcomes, bounds: Mapping[str, Bound]) -> list[str]:
    """Return the table of all conditions that have run, in Markdown."""
    rows = []
    for condition in study.all_conditions:
        frozen = outcomes.values(condition.name)
        if not frozen:
            continue
        learning = outcomes.values(condition.name, measure=LEARNING)
        more_exploration = outcomes.values(condition.name, measure=MORE_EXPLORATION)
        equality = outcomes.values(condition.name, INCOME_EQUALITY)
        turns = outcomes.table.design.clocks.get(condition.name, inf)
        survival = outcomes.values(condition.name, "survival_steps")
        rows.append(
            [
                condition.name,
                str(len(frozen)),
                mean_text(frozen),
                mean_text(more_exploration),
                mean_text(learning),
                f"{difference([*frozen.values()], [*learning.values()], paired=True):+}",
                mean_text(equality, INCOME_EQUALITY),
                mean_text(survival, "survival_steps", turns),
                *share_texts(condition, outcomes, bounds),
                exploration_at_end(condition.experiment, outcomes.table.lengths[condition.name]["steps"]),
            ]
        )
    note = "Equality, survival and shares are of frozen agents at 0.05; the best known is that of bounds.csv."
    return section("All conditions", CONDITION_COLUMNS, rows, note)


def share_texts(condition: Condition, outcomes: Outcomes, bounds: Mapping[str, Bound]) -> tuple[str, str]:
    """Return the harvest of frozen agents as a share of the most possible, and of the best known."""
    bound = bound_of(condition.experiment.game, bounds)
    if bound is None:
        return UNMEASURED, UNMEASURED
    harvest = estimate([*outcomes.values(condition.name, COLLECTIVE_RETURN).values()])
    return f"{harvest.value / bound.at_most:.0%}", f"{harvest.value / bound.best_known:.0%}"


def exploration_lines(study: Study, outcomes: Outcomes) -> list[str]:
    """Return the income of frozen agents at each exploration, where more than two were measured."""
    if outcomes.frozen is None:
        return []
    explorations = sorted(outcomes.frozen["exploration"].unique().to_pylist())
    rows = []
    for condition in study.all_conditions:
        measured = where(outcomes.frozen, condition=condition.name, metric=INCOME)
        values = [where(measured, exploration=one)["value"].to_pylist() for one in explorations]
        rows.append([condition.name, *(mean_text(dict(enumerate(each))) for each in values)])
    head = ["condition", *(f"exploration {one:g}" for one in explorations)]
    return section("Income of frozen agents, by exploration", head, rows) if len(explorations) > 2 else []


def mean_text(values: Mapping[int, float], metric: str = INCOME, turns: float = inf) -> str:
    """Return the mean over replicas with its interval, which ends where the metric does."""
    return str(estimate([*values.values()]).bounded(metric, turns)) if values else UNMEASURED


def judged_page(study: Path, results: Path = RESULTS) -> list[str]:
    """Return judged.md of the study in a file."""
    module = module_of(study)
    name = module.STUDY.name
    outcomes = outcomes_of(name, results)
    bounds = read_bounds(results.parent / "governs" / BOUNDS.name)
    judged = judge(outcomes, module.EXPECTATIONS)
    second = judge(outcomes, second_outcome(module.EXPECTATIONS))
    return [
        f"# {name}: {module.STUDY.question}",
        "",
        f"By `python recipes/study/governs/judging.py --study recipes/study/governs/{study.name}`, which "
        "says what the columns mean.",
        "",
        *judged_lines(judged, second, module.EXPECTATIONS),
        *condition_lines(module.STUDY, outcomes, bounds),
        *exploration_lines(module.STUDY, outcomes),
    ]


def main(*, study: Path, results: Path = RESULTS) -> None:
    """Write judged.md of a study.

    Args:
        study: the file of the study.
        results: the directory of the results of all studies.
    """
    lines = judged_page(study, results)
    page = results / module_of(study).STUDY.name / "judged.md"
    page.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    with exit_with_message("judging.py"):
        tyro.cli(main)
