"""draw_gains: a matrix of what focal agents gain, and one of what it costs the background agents."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from cprl.evaluation.cross_play import CrossPlay
from cprl.evaluation.gains import diagonal_returns, gains
from cprl.evaluation.tables import unit_of_cells
from cprl.measuring.names import with_unit
from cprl.measuring.statistics import Estimate
from cprl.plotting.cells import EMPTY, draw_cell
from cprl.plotting.style import SHADES, SMALL_PT, head, picture_path, save, wrapped

_COLOURS: Final = "RdBu"
_CELL_IN: Final = (0.82, 0.45)
_NARROWEST_IN: Final = 7.0
_PANELS: Final = {
    "focal": "the focal agent, beside the agent whose place it takes",
    "background": "the background agents, beside themselves without it",
}


def draw_gains(played: CrossPlay, path: Path | str) -> Path:
    """Draws `gains`, a row for each focal agent's run, a column for each of background agents.

    Args:
        played: the cross-play.
        path: the PNG.

    Raises:
        ValueError: if the name does not end in .png.
    """
    path, found = picture_path(path), gains(played)
    names, diagonal = list(played.runs), diagonal_returns(played)
    returns = with_unit("focal/return", rewards=unit_of_cells(played)).partition("/")[2]
    width = max(_CELL_IN[0] * len(names) + 2.6, _NARROWEST_IN)
    figure = Figure((width, 2 * (_CELL_IN[1] * len(names) + 0.9) + 1.2), layout="constrained")
    for axes, (whose, title) in zip(figure.subplots(2, 1), _PANELS.items(), strict=True):
        own = {at: getattr(gain, whose) for at, gain in found.items()}
        _draw_matrix(axes, names, own, diagonal)
        axes.set_title(f"difference in {returns} of {title}", fontsize=SMALL_PT + 1)
    count = len(played.replicas)
    note = (
        f"{count} replica{'s' * (count != 1)}, {played.episodes} episodes each with focal agent at each "
        f"index; diagonal ({played.diagonal.replace('_', '-')}): an agent's return. * the 95 % interval by "
        f"Student's t excludes 0, as that of about one in twenty would by chance; these are "
        f"{2 * len(found)}."
    )
    head(figure, "Cross-play: who gains among whom", note)
    return save(figure, path, colours=SHADES)


def _draw_matrix(
    axes: Axes,
    names: list[str],
    gains_by_cell: Mapping[tuple[str, str], Estimate],
    diagonal: Mapping[str, float],
) -> None:
    reach = max(abs(own.value) for own in gains_by_cell.values()) or 1.0
    scale, colours = Normalize(-reach, reach), matplotlib.colormaps[_COLOURS]
    for (focal, background), own in gains_by_cell.items():
        star = " *" if own.low > 0 or own.high < 0 else ""
        at = names.index(background), names.index(focal)
        draw_cell(axes, *at, colours(scale(own.value)), f"{own.value:+.3g}{star}")
    for place, name in enumerate(names):
        draw_cell(axes, place, place, EMPTY, f"{diagonal[name]:.3g}")
    labels = [wrapped(name, _CELL_IN[0]) for name in names]
    axes.set_xticks(range(len(names)), labels)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlim=(-0.5, len(names) - 0.5), ylim=(len(names) - 0.5, -0.5))
    axes.set_xlabel("background agents", fontsize=SMALL_PT)
    axes.set_ylabel("focal agent", fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT, length=0)
    axes.figure.colorbar(matplotlib.cm.ScalarMappable(scale, _COLOURS), ax=axes).ax.tick_params(
        labelsize=SMALL_PT
    )
