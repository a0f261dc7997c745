"""The results of a run, printed in the terminal: first what they come to, then a table and files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.text import Text

from cprl.measuring.registry import (
    APPLES,
    COLLECTIVE_RETURN,
    INCOME,
    INCOME_EQUALITY,
    METRICS,
    OF_AGENTS,
    with_unit,
)
from cprl.measuring.statistics import HOLM, Estimate, Family, differences, estimates, notes_on
from cprl.measuring.table import agents_named, numbers_in, where
from cprl.runs.episodes import LEFT_OUT
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.system.shipped import cprl_here
from cprl.terminal.tables import Cell, Cells, Change

_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
OVER_REPLICAS: Final = "mean over replicas [95 % interval by Student's t]"
"""What a number on a page is."""
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
    """Print what became of the run, a table that compares policies, and the files of the run.

    Args:
        played: Episodes in fresh worlds, labelled by "policy"; the first policy is what others are compared
            with.
        course: See `cprl.terminal.course`; by default what each policy gets.
    """
    console = console or safe_console()
    baseline = played["policy"][0].as_py()
    numbers = list(filter(_is_summarised, every_number(played)))
    console.print(Text(course or _verdict(played, baseline), style="bold"))
    console.print(compared(played, f"{title}\n{OVER_REPLICAS}", numbers=numbers, reference=baseline))
    files = [name for name in _FILES if (run / name).exists()]
    lines = [note, f"Saved in {run}: {', '.join(files)}", f"Training curve: {figure}" if figure else None]
    if any(run.glob("run*.rrd")):
        lines.append(f"Watch again: {printed([*cprl_here(), 'watch', str(run)])}")
    for line in filter(None, lines):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def every_number(table: pa.Table) -> list[str]:
    """Return the names of all numbers in the order of pages: of whole episodes, then of each agent."""
    numbers = [name for name in numbers_in(table) if name != INCOME]
    numbers.insert(numbers.count(COLLECTIVE_RETURN), INCOME)
    amounts = [name for name in ("return", *OF_AGENTS) if name in table.column_names]
    agents = range(len(table["agent"].unique()))
    return [*numbers, *(f"agent_{agent}/{name}" for name in amounts for agent in agents)]


def _is_summarised(name: str) -> bool:
    metric = METRICS.get(name)
    if metric is None:
        return not name.endswith("/return")
    is_gain = name in (COLLECTIVE_RETURN, INCOME)
    return is_gain or metric.is_summarised or metric.is_of_institutions


def rewards_of(table: pa.Table) -> str:
    """Return the unit of rewards: apples in a game that reports harvests; in another they have none."""
    return APPLES if "harvest" in table.column_names else ""


def says_nothing(name: str, family: Family) -> bool:
    """Return whether a number is of institutions, and undefined or 0 in a whole family."""
    metric = METRICS.get(name)
    is_amount = name.rpartition("/")[2] in OF_AGENTS
    is_of_institutions = is_amount if metric is None else metric.is_of_institutions
    estimates_of = (one for key, one in family.items() if key[-1] == name)
    return is_of_institutions and not any(one.replicas and one.value for one in estimates_of)


def compared(
    table: pa.Table,
    heading: str,
    *,
    numbers: Sequence[str] = (),
    reference: str = "random",
    names: Mapping[str, str] | None = None,
) -> Cells:
    """Return a row for each number: a column for each policy, then one for what each has more than the
    reference, paired by replica.

    Numbers that `says_nothing` have no row, and incomes none where they are the harvests.

    Args:
        table: Of episodes, labelled by "policy", see `cprl.measuring.table`.
        numbers: Their names; by default `every_number`.
        names: What policies are called instead of their label.
    """
    numbers = numbers or every_number(table)
    levels = estimates(table, numbers, "policy")
    changes = differences(table, numbers, "policy", {"policy": reference})
    policies = [policy for (policy,) in levels.labels]
    others = [policy for policy in policies if policy != reference]
    called = {policy: (names or {}).get(policy, policy) for policy in policies}
    silent = {name for name in numbers if says_nothing(name, levels)}
    repeated = {name for name in (INCOME, INCOME_EQUALITY) if _is_repeated(name, levels)}
    rows: list[list[Cell]] = []
    for name in levels.numbers:
        if name not in silent | repeated:
            values = [levels[policy, name] for policy in policies]
            gaps = [_change(changes.get((policy, name))) for policy in others]
            words = with_unit(agents_named(table, name), rewards=rewards_of(table))
            rows.append([words, *values, *gaps])
    of_policies = [where(table, policy=policy) for policy in policies]
    blank = [""] * len(others)
    rows.append(["episodes", *(str(len(where(one, agent=0))) for one in of_policies), *blank])
    if "harvest" in table.column_names:
        harvests = [one["harvest"].to_pylist() for one in of_policies]
        idle = [f"{each.count(0)} of {len(each)}" for each in harvests]
        if any(0 in each for each in harvests):
            rows.append(["agents without a harvest, not in sustainability", *idle, *blank])
    notes = [
        (table.schema.metadata or {}).get(LEFT_OUT, b"").decode(),
        ZEROS if silent else "",
        *(IDLE.format(called[policy]) for policy in policies if _is_idle(levels, policy)),
        *notes_on(levels.values()),
        f"{HOLM} for {changes.name}." if any(one.differs for one in changes.values()) else "",
    ]
    head = ["", *called.values(), *(f"{called[policy]} - {called[reference]}, paired" for policy in others)]
    return Cells(heading, head, rows, "\n".join(filter(None, notes)))


def _is_repeated(name: str, levels: Family) -> bool:
    """Return whether a number is that which it is where nobody pays anything."""
    same = METRICS[name].same_as
    if not {name, same} <= set(levels.numbers):
        return False
    values, others = ([levels[*labels, one].value for labels in levels.labels] for one in (name, same))
    return np.allclose(values, others, rtol=1e-6, atol=1e-6, equal_nan=True)


def _is_idle(levels: Family, policy: str) -> bool:
    harvest = levels.get((policy, COLLECTIVE_RETURN))
    return harvest is not None and harvest.value == 0


def _change(difference: Estimate | None) -> Cell:
    return "" if difference is None else Change(difference)


def _verdict(played: pa.Table, baseline: str) -> str:
    """Return what each policy gets, and how much more than the baseline over replicas."""
    has_harvest = COLLECTIVE_RETURN in played.column_names
    name = COLLECTIVE_RETURN if has_harvest else INCOME
    levels = estimates(played, name, "policy")
    gaps = differences(played, name, "policy", {"policy": baseline})
    parts = []
    for (policy, _), level in levels.items():
        gap = gaps.get((policy, name))
        beside = "" if gap is None else f" ({gap:+} beside {_called(baseline)})"
        parts.append(f"{_called(policy)}: {level}{beside}")
    unit = APPLES if has_harvest else "of return"
    return f"{'; '.join([parts[-1], *parts[:-1]])} {unit} an episode, all agents together"


def _called(policy: str) -> str:
    return "random play" if policy == "random" else policy
