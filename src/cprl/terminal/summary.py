"""The results of a run, printed in the terminal: first what they come to, then tables and files."""

from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console
from rich.text import Text

from cprl.measuring.episodes import Episode
from cprl.measuring.played import (
    ByReplica,
    Measured,
    by_metric,
    clock_of,
    difference_paired,
    notes_on,
    over_replicas,
)
from cprl.measuring.registry import METRICS, OF_INSTITUTIONS, is_own, left_out, with_unit
from cprl.measuring.registry import title as metric_title
from cprl.measuring.statistics import signed
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.system.shipped import cprl_here
from cprl.terminal.tables import Cells

_OF_AGENTS: Final = {"fines": "fined", "transfers": "given", "violations": "violations"}
_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
RETURN: Final = "return of all agents together"
INTERVALS: Final = "means over replicas [95 % interval by Student's t]"

Played = Mapping[str, Mapping[int, Sequence[Episode]]]
"""Episodes by the name of the policy, then by replica."""


def summarise(
    run: Path,
    *,
    title: str,
    played: Played,
    course: str = "",
    figure: Path | None = None,
    note: str | None = None,
    console: Console | None = None,
) -> None:
    """Prints what became of the run, tables that compare policies, the metrics that are left out, and the
    files of the run.

    Args:
        played: episodes in fresh worlds by the name of the policy; the first policy is the baseline.
        course: see `cprl.training.course`; by default what each policy gets.
    """
    console = console or safe_console()
    console.print(Text(course or _verdict(played), style="bold"))
    console.print(_table(title, played))
    of_institutions = institutions_table(played)
    if of_institutions is not None:
        console.print(of_institutions)
    lines = [*_notes(played), note, left_out(_first(played).reported)]
    files = [name for name in _FILES if (run / name).exists()]
    lines += [f"Saved in {run}: {', '.join(files)}", f"Training curve: {figure}" if figure else None]
    if any(run.glob("run*.rrd")):
        lines.append(f"Watch again: {printed([*cprl_here(), 'watch', str(run)])}")
    for line in filter(None, lines):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def _first(played: Played) -> Episode:
    return next(iter(next(iter(played.values())).values()))[0]


def _verdict(played: Played) -> str:
    """Return what each policy gets, and how much more than the first, if it is more over replicas."""
    gains = [_gains(episodes) for episodes in played.values()]
    is_harvest = all(_harvests(episodes) for episodes in played.values())
    what = f"{'apples' if is_harvest else 'of return'} an episode, all agents together"
    parts = [f"{_called(name)}: {over_replicas(gain)}" for name, gain in zip(played, gains, strict=True)]
    for place, gain in enumerate(gains[1:], 1):
        more = difference_paired(gain, gains[0])
        parts[place] += f" ({more:+} beside {_called(next(iter(played)))})" if more is not None else ""
    return f"{'; '.join([parts[-1], *parts[:-1]])} {what}"


def _table(title: str, played: Played) -> Cells:
    """A column for each policy, then one for what each has more than the first; a row for each number."""
    names = [name if place or len(played) == 1 else f"{name} (baseline)" for place, name in enumerate(played)]
    returns = [_returns(episodes) for episodes in played.values()]
    harvests = [_harvests(episodes) for episodes in played.values()]
    values: dict[str, Sequence[ByReplica]] = {}
    if all(harvests):
        values[with_unit("collective_return")] = harvests
        if not all(_are_close(*both) for both in zip(harvests, returns, strict=True)):  # as under fines
            values[f"{RETURN}, rewards"] = returns
    else:
        values[RETURN] = returns
    measured = [by_metric(episodes, attrgetter("social")) for episodes in played.values()]
    metrics = [name for name, metric in METRICS.items() if metric.is_summarised and name in measured[0]]
    metrics += filter(is_own, measured[0])
    values |= {metric_title(name): [of_policy[name] for of_policy in measured] for name in metrics}
    of_rows = dict(zip(values, [*[""] * (len(values) - len(metrics)), *metrics], strict=True))
    rows, measures = _rows(values, of_rows, played)
    counts = (str(sum(map(len, episodes.values()))) for episodes in played.values())
    rows.append(["episodes", *counts, *[""] * (len(played) - 1)])
    notes = "\n".join([INTERVALS, *notes_on(measures)])
    return Cells(title, ["", *names, *_differences(played)], rows, notes)


