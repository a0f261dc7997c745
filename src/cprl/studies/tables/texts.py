"""Comparisons as tables in Markdown and in the terminal; the number of replicas is in each."""

import re
from collections.abc import Sequence
from math import isnan
from typing import Literal, NamedTuple

from rich.table import Table
from rich.text import Text

from cprl.arguments import choice
from cprl.measuring.names import title
from cprl.measuring.statistics import Estimate
from cprl.studies.tables.comparing import Compared, Comparison
from cprl.studies.tables.windows import NET

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
