"""The results of a run, printed in the terminal: first what they come to, then tables and files."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from math import isnan
from pathlib import Path
from statistics import fmean, stdev
from typing import Final

import numpy as np
from rich.console import Console
from rich.text import Text

from cprl.measuring.episodes import Episode
from cprl.measuring.metrics import DIGITS, INSTITUTIONAL, is_own, left_out, with_unit
from cprl.measuring.metrics import title as metric_title
from cprl.runs.curves import as_curves, running_mean
from cprl.runs.episodes import read_episodes, read_rows
from cprl.system.output import console as safe_console
from cprl.system.output import printed
from cprl.system.shipped import cprl_here
from cprl.terminal.tables import Cells

_OF_AGENTS: Final = {"fines": "fined", "transfers": "given", "violations": "violations"}
_FILES: Final = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
RETURN: Final = "return of all agents together"
UNDEFINED: Final = "undefined"

Played = Mapping[str, Sequence[Episode]]
"""Episodes by the name of the policy."""


def summarise(
    run: Path,
    *,
    title: str,
    played: Played,
    figure: Path | None = None,
    note: str | None = None,
    console: Console | None = None,
) -> None:
    """Prints what policies get, tables that compare them, the metrics that are left out, and the files of
    the run.

    Args:
        played: episodes in fresh worlds by the name of the policy; the first policy is the baseline.
    """
    console = console or safe_console()
    console.print(Text(_verdict(played), style="bold"))
    console.print(_table(title, played))
    of_institutions = institutions_table(played)
    if of_institutions is not None:
        console.print(of_institutions)
    lines = [*_notes(played), note, left_out(next(iter(played.values()))[0].reported)]
    files = [name for name in _FILES if (run / name).exists()]
    lines += [f"Saved in {run}: {', '.join(files)}", f"Training curve: {figure}" if figure else None]
    if any(run.glob("run*.rrd")):
        lines.append(f"Watch again: {printed([*cprl_here(), 'watch', str(run)])}")
    for line in filter(None, lines):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def course_of(run: Path) -> str:
    """What happened in sentences: the peak, what followed, how long boards last, and what that means.

    A tragedy, here: the last 30 episodes yield at most 95 % of random play, the best ten at least 1.5 times
    as much as it, and boards last at most 70 % of the turns that they could.
    """
    table = read_episodes(run)
    curves, at_end = as_curves(table), as_curves(table, at_end=True)
    if lacking := sorted({"collective_return", "survival_steps"} - set(curves)):
        raise ValueError(f"the episodes of {run} lack {', '.join(lacking)}; allowed: games that report them")
    returns, survival = curves["collective_return"].mean(0), curves["survival_steps"]
    last, lasts = (at_end[name][:, -30:].mean() for name in ("collective_return", "survival_steps"))
    tens = running_mean(returns, 10)
    by_chance = as_curves(read_rows(run / "evaluation" / "random.parquet"))["collective_return"]
    random, error = by_chance.mean(), by_chance.std(ddof=1) / by_chance.size**0.5
    peak, times, shares = tens.max(), "where random play gets none", []
    if peak:
        shares.append(f"{1 - last / peak:.0%} below that peak")
    if random:
        times = f"{peak / random:.1f} times the {random:.0f} ± {error:.0f} of random play"
        more = "less" if last < random else "more"
        shares.append(f"{abs(last / random - 1):.0%} {more} than random play gets")
    if random > 0 and last <= 0.95 * random and peak >= 1.5 * random and lasts <= 0.7 * survival.max():
        meaning = (
            "Each agent learned to take what pays now, and all of them, trained, end worse off than agents "
            "who never learned: the tragedy of the commons."
        )
    elif last > random:
        meaning = "They end better off than agents who never learned: no tragedy so far."
    else:
        meaning = "They end no better off than agents who never learned."
    return (
        f"The agents began at {tens[0]:.0f} apples an episode, all together, and reached {peak:.0f} "
        f"around episode {min(tens.argmax() + 5, returns.size)}, {times}. "
        f"In the last {len(returns[-30:])} episodes they got "
        f"{last:.0f}{', ' * bool(shares)}{' and '.join(shares)}. "
        f"Boards that can last {survival.max():.0f} steps now last {lasts:.0f}. {meaning}"
    )


def _verdict(played: Played) -> str:
    """What each policy gets, and how many times as much as the first."""
    is_harvest = all(map(_harvests, played.values()))
    means = {name: fmean(_gains(episodes)) for name, episodes in played.items()}
    baseline, first = next(iter(means.items()))
    what = f"{'apples' if is_harvest else 'of return'} an episode, all agents together"
    parts = [f"{_called(name)}: {mean:,.{1 if abs(mean) < 100 else 0}f}" for name, mean in means.items()]
    if len(means) > 1 and first > 0:
        parts = [
            part if name == baseline else f"{part}, {means[name] / first:.1f} times {_called(baseline)}"
            for part, name in zip(parts, means, strict=True)
        ]
    return f"{'; '.join([parts[-1], *parts[:-1]])} {what}"


def _table(title: str, played: Played) -> Cells:
    """A column for each policy, a row for each number; the first policy is the baseline."""
    names = [name if place or len(played) == 1 else f"{name} (baseline)" for place, name in enumerate(played)]
    returns = [[float(episode.return_.sum()) for episode in episodes] for episodes in played.values()]
    harvests = [_harvests(episodes) for episodes in played.values()]
    if not all(harvests):
        rows = _returns(RETURN, played, returns)
    else:
        rows = _returns(with_unit("collective_return"), played, harvests)
        pairs = zip(chain(*harvests), chain(*returns), strict=True)
        if any(abs(harvest - reward) > 1e-3 for harvest, reward in pairs):  # as under fines
            rows += _returns(f"{RETURN}, rewards", played, returns)
    measured = [[episode.social for episode in episodes] for episodes in played.values()]
    forms = {metric: f".{digits}f" for metric, digits in DIGITS.items()}
    forms |= {metric: ".3g" for metric in measured[0][0] if is_own(metric)}
    rows += [
        (metric_title(metric), *(_mean(episodes, metric, form) for episodes in measured))
        for metric, form in forms.items()
        if metric in measured[0][0]
    ]
    rows.append(("episodes", *(str(len(episodes)) for episodes in played.values())))
    return Cells(title, ["", *names], rows, "means over episodes ± their standard errors")


def _returns(name: str, played: Played, values: Sequence[Sequence[float]]) -> list[tuple[str, ...]]:
    """The mean of a return with its standard error, and how many times the baseline's it is."""
    errors = [f" ± {stdev(of_one) / len(of_one) ** 0.5:.1f}" if len(of_one) > 1 else "" for of_one in values]
    means = [fmean(of_policy) for of_policy in values]
    rows = [(name, *(f"{mean:.1f}{error}" for mean, error in zip(means, errors, strict=True)))]
    if len(played) > 1:
        times = [f"{mean / means[0]:.1f}" if means[0] > 0 else UNDEFINED for mean in means]
        rows.append((f"  times {_called(next(iter(played)))}", *times))
    return rows


