"""The results of a run, printed in the terminal."""

from collections.abc import Mapping
from math import isnan
from pathlib import Path
from statistics import fmean
from typing import Final

from rich.console import Console
from rich.table import Table

from cprl.arguments import object_of, objects, path
from cprl.checks import TEXT, checked
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import mean_return
from cprl.measuring.replicas import social_metrics
from cprl.measuring.reported import left_out
from cprl.terminal.progress import console_of
from cprl.viewer.streams import viewer

KEPT = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
METRICS: Final = {
    "survival_steps": ("survival_steps", 2),
    "sustainability": ("sustainability", 2),
    "equality": ("equality", 2),
    "peacefulness": ("peacefulness", 2),
    "stock_left": ("apples left", 1),
}
"""The name and digits of each metric that is printed if the game reports it."""


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
        run: the run's directory.
        title: what was run, with its schedule.
        played: episodes in fresh worlds by the name of the policy; the first policy is the baseline.
        figure: the training curve.
        note: a sentence below the table.
        console: the console; by default standard output.
    """
    run, console = path("run", run), console_of(console)
    checked("title", title, TEXT)
    object_of("played", played, Mapping, "episodes by the name of the policy, at least one")
    for name, episodes in played.items():
        if not objects(f"played[{name!r}]", episodes, Episode, "an Episode"):
            raise ValueError(f"played[{name!r}] is empty; allowed: at least one episode")
    if not played:
        raise ValueError("played is empty; allowed: the episodes of at least one policy")
    console.print(_table(title, played))
    if note:
        console.print(note, soft_wrap=True, highlight=False)
    missing = left_out(next(iter(played.values()))[0].reported)
    if missing:
        console.print(missing, soft_wrap=True)
    kept = [name for name in KEPT if (run / name).exists()]
    console.print(f"Saved in {run}: {', '.join(kept)}", soft_wrap=True)
    if figure:
        console.print(f"Training curve: {figure}", soft_wrap=True)
    if "run.rrd" in kept:
        console.print(f"Watch again: {viewer()} {run / 'run.rrd'}", soft_wrap=True)


def _table(title: str, played: Mapping[str, list[Episode]]) -> Table:
    """A column for each policy, a row for each number."""
    table = Table(title=title)
    table.add_column()
    for name in played:
        table.add_column(name, justify="right")
    means = [mean_return(episodes) for episodes in played.values()]
    table.add_row("mean return", *(f"{mean:.1f} ± {error:.1f}" for mean, error in means))
    base, _ = means[0]
    if base > 0:
        table.add_row("relative to the first", *(f"{mean / base:.1f} x" for mean, _ in means))
    measured = {name: [social_metrics(episode) for episode in own] for name, own in played.items()}
    known = next(iter(measured.values()))[0]
    for metric, (name, digits) in METRICS.items():
        if metric in known:
            table.add_row(name, *(f"{_mean(own, metric):.{digits}f}" for own in measured.values()))
    table.add_row("episodes", *(str(len(episodes)) for episodes in played.values()))
    return table


def _mean(measured: list[dict[str, float]], name: str) -> float:
    """The mean of a metric over the episodes in which it is defined."""
    defined = [metrics[name] for metrics in measured if not isnan(metrics[name])]
    return fmean(defined) if defined else float("nan")
