"""Conditions compared: the mean of a metric over replicas, and its difference from the reference.

Intervals are by Student's t over replicas, each of a single comparison. Where a table makes several, those
that are marked differ by Holm's method: with 95 % none of the marked ones is by chance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, isclose, isnan
from typing import Final, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from cprl.measuring.registry import INCOME, INCOME_EQUALITY, is_own, title
from cprl.measuring.statistics import CONFIDENCE, CUT, Estimate, difference, estimate, holm
from cprl.studies.tables.table import PARTS, RANDOM, TRAINING, StudyTable
from cprl.system.defaults import LAST as LAST
from cprl.terminal.tables import Cells as Cells
from cprl.terminal.tables import markdown as markdown
from cprl.values import Positive, checked, refusal

METRICS: Final = ("collective_return", INCOME, "equality", "sustainability", "survival_steps", "peacefulness")
"""Metrics that are compared, unless others are asked for, where a table has them."""
SAME_AS: Final = {
    INCOME: "collective_return",
    "peacefulness": "survival_steps",
    INCOME_EQUALITY: "equality",
}
"""Metrics that are another one by construction where nobody pays or gets anything, or is out of play."""
MEASURES: Final = ("institutions/fines", "institutions/violations")
"""What institutions took and found, which stands beside the metrics and is not tested."""
INTERVALS: Final = f"{CONFIDENCE:.0%} intervals over replicas by Student's t"

Kind = Literal["levels", "differences"]
Values = NDArray[np.float64]
Place = tuple[str, str]
"""Of a difference: the metric, and the condition or effect."""
_ROUNDING: Final = 1e-6
"""What payments of float32 round off, of a value."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A metric under one condition."""

    condition: str
    metric: str
    values: Mapping[int, float]
    """The mean over its episodes by the number of the replica; NaN where it is defined in none."""
    episodes: int
    """Episodes of all replicas together."""
    undefined: int
    """Episodes in which the metric is undefined, which are no part of a mean."""
    difference: Estimate | None
    """From the reference; None of the reference itself, and where there are no replicas to compare."""
    clock: float = inf
    """The turns of an episode at most."""

    @property
    def replicas(self) -> int:
        """How many of its replicas are in the table."""
        return len(self.values)

    @property
    def defined(self) -> Values:
        """The values of the replicas in which it is defined, [R]."""
        values = np.array(list(self.values.values()), dtype=np.float64)
        return values[~np.isnan(values)]

    @cached_property
    def estimate(self) -> Estimate | None:
        """Over the replicas in which it is defined; None if there are none."""
        return estimate(self.defined).of(self.metric, self.clock) if len(self.defined) else None


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """A metric under every condition of a table, in order."""

    metric: str
    part: str
    last: tuple[int, int]
    """The smallest and the largest number of episodes of a replica that the values are means of: those at the
    end of a training, or all of another part."""
    is_paired: bool
    reference: str
    conditions: tuple[Compared, ...]
    agents_learn: bool = True

    @cached_property
    def by_name(self) -> dict[str, Compared]:
        return {compared.condition: compared for compared in self.conditions}

    @property
    def episodes_text(self) -> str:
        """Which episodes are compared, e.g. "the last 30 episodes of training"."""
        low, high = self.last
        number = f"{high}" if low == high else f"{low} to {high}"
        if self.part == TRAINING:
            return f"the last {number} episodes of training"
        agents = "the trained agents" if self.agents_learn else "the agents"
        return f"{number} fresh episodes of {'random play' if self.part == RANDOM else agents}"

    @property
    def pairing_text(self) -> str:
        """How differences are computed."""
        return "paired by replica" if self.is_paired else "not paired: each condition has chance of its own"


