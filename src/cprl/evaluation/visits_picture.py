"""draw_visits: a map for each agent of the cells in which it spends its time, and who owns which cell."""

from math import ceil
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cprl import arguments
from cprl.commons.colours import APPLE, GROUND, PALETTE, WALL, agent_colour
from cprl.commons.maps import Map
from cprl.evaluation.territory import EXCLUSION, VISITORS, Policy, Territory
from cprl.measuring.territory import owners
from cprl.plotting import style

Array = NDArray[Any]

COLUMNS: Final = 3
"""Maps side by side."""
DARKEST: Final = 0.3
"""The brightness of a cell that was visited least; 1 is the cell with the longest stay."""


def draw_visits(
    found: Territory, path: str | Path, *, replica: int | None = None, policy: Policy = "trained"
) -> Path:
    """Draws where each agent of a replica spends its time, and last of all who spends most time in each cell.

    Hue is the agent. Brightness is the share of its time by its square root, the same scale in all maps, from
    the least to the longest stay of any agent. A ring is where the agent starts, small squares are sites, and
    grey cells walls. In the last map a cell has the hue of its owner; it is brighter the more time the owner
    spends there, and the larger its share in the time of all. As agents have four hues, numbers say who owns
    what, each where its owner spends most time.

    Args:
        found: what `cprl.evaluation.territory_of` returns.
        path: the PNG.
        replica: the index of the replica in the run; by default the first one that played.
        policy: "trained" for the run's agents, "random" for random ones.

    Returns:
        The path.

    Raises:
        ValueError: if an argument does not fit.
        FileExistsError: if the file exists.
    """
    arguments.object_of("found", found, Territory, "a value of territory_of")
    path = style.check_picture(path)
    stays = found.of(policy)
    number = found.replicas[0] if replica is None else arguments.integer("replica", replica, 0)
    if number not in found.replicas:
        raise arguments.refusal("replica", number, f"one that played, of {list(found.replicas)}")
    place = found.replicas.index(number)
    board, shares = found.run.game.map, stays.visits[place]
    figure, panels = _panels(len(shares) + 1, board)
    for agent, panel in enumerate(panels[:-1]):
        _show(panel, board, _in_hue(shares[agent], agent, shares.max()))
        row, col, _ = board.starts[agent]
        panel.plot(col, row, "o", markersize=5, fillstyle="none", color="white", markeredgewidth=0.8)
        tagged = int(stays.taggings[place, agent].sum())
        panel.set_title(f"agent {agent}, tagged {tagged:,} times", fontsize=style.SMALL_PT)
    _owners(panels[-1], board, shares)
    index, sharing = (float(stays.by_replica[name][place]) for name in (EXCLUSION, VISITORS))
    who = "random agents" if policy == "random" else "its agents"
    title = (
        f"{found.run.path.name}, replica {number}: where {who} spend {found.episodes} episodes; "
        f"exclusion {index:.2f}, {sharing:.1f} agents share a cell"
    )
    figure.suptitle(fill(title, style.TITLE_CHARACTERS), fontsize=11)
    return style.save(figure, path, colours=style.SHADES)


def _panels(count: int, board: Map) -> tuple[Figure, list[Axes]]:
    """A figure with so many boards, all of the same size."""
    columns = min(COLUMNS, count)
    rows = ceil(count / columns)
    wide = style.WIDTH_IN * 1.25 / columns
    figure = Figure(
        figsize=(wide * columns, rows * (wide * board.height / board.width + 0.3) + 0.7), layout="constrained"
    )
    panels = [figure.add_subplot(rows, columns, place + 1) for place in range(count)]
    return figure, panels


def _in_hue(shares: Array, agent: int, longest: float) -> Array:
    """The map of one agent, float64 [H, W, 3], 0..1."""
    light = np.where(shares > 0, DARKEST + (1 - DARKEST) * np.sqrt(shares / max(longest, 1e-12)), 0.0)
    return _blend(np.broadcast_to(_rgb(agent_colour(agent)), (*shares.shape, 3)), light)


def _blend(hues: Array, light: Array) -> Array:
    """Hues [H, W, 3] on the ground, by their brightness [H, W]."""
    blended: Array = _rgb(PALETTE[GROUND]) * (1 - light[..., None]) + hues * light[..., None]
    return blended


def _rgb(colour: tuple[int, int, int]) -> Array:
    return np.array(colour) / 255


def _show(panel: Axes, board: Map, image: Array) -> None:
    """Shows a map of visits with the walls and sites of the board."""
    image = image.copy()
    for cell in board.walls:
        image[cell] = _rgb(PALETTE[WALL])
    panel.imshow(image, interpolation="nearest")
    rows, cols = np.array(board.sites).T
    panel.scatter(cols, rows, s=1.5, marker="s", color=_rgb(PALETTE[APPLE]), linewidths=0)
    panel.set_xticks([])
    panel.set_yticks([])


def _owners(panel: Axes, board: Map, shares: Array) -> None:
    """Shows who owns each cell, with the owner's number in the middle of what it owns."""
    owner, longest, total = owners(shares), shares.max(0), shares.sum(0)
    alone = np.divide(longest, total, out=np.zeros_like(total), where=total > 0)
    light = DARKEST + (1 - DARKEST) * np.sqrt(longest / max(longest.max(), 1e-12)) * alone
    hues = np.stack([_rgb(agent_colour(agent)) for agent in range(len(shares))])
    _show(panel, board, _blend(hues[owner], np.where(owner >= 0, light, 0.0)))
    for agent, share in enumerate(shares):
        own = np.where(owner == agent, share, 0.0)
        if own.any():
            row, col = divmod(int(own.argmax()), board.width)
            panel.text(col, row, str(agent), color="white", fontsize=7, ha="center", va="center_baseline")
    panel.set_title("who spends most time where", fontsize=style.SMALL_PT)