def _called(policy: str) -> str:
    return "random play" if policy == "random" else policy


def _harvests(episodes: Sequence[Episode]) -> list[float]:
    """Of all agents in each episode; [] in a game that reports none."""
    return [float(episode.harvest.sum()) for episode in episodes if episode.harvest is not None]


def _gains(episodes: Sequence[Episode]) -> list[float]:
    return _harvests(episodes) or [float(episode.return_.sum()) for episode in episodes]


def _mean(measured: Sequence[Mapping[str, float]], name: str, form: str) -> str:
    """The mean of a metric over the episodes in which it is defined, and the number of the others."""
    defined = [metrics[name] for metrics in measured if not isnan(metrics[name])]
    if not defined:
        return UNDEFINED
    others = len(measured) - len(defined)
    return f"{fmean(defined):{form}}" + f", {UNDEFINED} in {others} of {len(measured)}" * (others > 0)


def _notes(played: Played) -> Iterator[str]:
    for policy, episodes in played.items():
        if (harvests := _harvests(episodes)) and not any(harvests):
            yield f"{policy}: nobody harvested anything, so equality and sustainability are undefined"
    baseline = next(iter(played))
    if len(played) > 1 and fmean(_gains(played[baseline])) <= 0:
        yield f"times {_called(baseline)}: undefined, because it is not above 0"


def institutions_table(played: Played) -> Cells | None:
    """A column for each policy; a row for each metric, then for each agent what it was fined and given, and
    its violations. None for a game without institutions, and where all of it is 0.

    What is 0 under every policy has no row, nor have shares of something that never happened.
    """
    first = next(iter(played.values()))[0]
    if all(getattr(first, name) is None for name in INSTITUTIONAL):
        return None
    measured = [[episode.of_institutions for episode in episodes] for episodes in played.values()]
    seen = {
        name
        for name in first.of_institutions
        if "in_force_" in name
        or any(metrics[name] > 0 or metrics[name] < 0 for of_policy in measured for metrics in of_policy)
    }
    if all("equality" in name for name in seen):
        return None
    rows = [
        (with_unit(name), *(_mean(of_policy, name, ".2f") for of_policy in measured))
        for name in first.of_institutions
        if name in seen or "equality" in name
    ]
    of_agents = {
        word: [np.mean([getattr(episode, name) for episode in episodes], 0) for episodes in played.values()]
        for name, word in _OF_AGENTS.items()
        if getattr(first, name) is not None
    }
    of_agents = {word: means for word, means in of_agents.items() if np.any(means)}
    for agent in range(len(first.return_)) if of_agents else ():
        texts = (
            " / ".join(f"{means[place][agent]:.1f}" for means in of_agents.values())
            for place in range(len(played))
        )
        rows.append((f"agent {agent}: {' / '.join(of_agents)}", *texts))
    return Cells("institutions", ["", *played], rows, "means over episodes")
