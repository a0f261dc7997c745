"""draw_scenarios: the return of focal agents in each scenario, beside others in their places."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cprl.arguments import object_of
from cprl.evaluation.scenarios.score import FocalAgents, Scores, Whose
from cprl.measuring.statistics import Estimate
from cprl.plotting.style import MARK, MEAN, SMALL_PT, head, picture_path, save

_LOOKS: Final[dict[tuple[FocalAgents, Whose], tuple[str, str, str]]] = {
    ("run", "focal"): ("o", MEAN, "focal agents: the run's"),
    ("greedy", "focal"): ("s", MARK, "greedy in their place"),
    ("random", "focal"): ("D", "#8a8a8a", "random in their place"),
    ("run", "background"): ("|", "#000000", "background agents, beside the run's"),
}
"""Marker, colour and name of each number."""
_ROW_IN: Final = 0.55
_BAND: Final = 0.16
"""The distance between two numbers of a scenario, in rows."""


def draw_scenarios(scores: Scores, path: Path | str) -> Path:
    """Draws the mean return per agent, a row for each scenario: of the run's agents in the focal places, of
    greedy and of random ones there, and of the background; intervals by Student's t.

    Args:
        scores: what `run_scenarios` gave.
        path: the PNG.

    Raises:
        ValueError: if the name does not end in .png.
    """
    object_of("scores", scores, Scores, "what run_scenarios() gave")
    path = picture_path(path)
    figure = Figure((8.0, _ROW_IN * len(scores.by_scenario) + 2.0), layout="constrained")
    axes = figure.subplots()
    _draw_rows(axes, scores)
    figure.legend(loc="outside lower center", ncols=2, fontsize=SMALL_PT, frameon=False)
    count = len(scores.replicas)
    note = (
        f"{count} replica{'s' * (count != 1)}, {scores.episodes} episodes each in each placement, the same "
        "worlds for all; mean over replicas, 95 % interval by Student's t."
    )
    head(figure, f"Scenarios of {scores.run.path.name}", note)
    return save(figure, path)


def _draw_rows(axes: Axes, scores: Scores) -> None:
    names = list(scores.by_scenario)
    for place, ((who, whose), (marker, colour, label)) in enumerate(_LOOKS.items()):
        found = [scores.by_scenario[name].measures(who)[f"{whose}/return"].estimate for name in names]
        rows = [row + _BAND * (place - (len(_LOOKS) - 1) / 2) for row in range(len(names))]
        values = [own for own in found if own is not None]  # a return is always defined
        axes.plot(
            [own.value for own in values], rows, marker, color=colour, markersize=6, label=label, zorder=3
        )
        for row, own in zip(rows, values, strict=True):
            _draw_interval(axes, row, own, colour)
    for row in range(1, len(names)):
        axes.axhline(row - 0.5, color="#dddddd", linewidth=0.8)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("return per agent, apples", fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT)


def _draw_interval(axes: Axes, row: float, own: Estimate, colour: str) -> None:
    axes.plot([own.low, own.high], [row, row], color=colour, linewidth=2)
