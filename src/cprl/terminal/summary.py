"""Prints the results of a run: a verdict, a table that compares policies, and the files of the run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cprl.measuring.registry import (
    AGENT_TOTALS,
    APPLES,
    COLLECTIVE_RETURN,
    INCOME,
    INCOME_EQUALITY,
    METRICS,
    with_unit,
)
from cprl.measuring.social import are_equal
from cprl.measuring.statistics import HOLM_NOTE, Family, differences, estimates, notes_on
from cprl.measuring.table import all_metrics, display_name, gain_metric, where
from cprl.runs.episodes import LEFT_OUT
from cprl.system.output import console as safe_console, quote_command
from cprl.system.shipped import cprl_command
from cprl.terminal.text_tables import Change, TableCell, TextTable

_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
"""The files and folders of a run that are listed."""
OVER_REPLICAS: Final = "mean over replicas [95 % interval by Student's t]"
"""The words that explain the numbers of a table."""
ZEROS: Final = "Numbers of institutions that are 0 or undefined everywhere are left out."
IDLE: Final = "{}: nobody harvested anything, so equality and sustainability are undefined"


def summarise(
    run: Path,
    *,
    title: str,
    played: pa.Table,
    course: str = "",
    figure: Path | None = None,
    note: str | None = None,
    console: Console | None = None,
) -> None:
    """Print a verdict on the run, a table that compares policies, and the files of the run.

    Args:
        run: the run's directory.
        title: the heading of the table.
        played: episodes in fresh worlds with the label "policy". All policies are compared with the first.
        course: the verdict, see `cprl.terminal.course.course_of`; by default it says how much each policy
            gets.
        figure: the training curve, if it was drawn.
        note: a line below the table.
        console: where to print; by default the terminal.
    """
    console = console or safe_console()
    baseline = played["policy"][0].as_py()
    metrics = list(filter(_is_summarised, ordered_metrics(played)))
    console.print(Text(course or _verdict(played, baseline), style="bold"))
    console.print(comparison_table(played, f"{title}\n{OVER_REPLICAS}", metrics=metrics, reference=baseline))
    files = [name for name in _FILES if (run / name).exists()]
    lines = [note, f"Saved in {run}: {', '.join(files)}", f"Training curve: {figure}" if figure else None]
    if any(run.glob("run*.rrd")):
        lines.append(f"Watch again: {quote_command([*cprl_command(), 'watch', str(run)])}")
    for line in filter(None, lines):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def ordered_metrics(table: pa.Table) -> list[str]:
    """Return the names of all metrics in the order of their rows: of whole episodes, then of each agent.

    A metric of an agent has a name such as "agent_0/return".
    """
    amounts = [amount for amount in ("return", *AGENT_TOTALS) if amount in table.column_names]
    agents = range(len(table["agent"].unique()))
    return [*all_metrics(table), *(f"agent_{agent}/{amount}" for amount in amounts for agent in agents)]


def _is_summarised(name: str) -> bool:
    """Return whether a metric is in the table that follows a run."""
    metric = METRICS.get(name)
    if metric is None:
        return not name.endswith("/return")
    return metric.is_summarised or metric.is_of_institutions


def rewards_of(table: pa.Table) -> str:
    """Return the unit of rewards: "apples" if the game reports harvests, else "" for none."""
    return APPLES if "harvest" in table.column_names else ""


def is_empty_row(name: str, family: Family) -> bool:
    """Return whether a metric is about institutions, and is undefined or 0 in all estimates of a family."""
    metric = METRICS.get(name)
    is_amount = name.rpartition("/")[2] in AGENT_TOTALS
    is_of_institutions = is_amount if metric is None else metric.is_of_institutions
    has_value = any(estimate.replicas and estimate.value for estimate in family.column(name).values())
    return is_of_institutions and not has_value


def comparison_table(
    table: pa.Table,
    heading: str,
    *,
    metrics: Sequence[str] = (),
    reference: str = "random",
    names: Mapping[str, str] | None = None,
) -> TextTable:
    """Return a table that compares policies, with a row for each metric.

    Each policy has a column with its means, and each policy but the reference a column with its differences
    to the reference, paired by replica. Metrics of institutions without any value have no row, and neither do
    incomes that equal the harvests.

    Args:
        table: episodes with the label "policy", see `cprl.measuring.table`.
        metrics: the names of the metrics; by default `ordered_metrics`.
        reference: the policy with which all others are compared.
        names: the names of policies in the head of the table; by default their labels.
    """
    metrics = metrics or ordered_metrics(table)
    levels = estimates(table, metrics, "policy")
    changes = differences(table, metrics, "policy", {"policy": reference})
    policies = [policy for (policy,) in levels.labels]
    compared = [policy for policy in policies if policy != reference]
    policy_names = {policy: (names or {}).get(policy, policy) for policy in policies}
    empty = {metric for metric in metrics if is_empty_row(metric, levels)}
    repeated = {metric for metric in (INCOME, INCOME_EQUALITY) if _is_repeated(metric, levels)}
    rows: list[list[TableCell]] = []
    for metric in levels.numbers:
        if metric not in empty | repeated:
            title = with_unit(display_name(table, metric), rewards=rewards_of(table))
            row: list[TableCell] = [title, *(levels[policy, metric] for policy in policies)]
            for policy in compared:
                change = changes.get((policy, metric))
                row.append("" if change is None else Change(change))
            rows.append(row)
    for title, counts in _counts(table, policies).items():
        rows.append([title, *counts, *[""] * len(compared)])
    is_any_marked = any(change.differs for change in changes.values())
    notes = [
        (table.schema.metadata or {}).get(LEFT_OUT, b"").decode(),
        ZEROS if empty else "",
        *(IDLE.format(policy_names[policy]) for policy in policies if _is_idle(levels, policy)),
        *notes_on(levels.values()),
        f"{HOLM_NOTE} for these {changes.tests} differences." if is_any_marked else "",
    ]
    reference_name = policy_names[reference]
    head = ["", *policy_names.values()]
    head += [f"{policy_names[policy]} - {reference_name}, paired" for policy in compared]
    return TextTable(heading, head, rows, "\n".join(filter(None, notes)))


def _counts(table: pa.Table, policies: Sequence[str]) -> dict[str, list[str]]:
    """Return rows of counts by title: the episodes of each policy, and its agents without a harvest."""
    tables = [where(table, policy=policy) for policy in policies]
    counts = {"episodes": [str(len(where(rows, agent=0))) for rows in tables]}
    if "harvest" in table.column_names:
        harvests = [rows["harvest"].to_pylist() for rows in tables]
        if any(0 in harvest for harvest in harvests):
            idle = [f"{harvest.count(0)} of {len(harvest)}" for harvest in harvests]
            counts["agents without a harvest, not in sustainability"] = idle
    return counts


def _is_repeated(name: str, levels: Family) -> bool:
    """Return whether a metric repeats another one: incomes equal harvests if institutions pay nothing."""
    original = METRICS[name].same_as
    if not {name, original} <= set(levels.numbers):
        return False
    values = [levels[*labels, name].value for labels in levels.labels]
    original_values = [levels[*labels, original].value for labels in levels.labels]
    return are_equal(values, original_values)


def _is_idle(levels: Family, policy: str) -> bool:
    harvest = levels.get((policy, COLLECTIVE_RETURN))
    return harvest is not None and harvest.value == 0


def _verdict(played: pa.Table, baseline: str) -> str:
    """Return in words how much each policy gets, and how much more than the baseline."""
    name = gain_metric(played)
    levels = estimates(played, name, "policy")
    gaps = differences(played, name, "policy", {"policy": baseline})
    parts = []
    for (policy, _), level in levels.items():
        gap = gaps.get((policy, name))
        comparison = "" if gap is None else f" ({gap:+} beside {_policy_name(baseline)})"
        parts.append(f"{_policy_name(policy)}: {level}{comparison}")
    unit = "of return" if name == INCOME else APPLES
    return f"{'; '.join([parts[-1], *parts[:-1]])} {unit} an episode, all agents together"


def _policy_name(policy: str) -> str:
    return "random play" if policy == "random" else policy
