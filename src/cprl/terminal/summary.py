"""The results of a run, printed in the terminal."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from math import isnan
from pathlib import Path
from statistics import fmean, stdev
from typing import Final

from rich.console import Console
from rich.table import Table

from cprl.measuring.episodes import Episode
from cprl.measuring.metrics import DIGITS, INSTITUTIONAL, is_own, left_out
from cprl.measuring.metrics import title as metric_title
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.system.shipped import cprl_here

_OF_AGENTS: Final = {"fines": "fined", "transfers": "given", "violations": "violations"}
_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
RETURN: Final = "return of all agents together"
UNDEFINED: Final = "undefined"


def summarise(
    run: Path,
    *,
    title: str,
    played: Mapping[str, list[Episode]],
    figure: Path | None = None,
    note: str | None = None,
    console: Console | None = None,
) -> None:
    """Prints a table that compares policies, the metrics that are left out, and the files of the run.

    Args:
        played: episodes in fresh worlds by the name of the policy; the first policy is the baseline.
    """
    console = console or safe_console()
    console.print(_table(title, played))
    of_institutions = institutions_table(played)
    if of_institutions is not None:
        console.print(of_institutions)
    for line in _notes(played):
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    if note:
        console.print(note, soft_wrap=True, highlight=False)
    missing = left_out(next(iter(played.values()))[0].reported)
    if missing:
        console.print(missing, soft_wrap=True)
    files = [name for name in _FILES if (run / name).exists()]
    console.print(f"Saved in {run}: {', '.join(files)}", soft_wrap=True)
    if figure:
        console.print(f"Training curve: {figure}", soft_wrap=True)
    if any(run.glob("run*.rrd")):
        console.print(f"Watch again: {printed([*cprl_here(), 'watch', str(run)])}", soft_wrap=True)


def _new_table(title: str, caption: str, heads: Sequence[str], *, folds_heads: bool) -> Table:
    """A table whose heads fold where the terminal is too narrow, or else the names of its rows."""
    table = Table(title=title, caption=caption)
    table.add_column(no_wrap=folds_heads)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=not folds_heads)
    return table


def _table(title: str, played: Mapping[str, list[Episode]]) -> Table:
    """A column for each policy, a row for each number; the first policy is the baseline."""
    names = [name if place or len(played) == 1 else f"{name} (baseline)" for place, name in enumerate(played)]
    table = _new_table(title, "means over episodes ± their standard errors", names, folds_heads=True)
    harvests = [_harvests(episodes) for episodes in played.values()]
    returns = [[float(episode.return_.sum()) for episode in episodes] for episodes in played.values()]
    if not all(harvests):
        _add_returns(table, RETURN, played, returns)
    else:
        _add_returns(table, "collective return, apples", played, harvests)
        pairs = zip(chain(*harvests), chain(*returns), strict=True)
        if any(abs(harvest - reward) > 1e-3 for harvest, reward in pairs):  # as under fines
            _add_returns(table, f"{RETURN}, rewards", played, returns)
    measured = [[episode.social for episode in episodes] for episodes in played.values()]
    forms = {metric: f".{digits}f" for metric, digits in DIGITS.items()}
    forms |= {metric: ".3g" for metric in measured[0][0] if is_own(metric)}
    for metric, form in forms.items():
        if metric in measured[0][0]:
            table.add_row(metric_title(metric), *(_mean(episodes, metric, form) for episodes in measured))
    table.add_row("episodes", *(str(len(episodes)) for episodes in played.values()))
    return table


def _harvests(episodes: Sequence[Episode]) -> list[float]:
    """Of all agents in each episode; [] in a game that reports none."""
    return [float(episode.harvest.sum()) for episode in episodes if episode.harvest is not None]


def _add_returns(
    table: Table, name: str, played: Mapping[str, list[Episode]], values: Sequence[Sequence[float]]
) -> None:
    """Adds the mean of a return with its standard error, and how many times the baseline's it is."""
    errors = [f" ± {stdev(own) / len(own) ** 0.5:.1f}" if len(own) > 1 else "" for own in values]
    means = [fmean(own) for own in values]
    table.add_row(name, *(f"{mean:.1f}{error}" for mean, error in zip(means, errors, strict=True)))
    if len(played) > 1:
        times = [f"{mean / means[0]:.1f}" if means[0] > 0 else UNDEFINED for mean in means]
        table.add_row(f"  times that of {_baseline(played)}", *times)


def _baseline(played: Mapping[str, list[Episode]]) -> str:
    name = next(iter(played))
    return "random play" if name == "random" else name


def _mean(measured: list[dict[str, float]], name: str, form: str) -> str:
    """The mean of a metric over the episodes in which it is defined, and the number of the others."""
    defined = [metrics[name] for metrics in measured if not isnan(metrics[name])]
    if not defined:
        return UNDEFINED
    others = len(measured) - len(defined)
    return f"{fmean(defined):{form}}" + f", {UNDEFINED} in {others} of {len(measured)}" * (others > 0)


def _notes(played: Mapping[str, list[Episode]]) -> Iterator[str]:
    for policy, episodes in played.items():
        if (harvests := _harvests(episodes)) and not any(harvests):
            yield f"{policy}: nobody harvested anything, so equality and sustainability are undefined"
    baseline = next(iter(played.values()))
    of_baseline = _harvests(baseline) or [float(episode.return_.sum()) for episode in baseline]
    if len(played) > 1 and fmean(of_baseline) <= 0:
        yield f"times that of {_baseline(played)}: undefined, because it is not above 0"


def institutions_table(played: Mapping[str, Sequence[Episode]]) -> Table | None:
    """A column for each policy; a row for each metric, then one for each agent: what it was fined and given,
    and its violations. None for a game without institutions.

    Shares of something that never happened have no row.
    """
    first = next(iter(played.values()))[0]
    if all(getattr(first, name) is None for name in INSTITUTIONAL):
        return None
    table = _new_table("institutions", "means over episodes", list(played), folds_heads=False)
    measured = [[episode.of_institutions for episode in episodes] for episodes in played.values()]
    for metric in first.of_institutions:
        values = [metrics[metric] for episodes in measured for metrics in episodes]
        if "equality" in metric or not all(map(isnan, values)):
            _, is_decision, number = metric.partition("in_force_")
            title = f"in force: decision {number}" if is_decision else metric_title(metric)
            table.add_row(title, *(_mean(episodes, metric, ".2f") for episodes in measured))
    fields = {name: word for name, word in _OF_AGENTS.items() if getattr(first, name) is not None}
    if fields:
        table.add_section()
        table.add_row(f"of each agent: {' / '.join(fields.values())}")
    for agent in range(len(first.return_)) if fields else ():
        numbers = [
            [fmean(getattr(episode, name)[agent] for episode in episodes) for name in fields]
            for episodes in played.values()
        ]
        table.add_row(f"  agent {agent}", *(" / ".join(f"{number:.1f}" for number in own) for own in numbers))
    return table
