"""The results of a run, printed in the terminal."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import isnan
from pathlib import Path
from statistics import fmean, stdev
from typing import Final

from rich.console import Console
from rich.table import Table

from cprl.measuring.episodes import Episode
from cprl.measuring.metrics import INSTITUTIONAL, left_out
from cprl.measuring.metrics import title as metric_title
from cprl.measuring.statistics import institution_metrics, social_metrics
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.viewer.page import to_watch

_OF_AGENTS: Final = {"fines": "fined", "transfers": "given", "violations": "violations"}


def institutions_table(played: Mapping[str, Sequence[Episode]]) -> Table | None:
    """A column for each policy; a row for each metric, then one for each agent: what it was fined and given,
    and its violations. None for a game without institutions.

    Shares of something that never happened have no row.
    """
    first = next(iter(played.values()))[0]
    if all(getattr(first, name) is None for name in INSTITUTIONAL):
        return None
    table = Table(title="institutions", caption="means over episodes")
    table.add_column()
    for name in played:
        table.add_column(name, justify="right", no_wrap=True)
    measured = {
        policy: [institution_metrics(episode) for episode in episodes] for policy, episodes in played.items()
    }
    for metric in institution_metrics(first):
        values = [metrics[metric] for episodes in measured.values() for metrics in episodes]
        if "equality" in metric or not all(map(isnan, values)):
            table.add_row(_title(metric), *(_mean(episodes, metric, 2) for episodes in measured.values()))
    fields = {name: word for name, word in _OF_AGENTS.items() if getattr(first, name) is not None}
    if fields:
        table.add_section()
        table.add_row(f"of each agent: {' / '.join(fields.values())}")
    for agent in range(len(first.return_)) if fields else ():
        cells = [
            " / ".join(
                f"{fmean(getattr(episode, name)[agent] for episode in episodes):.1f}" for name in fields
            )
            for episodes in played.values()
        ]
        table.add_row(f"  agent {agent}", *cells)
    return table


def _title(metric: str) -> str:
    prefix = "in_force_"
    if metric.startswith(prefix):
        return f"in force: decision {metric.removeprefix(prefix)}"
    return metric_title(f"institutions/{metric}")


KEPT = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
METRICS: Final = {
    "yield_share": 2,
    "survival_steps": 1,
    "sustainability": 1,
    "equality": 2,
    "peacefulness": 1,
    "stock_left": 1,
}
"""The metrics that are printed if the game reports them, with their digits."""
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
    files = [name for name in KEPT if (run / name).exists()]
    console.print(f"Saved in {run}: {', '.join(files)}", soft_wrap=True)
    if figure:
        console.print(f"Training curve: {figure}", soft_wrap=True)
    if "run.rrd" in files:
        watch = printed(to_watch(run / "run.rrd"))
        console.print(f"Watch again: {watch}", soft_wrap=True)


def _table(title: str, played: Mapping[str, list[Episode]]) -> Table:
    """A column for each policy, a row for each number; the first policy is the baseline."""
    table = Table(title=title, caption="means over episodes ± their standard errors")
    table.add_column(no_wrap=True)
    for place, name in enumerate(played):
        table.add_column(name if place or len(played) == 1 else f"{name} (baseline)", justify="right")
    has_harvest = all(episode.harvest is not None for episodes in played.values() for episode in episodes)
    name = "collective return, apples" if has_harvest else RETURN
    _add_returns(table, name, played, _harvests if has_harvest else _returns)
    if has_harvest and any(_differ(episodes) for episodes in played.values()):
        _add_returns(table, f"{RETURN}, rewards", played, _returns)
    measured = {
        policy: [social_metrics(episode) for episode in episodes] for policy, episodes in played.items()
    }
    known = next(iter(measured.values()))[0]
    for metric, digits in METRICS.items():
        if metric in known:
            table.add_row(
                metric_title(metric), *(_mean(episodes, metric, digits) for episodes in measured.values())
            )
    table.add_row("episodes", *(str(len(episodes)) for episodes in played.values()))
    return table


def _returns(episode: Episode) -> float:
    return float(episode.return_.sum())


def _harvests(episode: Episode) -> float:
    assert episode.harvest is not None
    return float(episode.harvest.sum())


def _differ(episodes: list[Episode]) -> bool:
    """Whether rewards are something else than apples, as under fines."""
    return any(abs(_returns(episode) - _harvests(episode)) > 1e-3 for episode in episodes)


def _add_returns(
    table: Table, name: str, played: Mapping[str, list[Episode]], of: Callable[[Episode], float]
) -> None:
    """Adds the mean of a return with its standard error, and how many times the baseline's it is."""
    values = {policy: [of(episode) for episode in episodes] for policy, episodes in played.items()}
    table.add_row(name, *(_with_error(value) for value in values.values()))
    if len(played) == 1:
        return
    baseline, means = next(iter(played)), [fmean(value) for value in values.values()]
    times = [f"{mean / means[0]:.1f}" if means[0] > 0 else UNDEFINED for mean in means]
    table.add_row(f"  times that of {_who(baseline)}", *times)


def _who(policy: str) -> str:
    return "random play" if policy == "random" else policy


def _with_error(values: list[float]) -> str:
    error = f" ± {stdev(values) / len(values) ** 0.5:.1f}" if len(values) > 1 else ""
    return f"{fmean(values):.1f}{error}"


def _mean(measured: list[dict[str, float]], name: str, digits: int) -> str:
    """The mean of a metric over the episodes in which it is defined, and the number of the others."""
    defined = [metrics[name] for metrics in measured if not isnan(metrics[name])]
    if not defined:
        return UNDEFINED
    others = len(measured) - len(defined)
    return f"{fmean(defined):.{digits}f}" + f", {UNDEFINED} in {others} of {len(measured)}" * (others > 0)


def _notes(played: Mapping[str, list[Episode]]) -> Iterator[str]:
    for policy, episodes in played.items():
        if all(episode.harvest is not None and not episode.harvest.any() for episode in episodes):
            yield f"{policy}: nobody harvested anything, so equality and sustainability are undefined"
    baseline = next(iter(played))
    of = _returns if played[baseline][0].harvest is None else _harvests
    if len(played) > 1 and fmean(map(of, played[baseline])) <= 0:
        yield f"times that of {_who(baseline)}: undefined, because it is not above 0"