def _rows(
    values: Mapping[str, Sequence[ByReplica]], metrics: Mapping[str, str], played: Played
) -> tuple[list[list[str]], list[Measured]]:
    """A row for each number by its words, but for those that are undefined everywhere; and all that is in
    them.

    Args:
        values: of each policy.
        metrics: the name of the metric, where it is one.
    """
    clock = max(clock_of(episodes) for episodes in played.values())
    rows = []
    all_measures = list[Measured]()
    for words, of_policies in values.items():
        measures = [over_replicas(of_policy, metrics[words], clock) for of_policy in of_policies]
        if all(measured.estimate is None for measured in measures):
            continue
        name = metrics[words]
        more = (difference_paired(of_policy, of_policies[0], name, clock) for of_policy in of_policies[1:])
        rows.append([words, *map(str, measures), *map(signed, more)])
        all_measures += measures
    return rows, all_measures


def _differences(played: Played) -> list[str]:
    """Return what the columns of differences are called."""
    baseline, *others = played
    return [f"{name} - {baseline}" if len(others) > 1 else "difference, paired" for name in others]


def _called(policy: str) -> str:
    return "random play" if policy == "random" else policy


def _returns(episodes: Mapping[int, Sequence[Episode]]) -> dict[int, list[float]]:
    return {replica: [float(one.return_.sum()) for one in played] for replica, played in episodes.items()}


def _harvests(episodes: Mapping[int, Sequence[Episode]]) -> dict[int, list[float]]:
    """Of all agents in each episode; {} in a game that reports none."""
    harvests = {
        replica: [float(one.harvest.sum()) for one in played if one.harvest is not None]
        for replica, played in episodes.items()
    }
    return harvests if all(harvests.values()) else {}


def _gains(episodes: Mapping[int, Sequence[Episode]]) -> dict[int, list[float]]:
    return _harvests(episodes) or _returns(episodes)


def _are_close(values: ByReplica, others: ByReplica) -> bool:
    return all(np.allclose(values[replica], others[replica], rtol=0, atol=1e-3) for replica in values)


def _notes(played: Played) -> Iterator[str]:
    """Say why metrics are undefined."""
    for policy, episodes in played.items():
        harvests = _harvests(episodes)
        if harvests and not any(map(any, harvests.values())):
            yield f"{policy}: nobody harvested anything, so equality and sustainability are undefined"


def _is_any(name: str, episodes: Sequence[Episode]) -> bool:
    values = [episode.of_institutions[name] for episode in episodes]
    return any(value > 0 or value < 0 for value in values)


def institutions_table(played: Played) -> Cells | None:
    """A column for each policy; a row for each metric, then for each agent what it was fined and given, and
    its violations. None for a game without institutions, and where all of it is 0.

    What is 0 under every policy has no row, nor have shares of something that never happened.
    """
    first = _first(played)
    if set(OF_INSTITUTIONS).isdisjoint(first.reported):
        return None
    measured = [by_metric(episodes, attrgetter("of_institutions")) for episodes in played.values()]
    together = [[one for of_replica in by.values() for one in of_replica] for by in played.values()]
    seen = {
        name
        for name in first.of_institutions
        if "in_force_" in name or any(_is_any(name, episodes) for episodes in together)
    }
    if all("equality" in name for name in seen):
        return None
    names = [name for name in first.of_institutions if name in seen or "equality" in name]
    values = {with_unit(name): [metrics[name] for metrics in measured] for name in names}
    rows, measures = _rows(values, dict(zip(values, names, strict=True)), played)
    of_agents = {
        word: [np.mean([getattr(episode, name) for episode in episodes], 0) for episodes in together]
        for name, word in _OF_AGENTS.items()
        if getattr(first, name) is not None
    }
    of_agents = {word: means for word, means in of_agents.items() if np.any(means)}
    for agent in range(len(first.return_)) if of_agents else ():
        texts = (
            " / ".join(f"{means[place][agent]:.1f}" for means in of_agents.values())
            for place in range(len(played))
        )
        rows.append([f"agent {agent}: {' / '.join(of_agents)}", *texts, *[""] * (len(played) - 1)])
    notes = "\n".join([f"{INTERVALS}; of agents, means", *notes_on(measures)])
    return Cells("institutions", ["", *played, *_differences(played)], rows, notes)
