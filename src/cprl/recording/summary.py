"""What a run came to, in the terminal."""

from pathlib import Path
from statistics import fmean

from rich.console import Console
from rich.table import Table

from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import mean_return


def summarise(
    run: Path,
    *,
    title: str,
    trained: list[Episode],
    chance: list[Episode],
    figure: Path | None = None,
    published: str | None = None,
    console: Console | None = None,
) -> None:
    """Prints the trained, greedy policy beside the random one, and where everything is kept.

    Args:
        run: the run's directory.
        title: what was run, with its schedule.
        trained: episodes of the trained policy on fresh worlds.
        chance: episodes of the random policy on fresh worlds.
        figure: the training curve.
        published: the command of the published schedule, where this was another.
        console: where to; by default standard output.
    """
    console = console or Console()
    table = Table(title=title)
    for column in ("", "trained, greedy", "random"):
        table.add_column(column, justify="left" if not column else "right")
    returns = [mean_return(trained), mean_return(chance)]
    table.add_row("mean return", *(f"{mean:.1f} ± {error:.1f}" for mean, error in returns))
    for name in ("survival_steps", "sustainability", "equality", "peacefulness"):
        table.add_row(name, *(f"{_mean(episodes, name):.2f}" for episodes in (trained, chance)))
    table.add_row("apples left", *(f"{fmean(e.stock_left for e in many):.1f}" for many in (trained, chance)))
    table.add_row("episodes", *(str(len(episodes)) for episodes in (trained, chance)))
    console.print(table)
    console.print(
        f"The trained policy's return is {returns[0][0] / returns[1][0]:.1f} times the random one's."
    )
    if published:
        console.print(f"This was a shortened schedule. The published one: {published}", soft_wrap=True)
    console.print(f"Kept in {run}: recipe.json, episodes.parquet, run.rrd, checkpoints/", soft_wrap=True)
    if figure:
        console.print(f"Training curve: {figure}", soft_wrap=True)
    console.print(f"Watch again: .venv/bin/rerun {run / 'run.rrd'}", soft_wrap=True)


def _mean(episodes: list[Episode], name: str) -> float:
    """The mean of a metric over the episodes in which it is defined."""
    values = [episode.metrics[name] for episode in episodes]
    defined = [value for value in values if value == value]
    return fmean(defined) if defined else float("nan")
