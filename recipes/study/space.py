"""How do the board's size, its walls, and the density and distribution of its apples matter?

python recipes/study/space.py --jobs 2
"""

from dataclasses import replace
from typing import Literal

from base import EXPERIMENT

import cprl
from cprl import Map, maps

BOARD = EXPERIMENT.game.map
"""Commons, 12 x 24 with 89 sites."""
DENSITY = len(BOARD.sites) / (BOARD.height * BOARD.width)
CORNERS = ((0, 1, 1), (0, 22, 2), (11, 1, 0), (11, 22, 3))
"""A start in each quarter of `quarters`, moved with it."""


def scattered(times: float, clustering: float = 0.0) -> Map:
    """Return a random board of the size of commons with so many times its sites."""
    return maps.random(
        BOARD.height, BOARD.width, agents=4, density=times * DENSITY, clustering=clustering, seed=0
    )


def boards(copies: int) -> Map:
    """Return commons and its copies one below the other; the agents start in the first."""
    tops = range(0, BOARD.height * copies, BOARD.height)
    sites = tuple((top + row, col) for top in tops for row, col in BOARD.sites)
    return replace(BOARD, height=BOARD.height * copies, sites=sites)


def half() -> Map:
    """Return the left half of commons, with its starts."""
    width = BOARD.width // 2
    return replace(BOARD, width=width, sites=tuple(site for site in BOARD.sites if site[1] < width))


def quarters(between: Literal["ground", "doors", "walls"]) -> Map:
    """Return the quarters of commons apart by a row and a column, with an agent in each.

    Args:
        between: what lies there: open ground, walls with a door in each of the four, or walls.
    """
    row = BOARD.height // 2
    col = BOARD.width // 2

    def moved(cell: tuple[int, ...]) -> tuple[int, ...]:
        return cell[0] + (cell[0] >= row), cell[1] + (cell[1] >= col), *cell[2:]

    lines = {(row, at) for at in range(BOARD.width + 1)} | {(at, col) for at in range(BOARD.height + 1)}
    openings = {(row, col // 2), (row, col + 1 + col // 2), (row // 2, col), (row + 1 + row // 2, col)}
    walls = {"ground": set(), "doors": lines - openings, "walls": lines}[between]
    return Map(
        height=BOARD.height + 1,
        width=BOARD.width + 1,
        sites=tuple(moved(site) for site in BOARD.sites),
        starts=tuple(moved(start) for start in CORNERS),
        walls=tuple(sorted(walls)),
    )


STUDY = cprl.Study(
    EXPERIMENT,
    conditions={
        name: {"game.map": board} if board else {}
        for name, board in {
            "commons": None,
            "half the apples, scattered": scattered(0.5),
            "as many apples, scattered": scattered(1),
            "twice the apples, scattered": scattered(2),
            "as many apples, in patches": scattered(1, 0.95),
            "half the board": half(),
            "twice the board": boards(2),
            "four times the board": boards(4),
            "quarters, open": quarters("ground"),
            "quarters, walls with a door": quarters("doors"),
            "quarters, walls": quarters("walls"),
        }.items()
    },
    name="space",
    question="How do the size of the board, barriers, and density and distribution of apples matter?",
    expectation=(
        "Apples regrow by their neighbours: twice the apples on the same ground give more than twice the "
        "harvest and may end the tragedy, half of them less than half. The same number in patches lives "
        "longer than scattered, since a patch regrows from within. A larger board with the same four agents "
        "lasts longer, and its harvest rises less than its apples, since agents strip what they see first; "
        "half a board dies sooner. Walls without a door make four private boards: each agent still strips "
        "its own, as a learner alone does in experiment 1 at first, so the harvest is above the open "
        "quarters and below a half of the best known; one door in each wall is between, nearer to open."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
