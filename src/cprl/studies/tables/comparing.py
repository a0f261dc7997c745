"""Comparisons of conditions: means of metrics over replicas, and differences from the reference.

Intervals are by Student's t over replicas, each for a single comparison. A table with several comparisons
marks the differences that are significant by Holm's method: with a probability of 95 %, none of the marked
differences is due to chance.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Final, Literal

import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    EQUALITY,
    INCOME,
    METRICS,
    is_custom_metric,
    title,
)
from cprl.measuring.social import are_equal
from cprl.measuring.statistics import (
    CONFIDENCE,
    CUT_NOTE,
    Estimate,
    Family,
    differences,
    estimates,
    samples_of,
)
from cprl.measuring.table import by_replica, where
from cprl.pictures.readable import capitalised
from cprl.studies.tables.tidy_table import RANDOM_PART, TRAINING_PART, StudyTable
from cprl.terminal.text_tables import Change, TableCell, TextTable
from cprl.values import refusal

COMPARED_METRICS: Final = (
    COLLECTIVE_RETURN,
    INCOME,
    EQUALITY,
    "sustainability",
    "survival_steps",
    "peacefulness",
)
"""The metrics that are compared by default, if a table has them."""
INSTITUTION_METRICS: Final = ("institutions/fines", "institutions/violations")
"""Metrics of institutions that a table shows beside the others. Their differences are not tested."""
INTERVALS: Final = f"{CONFIDENCE:.0%} intervals over replicas by Student's t"

Comparison = Literal["levels", "differences"]


def condition_means(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING_PART) -> Family:
    """Return the means of metrics over replicas, by condition and metric.

    Args:
        metrics: see `compared_metrics`.
        part: "training", "evaluation" or "random".
    """
    chosen = compared_metrics(table, metrics, part=part)
    clocks = table.design.clocks
    means = estimates(table.windows(part), chosen, by="condition")
    return means.changed(lambda key, estimate: estimate.bounded(key[1], clocks.get(key[0], inf)))


def condition_differences(table: StudyTable, metrics: Sequence[str], *, part: str = TRAINING_PART) -> Family:
    """Return the differences of conditions from the reference condition, by condition and metric."""
    chosen = compared_metrics(table, metrics, part=part)
    reference = {"condition": table.design.reference}
    rows = table.windows(part)
    changes = differences(rows, chosen, "condition", reference, paired=table.design.is_paired)
    return changes.changed(
        lambda _, estimate: replace(estimate, bounds=(-inf, inf))
    )  # as Student's t gives them


def values_of(rows: pa.Table, metric: str) -> dict[str, dict[int, float]]:
    """Return the mean of a metric by condition and replica, ascending, of the replicas that have it."""
    return {
        condition: dict(sorted(sample.values.items()))
        for (condition,), sample in samples_of(rows, metric, ["condition"]).items()
    }


def compared_metrics(
    table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING_PART
) -> tuple[str, ...]:
    """Return the metrics to compare: those asked for, after a check that the table has them.

    The default is all of `COMPARED_METRICS` and of the user's own metrics that the table has, without those
    that only repeat another one, see `duplicate_metrics`.

    Raises:
        ValueError: for a metric that the table does not have.
    """
    for metric in metrics:
        if metric not in table.metrics:
            allowed = ", ".join(table.metrics) or "none, as the table has no finished run"
            raise refusal("metric", metric, allowed)
    if metrics:
        return tuple(metrics)
    repeated = duplicate_metrics(table, part)
    usual = [metric for metric in COMPARED_METRICS if metric in table.metrics and metric not in repeated]
    return (*usual, *filter(is_custom_metric, table.metrics))


def institution_metrics_in(table: StudyTable, part: str = TRAINING_PART) -> tuple[str, ...]:
    """Return the `INSTITUTION_METRICS` that are above 0 in any window of a part."""
    rows = where(table.rows, part=part)
    above_0 = rows.filter(pc.greater(rows["value"], 0))["metric"].unique().to_pylist()
    return tuple(metric for metric in INSTITUTION_METRICS if metric in above_0)


def duplicate_metrics(table: StudyTable, part: str) -> dict[str, str]:
    """Return the metrics that only repeat another metric, by metric.

    For example, income equals the collective return as long as nobody pays a fine. Such a metric has the same
    value as the other one in every window of the part.
    """
    rows = where(table.rows, part=part)
    same_as = {name: metric.same_as for name, metric in METRICS.items() if metric.same_as in table.metrics}
    return {
        metric: other
        for metric, other in same_as.items()
        if metric in table.metrics and other and _are_equal(rows, metric, other)
    }


def _are_equal(rows: pa.Table, metric: str, other: str) -> bool:
    first, second = (where(rows, metric=name) for name in (metric, other))
    places = ["condition", "replica", "episode"]
    if not first.select(places).equals(second.select(places)):
        return False
    return are_equal(first["value"].to_numpy(), second["value"].to_numpy())


def episodes_text(table: StudyTable, part: str = TRAINING_PART, *, metric: str | None = None) -> str:
    """Return a text for the episodes that are compared, e.g. "the last 30 episodes of training"."""
    played = by_replica(table.windows(part), metric or table.metrics[0], ["condition"])
    is_of_people = pc.is_in(played["condition"], pa.array(table.hosted_conditions, pa.string()))
    texts = ["the episodes that people played"] * bool(pc.any(is_of_people).as_py())
    played = played.filter(pc.invert(is_of_people))
    if len(played):
        texts = [_trained_text(table, part, played), *texts]
    return " and ".join(texts) or "no episodes"


def _trained_text(table: StudyTable, part: str, played: pa.Table) -> str:
    """Return a text for the episodes of conditions that were trained."""
    low, high = pc.min_max(played["episodes"]).as_py().values()
    number = f"{high}" if low == high else f"{low} to {high}"
    if part == TRAINING_PART:
        return f"the last {number} episodes of training"
    agents = "the trained agents" if table.agents_learn else "the agents"
    return f"{number} fresh episodes of {'random play' if part == RANDOM_PART else agents}"


def pairing_text(table: StudyTable) -> str:
    """Return a text that says whether differences are paired by replica."""
    is_paired = table.design.is_paired
    return "paired by replica" if is_paired else "not paired: each condition has chance of its own"


def condition_table(
    table: StudyTable,
    metrics: Sequence[str] = (),
    kind: Comparison = "levels",
    *,
    part: str = TRAINING_PART,
) -> TextTable:
    """Return a table for people, with a row for each condition and a column for each metric.

    Args:
        kind: "levels", means over replicas; or "differences" from the reference.
    """
    chosen = compared_metrics(table, metrics, part=part)
    reference = table.design.reference
    is_levels = kind == "levels"
    family = (condition_means if is_levels else condition_differences)(table, chosen, part=part)
    played = by_replica(table.windows(part), chosen[0], ["condition"])["condition"].to_pylist()
    rows: list[list[TableCell]] = []
    for name in table.design.conditions:
        replicas = played.count(name)
        numbers = [family.get((name, metric)) for metric in chosen]
        if is_levels:
            rows.append([name, str(replicas), *(number or "-" for number in numbers)])
        elif name != reference:
            rows.append([name, str(replicas), *(difference_cell(number, replicas) for number in numbers)])
    what = "means over replicas"
    note = CUT_NOTE if any(estimate.is_cut for estimate in family.values()) else ""
    if not is_levels:
        what = f"differences from {reference}, {pairing_text(table)}"
        note = family.note("of this table")
    episodes = capitalised(episodes_text(table, part, metric=chosen[0]))
    heading = f"{episodes}; {what}; {INTERVALS}."
    return TextTable(heading, ["condition", "replicas", *map(title, chosen)], rows, note)


def difference_cell(difference: Estimate | None, replicas: int = 0) -> TableCell:
    """Return the cell of a difference. It says how many pairs there are if a replica has no value."""
    if difference is None:
        return "-"
    pairs = difference.replicas
    return Change(difference, f"(of {pairs})" * (pairs < replicas))


def comparison_tables(
    table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING_PART
) -> list[TextTable]:
    """Return the tables that a summary shows: means, differences from the reference, and institutions.

    A table without a finished run gives no tables; a single condition gives no differences.
    """
    chosen = compared_metrics(table, metrics, part=part)
    if not chosen:
        return []
    levels = condition_table(table, metrics, part=part)
    if not metrics:
        note = "\n".join(filter(None, (levels.note, duplicates_note(table, part))))
        levels = levels._replace(note=note)
    tables = [levels]
    if len(table.design.conditions) > 1:
        tables.append(condition_table(table, metrics, "differences", part=part))
    measures = () if metrics else institution_metrics_in(table, part)
    return [*tables, without_unfinished(condition_table(table, measures, part=part))] if measures else tables


def duplicates_note(table: StudyTable, part: str) -> str:
    """Return a sentence on the default metrics that are left out as duplicates; "" if there are none."""
    parts = [
        f"{title(metric).partition(',')[0]} is the same as {title(other).partition(',')[0]}"
        for metric, other in duplicate_metrics(table, part).items()
        if metric in COMPARED_METRICS
    ]
    return f"Not shown: {'; '.join(parts)} here, in every replica." if parts else ""


def without_unfinished(table: TextTable) -> TextTable:
    """Return a table of `condition_table` without the conditions that have no finished run."""
    return table._replace(rows=[row for row in table.rows if row[1] != "0"])
