"""The results of a run, printed in the terminal: first what they come to, then a table and files."""

from collections.abc import Iterator, Mapping, Sequence
from math import isclose
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cprl.measuring.registry import (
    COLLECTIVE_RETURN,
    IN_FORCE,
    INCOME,
    INCOME_EQUALITY,
    METRICS,
    OF_AGENTS,
    with_unit,
)
from cprl.measuring.statistics import HOLM, Estimate, Family, differences, estimates, notes_on
from cprl.measuring.table import numbers_in, where
from cprl.runs.episodes import LEFT_OUT
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.system.shipped import cprl_here
from cprl.terminal.tables import Cell, Cells, Change

_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
INTERVALS: Final = "mean over replicas [95 % interval by Student's t]"
ZEROS: Final = "Numbers of institutions that are 0 or undefined everywhere are left out."


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
    """Print what became of the run, a table that compares policies, and the files of the run.

    Args:
        played: Episodes in fresh worlds, labelled by "policy"; the first policy is what others are compared
            with.
        course: See `cprl.training.course`; by default what each policy gets.
    """
    console = console or safe_console()
    baseline = played["policy"][0].as_py()
    told = [name for name in every_number(played) if _is_summarised(name)]
    console.print(Text(course or _verdict(played, baseline), style="bold"))
    console.print(compared(played, f"{title}\n{INTERVALS}", numbers=told, reference=baseline))
    files = [name for name in _FILES if (run / name).exists()]
    lines = [note, f"Saved in {run}: {', '.join(files)}", f"Training curve: {figure}" if figure else None]
    if any(run.glob("run*.rrd")):
        lines.append(f"Watch again: {printed([*cprl_here(), 'watch', str(run)])}")
    for line in filter(None, lines):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def every_number(table: pa.Table) -> list[str]:
    """Return the names of all numbers in the order of pages: of whole episodes, then of each agent."""
    together = [name for name in numbers_in(table) if name != INCOME]
    has_harvest = COLLECTIVE_RETURN in together
    together.insert(int(has_harvest), INCOME)
    agents = range(int(np.max(table["agent"].to_numpy())) + 1)
    amounts = [name for name in ("return", *OF_AGENTS) if name in table.column_names]
    return [*together, *(f"agent_{agent}/{name}" for name in amounts for agent in agents)]


def _is_summarised(name: str) -> bool:
    metric = METRICS.get(name)
    if metric is None:
        return not name.endswith("/return")
    is_gain = name in (COLLECTIVE_RETURN, INCOME)
    return is_gain or metric.is_summarised or metric.is_of_institutions


def compared(
    table: pa.Table,
    heading: str,
    *,
    numbers: Sequence[str] = (),
    by: str = "policy",
    reference: str = "random",
    names: Mapping[str, str] | None = None,
) -> Cells:
    """Return a row for each number: a column for each policy, then one for what each has more than the
    reference, paired by replica.

    Numbers of institutions that are 0 or undefined everywhere have no row, and incomes none where nobody is
    paid anything but the harvest.

    Args:
        table: Of episodes, labelled by policy, see `cprl.measuring.table`.
        numbers: Their names; by default `every_number`.
        by: The label that the policies are called by.
        names: What columns are called instead of their label.
    """
    asked = list(numbers or every_number(table))
    levels = estimates(table, asked, by)
    more = differences(table, asked, by, {by: reference})
    columns = [label for (label,) in levels.labels]
    others = [label for label in columns if label != reference]
    words = {label: (names or {}).get(label, label) for label in columns}
    rewards = "apples" if "harvest" in table.column_names else ""
    told = [name for name in asked if _says_something(name, levels, columns)]
    rows: list[list[Cell]] = []
    for name in told:
        values = [levels[label, name] for label in columns]
        gaps = [_change(more.get((label, name))) for label in others]
        rows.append([with_unit(name, rewards=rewards), *values, *gaps])
    of_columns = [where(table, **{by: label}) for label in columns]
    blank = [""] * len(others)
    rows.append(["episodes", *(str(len(where(one, agent=0))) for one in of_columns), *blank])
    if rewards:
        idle = [_without_harvest(one) for one in of_columns]
        rows.append(["agents without a harvest, not in sustainability", *idle, *blank])
    shown = [levels[label, name] for label in columns for name in told]
    left_out = (table.schema.metadata or {}).get(LEFT_OUT, b"").decode()
    zeros = ZEROS * any(_is_of_institutions(name) for name in {*asked} - {*told})
    holm = f"{HOLM} for {more.name}." * any(one.differs for one in more.values())
    notes = [left_out, zeros, *_idle(levels, words), *notes_on(shown), holm]
    head = ["", *words.values(), *(f"{words[label]} - {words[reference]}, paired" for label in others)]
    return Cells(heading, head, rows, "\n".join(filter(None, notes)))


def _change(difference: Estimate | None) -> Cell:
    return "" if difference is None else Change(difference)


def _says_something(name: str, levels: Family, columns: Sequence[str]) -> bool:
    values = [levels[label, name] for label in columns]
    if name in (INCOME, INCOME_EQUALITY):
        same = METRICS[name].same_as
        pairs = ((one, levels.get((label, same))) for label, one in zip(columns, values, strict=True))
        return not all(other is not None and _are_close(one, other) for one, other in pairs)
    return not _is_of_institutions(name) or any(one.value > 0 or one.value < 0 for one in values)


def _is_of_institutions(name: str) -> bool:
    is_amount = name.rpartition("/")[2] in OF_AGENTS
    return (name.startswith("institutions/") or is_amount) and not name.startswith(IN_FORCE)


def _are_close(one: Estimate, other: Estimate) -> bool:
    return isclose(one.value, other.value, rel_tol=1e-6, abs_tol=1e-3) or one.replicas == other.replicas == 0


def _without_harvest(rows: pa.Table) -> str:
    harvests = rows["harvest"].to_numpy()
    return f"{np.count_nonzero(harvests == 0)} of {len(harvests)}"


def _idle(levels: Family, words: Mapping[str, str]) -> Iterator[str]:
    """Say why metrics are undefined."""
    for label, policy in words.items():
        harvest = levels.get((label, COLLECTIVE_RETURN))
        if harvest is not None and harvest.value == 0:
            yield f"{policy}: nobody harvested anything, so equality and sustainability are undefined"


def _verdict(played: pa.Table, baseline: str) -> str:
    """Return what each policy gets, and how much more than the baseline over replicas."""
    has_harvest = COLLECTIVE_RETURN in played.column_names
    name = COLLECTIVE_RETURN if has_harvest else INCOME
    levels = estimates(played, name, "policy")
    more = differences(played, name, "policy", {"policy": baseline})
    parts = []
    for (policy, _), level in levels.items():
        gap = more.get((policy, name))
        beside = "" if gap is None else f" ({gap:+} beside {_called(baseline)})"
        parts.append(f"{_called(policy)}: {level}{beside}")
    unit = "apples" if has_harvest else "of return"
    return f"{'; '.join([parts[-1], *parts[:-1]])} {unit} an episode, all agents together"


def _called(policy: str) -> str:
    return "random play" if policy == "random" else policy
