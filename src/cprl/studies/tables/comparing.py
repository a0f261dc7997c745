"""Conditions compared: means of metrics over replicas, and their differences from the reference, as texts.

Intervals are by Student's t over replicas, each of a single comparison. Where a table makes several, those
that are marked differ by Holm's method: with 95 % none of the marked ones is by chance.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.registry import COLLECTIVE_RETURN, EQUALITY, INCOME, is_own, title
from cprl.measuring.registry import METRICS as REGISTERED
from cprl.measuring.statistics import CONFIDENCE, CUT, Estimate, Family, differences, estimates
from cprl.measuring.table import by_replica, where
from cprl.studies.tables.table import LAST as LAST
from cprl.studies.tables.table import RANDOM, TRAINING, StudyTable
from cprl.terminal.tables import Cell, Cells, Change
from cprl.values import refusal

METRICS: Final = (COLLECTIVE_RETURN, INCOME, EQUALITY, "sustainability", "survival_steps", "peacefulness")
"""Metrics that are compared, unless others are asked for, where a table has them."""
MEASURES: Final = ("institutions/fines", "institutions/violations")
"""What institutions took and found, which stands beside the metrics and is not tested."""
INTERVALS: Final = f"{CONFIDENCE:.0%} intervals over replicas by Student's t"

Kind = Literal["levels", "differences"]
_ROUNDING: Final = 1e-6
"""What payments of float32 round off, of a value."""


def levels_of(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> Family:
    """Return the means of metrics over replicas, by condition and metric.

    Args:
        metrics: see `metrics_of`.
        part: "training", "evaluation" or "random".
    """
    chosen = metrics_of(table, metrics, part=part)
    clocks = table.design.clocks
    means = estimates(table.windows(part), chosen, by="condition")
    return means.changed(lambda key, one: one.of(key[1], clocks.get(key[0], inf)))


def differences_of(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> Family:
    """Return the differences of conditions from the reference, by condition and metric; see `levels_of`."""
    chosen = metrics_of(table, metrics, part=part)
    reference = {"condition": table.design.reference}
    rows = table.windows(part)
    changes = differences(rows, chosen, "condition", reference, paired=table.design.is_paired)
    return changes.changed(lambda _, one: replace(one, bounds=(-inf, inf)))  # as Student's t gives them


def values_of(rows: pa.Table, metric: str) -> dict[str, dict[int, float]]:
    """Return the mean of each replica in which a metric is defined, by condition and replica, in order."""
    values: dict[str, dict[int, float]] = {}
    for row in by_replica(rows, metric, ["condition"]).sort_by("replica").to_pylist():
        of_condition = values.setdefault(row["condition"], {})
        if row["value"] is not None:
            of_condition[row["replica"]] = row["value"]
    return values


def metrics_of(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> tuple[str, ...]:
    """Return the metrics asked for, by default those of `METRICS` and of the user's own that a table has,
    without those of `repeated_in`."""
    for metric in metrics:
        if metric not in table.metrics:
            allowed = ", ".join(table.metrics) or "none, as the table has no finished run"
            raise refusal("metric", metric, allowed)
    if metrics:
        return tuple(metrics)
    repeated = repeated_in(table, part)
    usual = [metric for metric in METRICS if metric in table.metrics and metric not in repeated]
    return (*usual, *filter(is_own, table.metrics))


def measures_of(table: StudyTable, part: str = TRAINING) -> tuple[str, ...]:
    """Return those of `MEASURES` that a table has and that are not 0 in all windows of a part."""
    rows = where(table.rows, part=part)
    above_0 = rows.filter(pc.greater(rows["value"], 0))["metric"].unique().to_pylist()
    return tuple(metric for metric in MEASURES if metric in above_0)


def repeated_in(table: StudyTable, part: str) -> dict[str, str]:
    """Return the metrics that are the same in every window of a part as the one which they are where nobody
    pays or gets anything, or is out of play, with that one."""
    rows = where(table.rows, part=part)
    same_as = {name: metric.same_as for name, metric in REGISTERED.items() if metric.same_as in table.metrics}
    return {
        metric: other
        for metric, other in same_as.items()
        if metric in table.metrics and other and _are_equal(rows, metric, other)
    }


def _are_equal(rows: pa.Table, metric: str, other: str) -> bool:
    one, two = (where(rows, metric=name) for name in (metric, other))
    places = ["condition", "replica", "episode"]
    if not one.select(places).equals(two.select(places)):
        return False
    first, second = (of_metric["value"].to_numpy() for of_metric in (one, two))
    return bool(np.allclose(first, second, rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True))


def episodes_text(table: StudyTable, part: str = TRAINING, *, metric: str | None = None) -> str:
    """Return which episodes of a metric are compared, e.g. "the last 30 episodes of training"."""
    played = by_replica(table.windows(part), metric or table.metrics[0], ["condition"])
    low, high = pc.min_max(played["episodes"]).as_py().values()
    number = f"{high}" if low == high else f"{low} to {high}"
    if part == TRAINING:
        return f"the last {number} episodes of training"
    agents = "the trained agents" if table.agents_learn else "the agents"
    return f"{number} fresh episodes of {'random play' if part == RANDOM else agents}"


def pairing_text(table: StudyTable) -> str:
    """Return how differences are computed."""
    is_paired = table.design.is_paired
    return "paired by replica" if is_paired else "not paired: each condition has chance of its own"


def capitalised(sentence: str) -> str:
    """Return a sentence with a capital letter, all others as they are."""
    return f"{sentence[0].upper()}{sentence[1:]}"


def cells(
    table: StudyTable,
    metrics: Sequence[str] = (),
    kind: Kind = "levels",
    *,
    part: str = TRAINING,
) -> Cells:
    """Return a row for each condition, a column for each metric.

    Args:
        kind: "levels", means over replicas; or "differences" from the reference.
    """
    chosen = metrics_of(table, metrics, part=part)
    reference = table.design.reference
    is_levels = kind == "levels"
    family = (levels_of if is_levels else differences_of)(table, chosen, part=part)
    played = by_replica(table.windows(part), chosen[0], ["condition"])["condition"].to_pylist()
    rows: list[list[Cell]] = []
    for name in table.design.conditions:
        replicas = played.count(name)
        of_row = [family.get((name, metric)) for metric in chosen]
        if is_levels:
            rows.append([name, str(replicas), *(one or "-" for one in of_row)])
        elif name != reference:
            rows.append([name, str(replicas), *(change(one, replicas) for one in of_row)])
    what = "means over replicas"
    note = CUT if any(one.is_cut for one in family.values()) else ""
    if not is_levels:
        what = f"differences from {reference}, {pairing_text(table)}"
        note = family.note("of this table")
    episodes = capitalised(episodes_text(table, part, metric=chosen[0]))
    heading = f"{episodes}; {what}; {INTERVALS}."
    return Cells(heading, ["condition", "replicas", *map(title, chosen)], rows, note)


def change(difference: Estimate | None, replicas: int = 0) -> Cell:
    """Return a difference as a cell, in which fewer pairs than replicas are said."""
    if difference is None:
        return "-"
    pairs = difference.replicas
    return Change(difference, f"(of {pairs})" if pairs < replicas else "")


def compared_cells(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> list[Cells]:
    """Return the levels of metrics, see `metrics_of`, and the differences where there are several conditions;
    nothing of a table without a finished run."""
    chosen = metrics_of(table, metrics, part=part)
    if not chosen:
        return []
    levels = cells(table, metrics, part=part)
    if not metrics:
        note = "\n".join(filter(None, (levels.note, repeated_note(table, part))))
        levels = levels._replace(note=note)
    tables = [levels]
    if len(table.design.conditions) > 1:
        tables.append(cells(table, metrics, "differences", part=part))
    measures = () if metrics else measures_of(table, part)
    return [*tables, of_finished(cells(table, measures, part=part))] if measures else tables


def repeated_note(table: StudyTable, part: str) -> str:
    """Return which of the usual metrics a table lacks, since they are the same as another one; "" if none."""
    parts = [
        f"{title(metric).partition(',')[0]} is the same as {title(other).partition(',')[0]}"
        for metric, other in repeated_in(table, part).items()
        if metric in METRICS
    ]
    return f"Not shown: {'; '.join(parts)} here, in every replica." if parts else ""


def of_finished(table: Cells) -> Cells:
    """Return a table of `cells` without the conditions that were not run."""
    return table._replace(rows=[row for row in table.rows if row[1] != "0"])
