"""What a run came to, in the terminal."""

from collections.abc import Mapping
from math import isnan
from pathlib import Path
from statistics import fmean

from rich.console import Console
from rich.table import Table

from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import mean_return
from cprl.viewer.streams import viewer

KEPT = ("recipe.json", "episodes.parquet", "run.rrd", "checkpoints", "figures")
METRICS = ("survival_steps", "sustainability", "equality", "peacefulness")


def summarise(
    run: Path,
    *,
    title: str,
    played: Mapping[str, list[Episode]],
    figure: Path | None = None,
    console: Console | None = None,
) -> None:
    """Prints policies beside each other, each by its episodes, and where everything is kept.

    Args:
        run: the run's directory.
        title: what was run, with its schedule.
        played: episodes on fresh worlds by the name of the policy; the others are compared with the first.
        figure: the training curve.
        console: where to; by default standard output.
    """
    console = console or Console()
    console.print(_table(title, played))
    kept = [name for name in KEPT if (run / name).exists()]
    console.print(f"Kept in {run}: {', '.join(kept)}", soft_wrap=True)
    if figure:
        console.print(f"Training curve: {figure}", soft_wrap=True)
    if "run.rrd" in kept:
        console.print(f"ViewerCallback again: {viewer()} {run / 'run.rrd'}", soft_wrap=True)


def _table(title: str, played: Mapping[str, list[Episode]]) -> Table:
    """A column for each policy, a row for each number."""
    table = Table(title=title)
    table.add_column()
    for name in played:
        table.add_column(name, justify="right")
    means = [mean_return(episodes) for episodes in played.values()]
    table.add_row("mean return", *(f"{mean:.1f} ± {error:.1f}" for mean, error in means))
    base, _ = means[0]
    if base:
        table.add_row("beside the first", *(f"{mean / base:.1f} x" for mean, _ in means))
    for metric in METRICS:
        table.add_row(metric, *(f"{_mean(episodes, metric):.2f}" for episodes in played.values()))
    left = (fmean(episode.stock_left for episode in episodes) for episodes in played.values())
    table.add_row("apples left", *(f"{apples:.1f}" for apples in left))
    table.add_row("episodes", *(str(len(episodes)) for episodes in played.values()))
    return table


def _mean(episodes: list[Episode], name: str) -> float:
    """The mean of a metric over the episodes in which it is defined."""
    defined = [value for episode in episodes if not isnan(value := episode.metrics[name])]
    return fmean(defined) if defined else float("nan")
