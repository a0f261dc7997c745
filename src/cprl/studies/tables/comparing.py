"""Conditions compared: the mean of a metric over replicas, and its difference from the reference."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isnan
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from cprl.arguments import LAST as LAST
from cprl.arguments import choice, integer, refusal
from cprl.measuring.metrics import title
from cprl.measuring.statistics import CONFIDENCE, Estimate, difference, estimate
from cprl.studies.tables.sources import NET, PARTS, TRAINING
from cprl.studies.tables.table import StudyTable

METRICS: Final = ("collective_return", NET, "equality", "sustainability", "survival_steps", "peacefulness")
"""Metrics that are compared, unless others are asked for, where a table has them."""

Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """A metric under one condition."""

    condition: str
    levels: Mapping[str, Any]
    values: Mapping[int, float]
    """The mean over its episodes by the number of the replica; NaN where it is defined in none."""
    episodes: int
    """Episodes of all replicas together."""
    undefined: int
    """Episodes in which the metric is undefined, which are no part of a mean."""
    estimate: Estimate | None
    """Over the replicas in which it is defined; None if there are none."""
    difference: Estimate | None
    """From the reference; None of the reference itself, and where there are no replicas to compare."""

    @property
    def replicas(self) -> int:
        """How many of its replicas are in the table."""
        return len(self.values)

    @property
    def defined(self) -> Values:
        """The values of the replicas in which it is defined, [R]."""
        found = np.array(list(self.values.values()), dtype=np.float64)
        return found[~np.isnan(found)]


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

    @cached_property
    def by_name(self) -> dict[str, Compared]:
        """The conditions by name."""
        return {own.condition: own for own in self.conditions}

    @property
    def episodes_text(self) -> str:
        """Which episodes are compared, e.g. "the last 30 episodes of training"."""
        low, high = self.last
        number = f"{high}" if low == high else f"{low} to {high}"
        if self.part == TRAINING:
            return f"the last {number} episodes of training"
        return (
            f"{number} fresh episodes of {'random play' if self.part == 'random' else 'the trained agents'}"
        )

    @property
    def differences_text(self) -> str:
        """How differences are computed."""
        how = "paired by replica" if self.is_paired else "not paired: each condition has chance of its own"
        return f"differences from {self.reference}, {how}"

    @property
    def interval_text(self) -> str:
        """How intervals are computed."""
        return f"{CONFIDENCE:.0%} intervals over replicas by Student's t"


def compare(table: StudyTable, metric: str, *, part: str = TRAINING, last: int = LAST) -> Comparison:
    """A metric under every condition, with intervals over replicas.

    Args:
        part: "training", "evaluation" or "random".
        last: of training: episodes at its end; those of whole windows.
    """
    if metric not in table.metrics:
        raise refusal("metric", metric, ", ".join(table.metrics) or "none, as the table has no finished run")
    choice("part", part, PARTS)
    integer("last", last, 1)
    if part == TRAINING and last < table.window:
        raise refusal("last", last, f"at least {table.window}, the episodes of a window of the table")
    asked = metric, part, last
    if asked not in table.comparisons:
        table.comparisons[asked] = _compared(table, *asked)
    own: Comparison = table.comparisons[asked]
    return own


def _compared(table: StudyTable, metric: str, part: str, last: int) -> Comparison:
    found = {name: _of_condition(table, name, metric, part, last) for name in table.design.conditions}
    lengths = [length for *_, length in found.values() if length]
    reference, is_paired = table.design.reference, table.design.is_paired
    compared = []
    for name, (values, undefined, length) in found.items():
        defined = [own for own in values.values() if not np.isnan(own)]
        other = None
        if name != reference:
            other = _difference(values, found[reference][0], is_paired)
        compared.append(
            Compared(
                condition=name,
                levels=table.design.conditions[name],
                values=values,
                episodes=length * len(values),
                undefined=undefined,
                estimate=estimate(defined) if defined else None,
                difference=other,
            )
        )
    return Comparison(
        metric=metric,
        part=part,
        last=(min(lengths, default=0), max(lengths, default=0)),
        is_paired=is_paired,
        reference=reference,
        conditions=tuple(compared),
    )


def metrics_of(table: StudyTable, metrics: Sequence[str] = ()) -> tuple[str, ...]:
    """The metrics asked for, by default those of `METRICS` that a table has."""
    for own in metrics:
        if own not in table.metrics:
            raise refusal("metric", own, ", ".join(table.metrics))
    return tuple(metrics) or tuple(own for own in METRICS if own in table.metrics)


def _of_condition(
    table: StudyTable, condition: str, metric: str, part: str, last: int
) -> tuple[dict[int, float], int, int]:
    """The value of each replica, undefined episodes of all, and the episodes of each."""
    rows = table.values(condition, metric, part)
    if rows is None:
        return {}, 0, 0
    lengths = rows["window_episodes"]
    ends = int((rows["episode"] + lengths).max())
    kept = rows["episode"] >= ends - last if part == TRAINING else np.ones(len(lengths), bool)
    counts = lengths[kept] - rows["undefined"][:, kept]
    sums = np.where(counts > 0, rows["value"][:, kept], 0.0) * counts
    with np.errstate(invalid="ignore"):
        means = sums.sum(1) / counts.sum(1)
    values = dict(zip(rows["replica"].tolist(), means.tolist(), strict=True))
    return values, int(rows["undefined"][:, kept].sum()), int(lengths[kept].sum())


def _difference(
    values: Mapping[int, float], reference: Mapping[int, float], is_paired: bool
) -> Estimate | None:
    if is_paired:
        both = [own for own in values if own in reference]
        pairs = np.array([(values[own], reference[own]) for own in both], dtype=np.float64).reshape(-1, 2)
        pairs = pairs[~np.isnan(pairs).any(1)]
        return difference(*pairs.T, paired=True) if len(pairs) else None
    samples = [[x for x in own.values() if not np.isnan(x)] for own in (values, reference)]
    if not all(samples):
        return None
    return difference(samples[0], samples[1], paired=False)


Kind = Literal["levels", "differences"]
NET_TITLE = "return of all agents together"


class Cells(NamedTuple):
    """A table of texts."""

    heading: str
    """What it shows, in a sentence."""
    head: list[str]
    rows: list[list[str]]


def cells(comparisons: Sequence[Comparison], kind: Kind = "levels") -> Cells:
    """A row for each condition, a column for each metric.

    Args:
        comparisons: of the same part and interval, one for each metric; at least one.
        kind: "levels", means over replicas; or "differences" from the reference, bold where the interval
            excludes 0.
    """
    choice("kind", kind, ("levels", "differences"))
    first = comparisons[0]
    rows = []
    for nth, own in enumerate(first.conditions):
        every = [comparison.conditions[nth] for comparison in comparisons]
        if kind == "differences" and own.condition == first.reference:
            continue
        texts = [level_text(one) if kind == "levels" else difference_text(one) for one in every]
        rows.append([own.condition, str(own.replicas), *texts])
    what = "means over replicas" if kind == "levels" else first.differences_text
    heading = f"{first.episodes_text[0].upper()}{first.episodes_text[1:]}; {what}; {first.interval_text}."
    return Cells(heading, ["condition", "replicas", *(metric_title(own.metric) for own in comparisons)], rows)


def level_text(own: Compared) -> str:
    """A mean over replicas with its interval, and where the metric is undefined."""
    if not own.replicas:
        return "-"
    if own.estimate is None:
        return f"undefined in all {own.episodes} episodes"
    text = estimate_text(own.estimate)
    return f"{text}, undefined in {own.undefined} of {own.episodes} episodes" if own.undefined else text


def difference_text(own: Compared) -> str:
    """A difference with its interval, bold where it excludes 0; fewer pairs than replicas are said."""
    found = own.difference
    if found is None:
        return "-"
    text = estimate_text(found, signed=True)
    if found.low > 0 or found.high < 0:
        text = f"**{text}**"
    return f"{text} (of {found.replicas})" if found.replicas < own.replicas else text


def estimate_text(found: Estimate, *, signed: bool = False) -> str:
    """An estimate with its interval; of a single replica the value alone."""
    numbers = [own for own in (found.value, found.low, found.high) if not isnan(own)]
    digits = digits_for(max(map(abs, numbers)))
    texts = [f"{own:{'+' if signed else ''},.{digits}f}" for own in (found.value, found.low, found.high)]
    return texts[0] if isnan(found.low) else f"{texts[0]} [{texts[1]}, {texts[2]}]"


def digits_for(largest: float) -> int:
    """How many digits after the point a number of this size is shown with."""
    return next((nth for nth, size in enumerate((100, 10, 0.5)) if largest >= size), 3)


def metric_title(metric: str) -> str:
    """What a metric is called, with its unit."""
    return NET_TITLE if metric == NET else title(metric)


def markdown(found: Cells) -> list[str]:
    """The lines of a table, numbers to the right, followed by an empty line."""
    rule = "|---|" + "---:|" * (len(found.head) - 1)
    rows = [[*map(cell, found.head)], *([cell(row[0]), *row[1:]] for row in found.rows)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return [lines[0], rule, *lines[1:], ""]


def cell(name: str) -> str:
    """Return a name of a user's as a cell of a table in Markdown, in which its signs mean nothing."""
    return re.sub(r"[\\`*<$|]", r"\\\g<0>", " ".join(name.splitlines()))


def rich_table(found: Cells) -> Table:
    """A table for the terminal; what is bold has a star too."""
    is_marked = any(own.startswith("**") for row in found.rows for own in row)
    caption = "* the interval excludes 0" if is_marked else None
    table = Table(title=found.heading, title_justify="left", caption=caption, caption_justify="right")
    for nth, name in enumerate(found.head):
        table.add_column(name, justify="right" if nth else "left", overflow="fold")
    for row in found.rows:
        table.add_row(*map(_for_terminal, row))
    return table


def _for_terminal(text: str) -> Text:
    bold, _, more = text.removeprefix("**").partition("**")
    is_marked = text.startswith("**")
    return Text(f"{bold} *{more}" if is_marked else text, style="bold" if is_marked else "")
