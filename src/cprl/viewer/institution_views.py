"""Institutions in a recording besides lines: the owners of regions on the board, and events of episodes."""

from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.commons.colours import agent_colour
from cprl.envs.commons_env import CommonsEnv
from cprl.institutions import Boundaries
from cprl.measuring.episodes import Episode
from cprl.viewer.institutions import has_institutions, lines
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scenery import Curves, Scene
from cprl.viewer.stage import RIM_CELLS

Regions: TypeAlias = list[tuple[list[int], NDArray[np.bool_]]]
"""The owners of each region, and its cells, bool [H, W]."""

_SHARED: Final = (150, 150, 150)
"""The colour of regions of several agents."""
_OPACITY: Final = 170
_INSET_CELLS, _BORDER_CELLS = 0.08, 0.04


def institution_views(logger: RerunLogger, env: CommonsEnv | None) -> "InstitutionViews | None":
    """What a recording shows of institutions; None for a game without them."""
    if not has_institutions(logger.curves):
        return None
    return InstitutionViews(logger, logger.curves, regions=[] if env is None else regions_of(env))


class InstitutionViews:
    """Logs what a recording shows of institutions besides the numbers of episodes; made for games with them.

    Args:
        logger: of the recording.
        curves: what is plotted; a `Scene` if there is a board.
        regions: of a game with `Boundaries`, see `regions_of`.
    """

    def __init__(self, logger: RerunLogger, curves: Curves, *, regions: Regions) -> None:
        self._logger, self._curves = logger, curves
        for entity, style in lines(curves).items():
            logger.log_static(entity, style)
        if regions and isinstance(curves, Scene):
            logger.log_static("world/regions", borders(regions))

    def on_episode(self, episode: Episode) -> None:
        """Logs an event of an episode, at the logger's time: what was decided, broken and paid."""
        told = in_words(episode, self._curves)
        if told:
            self._logger.log_text(f"episode {episode.episode:,}: {told}")


def in_words(episode: Episode, curves: Curves) -> str:
    """What was decided, broken and paid in an episode, e.g. "3 violations; agent 2 fined 1.5"; "" if nothing
    was."""
    parts = []
    if episode.in_force is not None:
        decided = zip(curves.in_force, episode.in_force, strict=False)
        parts.append(", ".join(f"{title}: {value:g}" for title, value in decided))
    if episode.violations is not None and episode.violations.any():
        broken = int(episode.violations.sum())
        parts.append(f"{broken:,} violation{'s' * (broken > 1)}")
    fines = [] if episode.fines is None else episode.fines.tolist()
    parts.append(", ".join(f"agent {nth} fined {own:.4g}" for nth, own in enumerate(fines) if own > 0))
    return "; ".join(part for part in parts if part)


def regions_of(env: CommonsEnv) -> Regions:
    """The regions of all `Boundaries` of a game; those that are open to all are none."""
    found: Regions = []
    for own in env.game.institutions:
        if isinstance(own, Boundaries):
            signs = np.array([list(line) for line in own.regions])
            of_agents = [own.signs_of(agent) for agent in range(env.game.agents)]
            for sign in sorted(set("".join(of_agents))):
                owners = [agent for agent, ours in enumerate(of_agents) if sign in ours]
                found.append((owners, signs == sign))
    return found


def borders(regions: Regions) -> Any:
    """The borders of regions in the hue of their owner, or grey where several share one, as lines."""
    import rerun as rr

    strips, colours = [], []
    for owners, cells in regions:
        found = _borders(cells)
        strips += found
        hue = agent_colour(owners[0]) if len(owners) == 1 else _SHARED
        colours += [(*hue, _OPACITY)] * len(found)
    return rr.LineStrips2D(strips, colors=colours, radii=_BORDER_CELLS, draw_order=-4.0)


def _borders(cells: NDArray[np.bool_]) -> list[list[tuple[float, float]]]:
    """The sides of cells beyond which the region ends, (x, y), a little inside of it."""
    around = np.pad(cells, 1)
    sides = {  # where the neighbour is, and from which to which corner of a cell the side goes
        (-1, 0): ((0, 0), (1, 0)),
        (1, 0): ((0, 1), (1, 1)),
        (0, -1): ((0, 0), (0, 1)),
        (0, 1): ((1, 0), (1, 1)),
    }
    strips = []
    for (down, right), corners in sides.items():
        height, width = cells.shape
        beyond = around[1 + down : 1 + down + height, 1 + right : 1 + right + width]
        inset = -_INSET_CELLS * right, -_INSET_CELLS * down
        for row_, col in np.argwhere(cells & ~beyond).tolist():
            strips.append(
                [(col + x + inset[0] + RIM_CELLS, row_ + y + inset[1] + RIM_CELLS) for x, y in corners]
            )
    return strips