def compare(table: StudyTable, metric: str, *, part: str = TRAINING, last: int = LAST) -> Comparison:
    """Return a metric under every condition, with intervals over replicas.

    Args:
        part: "training", "evaluation" or "random".
        last: of training: episodes at its end; those of whole windows.
    """
    metrics_of(table, [metric])
    checked("part", part, Literal[tuple(PARTS)])
    checked("last", last, Positive)
    if part == TRAINING and last < table.window:
        raise refusal("last", last, f"at least {table.window}, the episodes of a window of the table")
    key = metric, part, last
    if key not in table.comparisons:
        table.comparisons[key] = _compared(table, metric, part, last)
    comparison: Comparison = table.comparisons[key]
    return comparison


def metrics_of(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> tuple[str, ...]:
    """Return the metrics asked for, by default those of `METRICS` and of the user's own that a table has,
    without those of `repeated_in`."""
    for metric in metrics:
        if metric not in table.metrics:
            allowed = ", ".join(table.metrics) or "none, as the table has no finished run"
            raise refusal("metric", metric, allowed)
    repeated = repeated_in(table, part)
    usual = [metric for metric in METRICS if metric in table.metrics and metric not in repeated]
    return tuple(metrics) or (*usual, *filter(is_own, table.metrics))


def measures_of(table: StudyTable, part: str = TRAINING) -> tuple[str, ...]:
    """Return those of `MEASURES` that a table has and that are not 0 in all windows of a part."""
    is_there = pc.and_(pc.equal(table.rows["part"], part), pc.greater(table.rows["value"], 0))
    found = set(table.rows.filter(is_there)["metric"].unique().to_pylist())
    return tuple(metric for metric in MEASURES if metric in found)


def repeated_in(table: StudyTable, part: str) -> tuple[str, ...]:
    """Return the metrics that are the same as that of `SAME_AS` in every window of a part."""
    conditions = [name for name in table.design.conditions if table.replicas[name]]
    return tuple(
        metric
        for metric, other in SAME_AS.items()
        if {metric, other} <= set(table.metrics)
        and all(_are_equal(table, name, metric, other, part) for name in conditions)
    )


def _are_equal(table: StudyTable, condition: str, metric: str, other: str, part: str) -> bool:
    one, two = (table.values(condition, name, part) for name in (metric, other))
    if one is None or two is None:
        return one is two
    return one["value"].shape == two["value"].shape and np.allclose(
        one["value"], two["value"], rtol=_ROUNDING, atol=_ROUNDING, equal_nan=True
    )


def _compared(table: StudyTable, metric: str, part: str, last: int) -> Comparison:
    reference, is_paired = table.design.reference, table.design.is_paired
    means = {name: _means(table, name, metric, part, last) for name in table.design.conditions}
    lengths = [length for *_, of_each in means.values() for length in of_each]
    return Comparison(
        metric=metric,
        part=part,
        last=(min(lengths, default=0), max(lengths, default=0)),
        is_paired=is_paired,
        reference=reference,
        conditions=tuple(
            Compared(
                condition=name,
                metric=metric,
                values=values,
                episodes=sum(lengths),
                undefined=undefined,
                difference=_difference(values, means[reference][0], is_paired) if name != reference else None,
                clock=table.design.clocks.get(name, inf),
            )
            for name, (values, undefined, lengths) in means.items()
        ),
        agents_learn=table.agents_learn,
    )


def _means(
    table: StudyTable, condition: str, metric: str, part: str, last: int
) -> tuple[dict[int, float], int, list[int]]:
    """The value of each replica, undefined episodes of all, and the episodes of each."""
    grid = table.values(condition, metric, part)
    if grid is None:
        return {}, 0, []
    ends = (grid["episode"] + grid["window_episodes"]).max(1, keepdims=True)
    longest = int(grid["window_episodes"].max())
    if longest > table.window:  # as many episodes of each of many worlds
        last = -(-last // longest) * longest
    is_last = (grid["episode"] >= ends - last) | (part != TRAINING)
    some = is_last.any(0)
    lengths, undefined, values = (
        np.where(is_last, grid[name], 0)[:, some] for name in ("window_episodes", "undefined", "value")
    )
    counts = lengths - undefined
    sums = np.where(counts > 0, values, 0.0) * counts
    with np.errstate(invalid="ignore"):
        means = sums.sum(1) / counts.sum(1)
    by_replica = dict(zip(grid["replica"].tolist(), means.tolist(), strict=True))
    return by_replica, int(undefined.sum()), lengths.sum(1).tolist()


def _difference(
    values: Mapping[int, float], reference: Mapping[int, float], is_paired: bool
) -> Estimate | None:
    if is_paired:
        both = [replica for replica in values if replica in reference]
        pairs = np.array([(values[replica], reference[replica]) for replica in both]).reshape(-1, 2)
        pairs = pairs[~np.isnan(pairs).any(1)]
        return difference(*pairs.T, paired=True) if len(pairs) else None
    samples = [[value for value in sample.values() if not isnan(value)] for sample in (values, reference)]
    return difference(samples[0], samples[1], paired=False) if all(samples) else None


class Family(NamedTuple):
    """Differences that are tested together by Holm's method."""

    marked: frozenset[Place]
    """Those that are not 0."""
    tests: int
    """How many are tested; one that stands under two metrics of `SAME_AS` is a single test."""
    is_repeated: bool
    """Whether some stand under two metrics."""

    def note(self, of: str) -> str:
        """Return what bold means; `of` says which differences they are, e.g. "of this table"."""
        number = f"the {self.tests} differences" if self.tests != 1 else "the one difference"
        once = ", of which those that two columns have in common count once" if self.is_repeated else ""
        return (
            f"Bold: not 0 by Holm's method for {number} {of}{once} (two-sided t-tests, "
            f"{1 - CONFIDENCE:.0%} for all together); intervals are of single comparisons."
        )


def family_of(differences: Mapping[Place, Estimate | None]) -> Family:
    """Return which differences are not 0, of all these together."""
    tests: dict[Place, list[Place]] = {}
    for (metric, name), one in differences.items():
        if one is None or isnan(one.p_value):
            continue
        same = SAME_AS.get(metric, ""), name
        other = differences.get(same)
        is_same = same in tests and other is not None and _is_same(one, other)
        tests.setdefault(same if is_same else (metric, name), []).append((metric, name))
    p_values = [differences[place].p_value for place in tests]  # type: ignore[union-attr]
    marked: set[Place] = set()
    for places, differs in zip(tests.values(), holm(p_values), strict=True):
        marked |= set(places) if differs else set()
    is_repeated = any(len(places) > 1 for places in tests.values())
    return Family(frozenset(marked), len(tests), is_repeated)


def _is_same(one: Estimate, other: Estimate) -> bool:
    pairs = zip((one.value, one.low, one.high), (other.value, other.low, other.high), strict=True)
    return all(isclose(a, b, rel_tol=_ROUNDING, abs_tol=_ROUNDING) for a, b in pairs)


def differences_in(comparisons: Sequence[Comparison]) -> dict[Place, Estimate | None]:
    """Return the differences from the reference by metric and condition."""
    return {
        (comparison.metric, compared.condition): compared.difference
        for comparison in comparisons
        for compared in comparison.conditions
        if compared.condition != comparison.reference
    }


def cells(comparisons: Sequence[Comparison], kind: Kind = "levels") -> Cells:
    """Return a row for each condition, a column for each metric.

    Args:
        comparisons: of the same part, one for each metric; at least one.
        kind: "levels", means over replicas; or "differences" from the reference.
    """
    first = comparisons[0]
    family = family_of(differences_in(comparisons) if kind == "differences" else {})
    rows = []
    for compared in first.conditions:
        name, texts = compared.condition, []
        if kind == "differences" and name == first.reference:
            continue
        for comparison in comparisons:
            of_metric = comparison.by_name[name]
            if kind == "levels":
                texts.append(level_text(of_metric))
            else:
                is_marked = (comparison.metric, name) in family.marked
                texts.append(difference_text(of_metric, is_marked=is_marked))
        rows.append([name, str(compared.replicas), *texts])
    head = ["condition", "replicas", *(metric_title(comparison.metric) for comparison in comparisons)]
    what, note = "means over replicas", ""
    if kind == "differences":
        what = f"differences from {first.reference}, {first.pairing_text}"
        note = family.note("of this table")
    estimates = [one.estimate for comparison in comparisons for one in comparison.conditions]
    if kind == "levels" and any(one is not None and one.is_cut for one in estimates):
        note = CUT
    heading = f"{first.episodes_text[0].upper()}{first.episodes_text[1:]}; {what}; {INTERVALS}."
    return Cells(heading, head, rows, note)


def compared_cells(
    table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING, last: int = LAST
) -> list[Cells]:
    """Return the levels of metrics, see `metrics_of`, and the differences where there are several conditions;
    nothing of a table without a finished run."""
    chosen = metrics_of(table, metrics, part=part)
    comparisons = [compare(table, metric, part=part, last=last) for metric in chosen]
    if not comparisons:
        return []
    levels = cells(comparisons)
    tables = [levels, cells(comparisons, "differences")]
    if len(table.design.conditions) == 1:
        tables = [levels]
    if metrics:
        return tables
    tables[0] = levels._replace(note="\n".join(filter(None, (levels.note, repeated_note(table, part)))))
    measures = [compare(table, metric, part=part, last=last) for metric in measures_of(table, part)]
    return [*tables, of_finished(cells(measures))] if measures else tables


def repeated_note(table: StudyTable, part: str) -> str:
    """Return which of the usual metrics a table lacks, since they are the same as another one; "" if none."""
    parts = [
        f"{metric_title(metric).partition(',')[0]} is the same as {title(SAME_AS[metric]).partition(',')[0]}"
        for metric in repeated_in(table, part)
        if metric in METRICS
    ]
    return f"Not shown: {'; '.join(parts)} here, in every replica." if parts else ""


def compared_rows(comparisons: Sequence[Comparison]) -> pa.Table:
    """Return means and differences as a tidy table: a row for each metric and condition, numbers without an
    interval as null; `differs` is what is bold in `cells` of all these together."""
    family = family_of(differences_in(comparisons))
    rows = []
    for comparison in comparisons:
        for compared in comparison.conditions:
            one = compared.estimate
            difference = compared.difference
            rows.append(
                {
                    "metric": comparison.metric,
                    "part": comparison.part,
                    "condition": compared.condition,
                    "replicas": compared.replicas,
                    "mean": one and one.value,
                    "low": one and one.low,
                    "high": one and one.high,
                    "reference": comparison.reference,
                    "difference": difference and difference.value,
                    "difference_low": difference and difference.low,
                    "difference_high": difference and difference.high,
                    "p_value": difference and difference.p_value,
                    "differs": (comparison.metric, compared.condition) in family.marked,
                }
            )
    return pa.Table.from_pylist(rows)


def of_finished(table: Cells) -> Cells:
    """Return a table of `cells` without the conditions that were not run."""
    return table._replace(rows=[row for row in table.rows if row[1] != "0"])


def level_text(compared: Compared) -> str:
    """Return a mean over replicas with its interval, and where the metric is undefined."""
    if not compared.replicas:
        return "-"
    if compared.estimate is None:
        return f"undefined in all {compared.episodes} episodes"
    text = str(compared.estimate)
    if compared.undefined:
        text += f", undefined in {compared.undefined} of {compared.episodes} episodes"
    return text


def difference_text(compared: Compared, *, is_marked: bool) -> str:
    """Return a difference with its interval, bold where it is marked; fewer pairs than replicas are said."""
    if compared.difference is None:
        return "-"
    text = f"{compared.difference:+}"
    text = f"**{text}**" if is_marked else text
    pairs = compared.difference.replicas
    return f"{text} (of {pairs})" if pairs < compared.replicas else text


def metric_title(metric: str) -> str:
    """Return what a metric is called, with its unit."""
    return title(metric)
