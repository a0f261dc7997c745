"""Figures of a run, plotted from its table of episodes alone."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cprl.arguments import objects, path
from cprl.checks import TEXT, checked, count
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import mean_return
from cprl.measuring.published import SMOOTHED_EPISODES
from cprl.runs.curves import running_mean
from cprl.runs.episodes import read_episodes


def training_curve(
    run: Path, *, title: str, random: list[Episode] | None = None, smoothed: int = SMOOTHED_EPISODES
) -> Path:
    """Plots the summed return of all agents in each episode of a run, as the mean over replicas, and its
    running mean.

    Args:
        run: the run's directory.
        title: what was run, with its schedule.
        random: episodes of the random policy, whose mean return is a dashed line.
        smoothed: the window of the running mean in episodes, plotted at its first episode as in the study.

    Returns:
        The PNG, `figures/training_curve.png` of the run.
    """
    run = path("run", run)
    title = checked("title", title, TEXT).encode("utf-8", "replace").decode()
    checked("smoothed", smoothed, count(1))
    random = None if random is None else list(objects("random", random, Episode, "an Episode"))
    rows = read_episodes(run)
    has_harvest = "harvest" in rows.column_names
    table = rows.select(["replica", "episode", "return"]).to_pydict()
    episodes = np.array(table["episode"])
    returns = np.zeros(int(episodes.max()) + 1)
    np.add.at(returns, episodes, table["return"])
    returns /= len(set(table["replica"]))
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    each = "each episode, mean of the replicas" if max(table["replica"]) else "each episode"
    axes.plot(returns, color="#9ecae1", linewidth=0.8, label=each)
    window = min(smoothed, max(1, len(returns) // 5))
    mean = running_mean(returns, window)
    axes.plot(mean, color="#08519c", linewidth=2, label=f"mean of {window} episodes from here")
    if random:
        level, _ = mean_return(random)
        axes.axhline(level, color="#636363", linestyle="--", label=f"random policy, {level:.1f}")
    axes.set(title=title, xlabel="episode")
    axes.set_ylabel("collective return, apples" if has_harvest else "return of all agents together")
    if has_harvest or returns.min() >= 0:
        axes.set_ylim(0, None)
    axes.legend(loc="lower right")
    picture = run / "figures" / "training_curve.png"
    picture.parent.mkdir(exist_ok=True)
    figure.savefig(picture, dpi=120)
    return picture
