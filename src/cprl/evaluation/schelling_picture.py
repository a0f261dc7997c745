"""draw_schelling: a Schelling diagram as a figure."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cprl.arguments import object_of
from cprl.evaluation.schelling import SchellingDiagram, Values
from cprl.measuring.statistics import estimate
from cprl.plotting import style

_RESTRAINED: Final = "#1b7837"
_GREEDY: Final = "#b2182b"
_SIZE_IN: Final = (7.5, 3.6)


def draw_schelling(found: SchellingDiagram, path: Path | str) -> Path:
    """Draws what an agent gets that is restrained or greedy, by how many of the others are restrained; beside
    it what all get together.

    Args:
        found: the diagram.
        path: the PNG.

    Raises:
        ValueError: if the name does not end in .png.
        FileExistsError: if the file exists.
    """
    object_of("found", found, SchellingDiagram, "what schelling() gave")
    path = style.check_picture(path)
    figure = Figure(_SIZE_IN, layout="constrained")
    own, group = figure.subplots(1, 2)
    for payoffs, who, role, colour, marker in (
        (found.restrained_payoffs, found.restrained, "restrained", _RESTRAINED, "o"),
        (found.greedy_payoffs, found.greedy, "greedy", _GREEDY, "s"),
    ):
        _line(own, payoffs, label=f"{role}: {Path(who).name}", color=colour, marker=marker)
    own.set_xlabel(f"restrained agents among the other {found.agents - 1}", fontsize=style.SMALL_PT)
    own.set_ylabel("return of the agent", fontsize=style.SMALL_PT)
    own.legend(fontsize=style.SMALL_PT)
    _line(group, found.group_payoffs, color=style.MEAN, marker="o")
    group.set_xlabel(f"restrained agents of {found.agents}", fontsize=style.SMALL_PT)
    group.set_ylabel("return of all together", fontsize=style.SMALL_PT)
    for axes in (own, group):
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.tick_params(labelsize=style.SMALL_PT)
    note = (
        f"{found.replicas} replicas, {found.episodes} episodes each for each choice of restrained agents; "
        f"bars: 95 % intervals by Student's t"
    )
    style.head(figure, f"Schelling diagram: {found.dilemma().name}", note)
    return style.save(figure, path)


def _line(axes: Axes, values: Values, **how: Any) -> None:
    """Means of [R, K] at 0 to K - 1 with their intervals."""
    found = [estimate(own) for own in values.T]
    means = np.array([own.value for own in found])
    reach = np.abs(np.array([(own.low, own.high) for own in found]).T - means)
    axes.errorbar(range(len(means)), means, np.nan_to_num(reach), capsize=2, markersize=5, **how)
    axes.set_xticks(range(len(means)))
