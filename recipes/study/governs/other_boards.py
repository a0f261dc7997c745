"""Which boards differ from `commons` in size, walls, apples, or the agents that share them?"""

from dataclasses import replace
from typing import Final, Literal

from asking import GAME

from cprl import Map, maps

BOARD: Final = GAME.map
"""Commons, 12 x 24 with 89 sites."""
DENSITY: Final = len(BOARD.sites) / (BOARD.height * BOARD.width)
CORNERS: Final = ((0, 1, 1), (0, 22, 2), (11, 1, 0), (11, 22, 3))
"""A start in each quarter of `quarters`, moved with it."""


def scattered(times: float, clustering: float = 0.0) -> Map:
    """Return a random board of the size of commons with so many times its sites."""
    return maps.random(
        BOARD.height, BOARD.width, agents=4, density=times * DENSITY, clustering=clustering, seed=0
    )


def copies(number: int) -> Map:
    """Return commons and its copies one below the other; the agents start in the first."""
    tops = range(0, BOARD.height * number, BOARD.height)
    sites = tuple((top + row, col) for top in tops for row, col in BOARD.sites)
    return replace(BOARD, height=BOARD.height * number, sites=sites)


def half() -> Map:
    """Return the left half of commons, with its starts."""
    width = BOARD.width // 2
    return replace(BOARD, width=width, sites=tuple(site for site in BOARD.sites if site[1] < width))


def quarters(between: Literal["ground", "walls"]) -> Map:
    """Return the quarters of commons apart by a row and a column, with an agent in each.

    Args:
        between: what lies there.
    """
    row = BOARD.height // 2
    col = BOARD.width // 2

    def moved(cell: tuple[int, ...]) -> tuple[int, ...]:
        return cell[0] + (cell[0] >= row), cell[1] + (cell[1] >= col), *cell[2:]

    lines = {(row, at) for at in range(BOARD.width + 1)} | {(at, col) for at in range(BOARD.height + 1)}
    return Map(
        height=BOARD.height + 1,
        width=BOARD.width + 1,
        sites=tuple(moved(site) for site in BOARD.sites),
        starts=tuple(moved(start) for start in CORNERS),
        walls=tuple(sorted(lines)) if between == "walls" else (),
    )


def crowded(agents: int) -> Map:
    """Return the published board with the published agents, then those of the board turned by half, then
    those of its mirror image."""
    low = BOARD.height - 1
    right = BOARD.width - 1
    turned = [(low - row, right - col, (heading + 2) % 4) for row, col, heading in BOARD.starts]
    mirrored = [(low - row, col, 0) for row, col, _ in BOARD.starts]
    return replace(BOARD, starts=(*BOARD.starts, *turned, *mirrored)[:agents])
