"""Generated boards: crosses of sites, rooms with walls, and random boards."""

from collections.abc import Iterable, Sequence
from typing import Final, Literal, get_args

import numpy as np

from cprl.commons.maps.board import Cell, Map, Start
from cprl.commons.world import DOWN, UP

Entrances = Literal["single", "multiple", "none", "unequal"]

ROOMS_HEIGHT: Final = 19
ROOMS_WIDTH: Final = 53

_FAR_CENTRES: Final = (2, 7, 12, 17, 22, 30, 35, 40, 45, 50)
_NEAR_CENTRES: Final = (5, 10, 15, 20, 32, 37, 42, 47)
_CENTRES: Final = (
    *((row, col) for row in (1, 17) for col in _FAR_CENTRES),
    *((row, col) for row in (5, 13) for col in _NEAR_CENTRES),
)
_CLOSE_CENTRES: Final = (*((1, col) for col in (2, 6, 10, 14, 18)), *((3, col) for col in (4, 8, 12, 16)))
"""Centres of the crosses in the north-west room of the unequal board."""

_NORTH_WALLS: Final[dict[Sequence[int], tuple[Sequence[int], ...]]] = {
    range(5): ((24, 28),),
    (5,): ((22, 24), range(28, 31)),
    (6,): ((22, 24),),
    (7,): (range(23), (24,), range(28, 53)),
}
"""Columns of wall by rows of the upper half; the lower half is the upper one rotated by 180 degrees."""

_OPENINGS: Final = ((1, 24), (3, 28), (7, 1), (7, 8), (7, 40), (7, 48))
"""Openings in the walls of the upper half under "multiple"; the lower half likewise."""

_NORTH_STARTS: Final = ((3, 6), (3, 46), (3, 10), (3, 42), (3, 14), (3, 38))


def crosses(
    *,
    height: int,
    width: int,
    centres: Iterable[Cell],
    starts: Iterable[Start],
    walls: Iterable[Cell] = (),
) -> Map:
    """A board whose sites form crosses: each centre and its four neighbours.

    Args:
        height: The number of rows H.
        width: The number of columns W.
        centres: (row, col) of the centre of each cross; a cell in two crosses is one site.
        starts: (row, col, heading) of each agent.
        walls: (row, col) of each inner wall.

    Raises:
        ValueError: If a site or start lies outside the board or on a wall; the message names row and column.
    """
    sites = {
        (row + down, col + right)
        for row, col in centres
        for down, right in ((0, 0), (-1, 0), (0, 1), (1, 0), (0, -1))
    }
    return Map(
        height=height, width=width, sites=tuple(sorted(sites)), starts=tuple(starts), walls=tuple(walls)
    )


def rooms(entrances: Entrances = "single", *, agents: int = 12) -> Map:
    """Four rooms around a plus-shaped corridor, 19 x 53, after Perolat et al. (2017).

    There are 36 crosses with 180 sites. "single" gives each room one entrance with a bend, "multiple"
    several; "none" removes all walls; "unequal" is "single" with the crosses of the north-west room closer
    together.
    The starts are ours: up to three agents per room, assigned in turn to the north-west, north-east,
    south-east and south-west room.

    Args:
        entrances: The board: "single", "multiple", "none" or "unequal".
        agents: The number of agents N, 1 to 12.

    Raises:
        ValueError: If `entrances` or `agents` is not allowed.
    """
    if entrances not in get_args(Entrances):
        raise ValueError(f"entrances is {entrances!r}; allowed: {', '.join(get_args(Entrances))}")
    if not 1 <= agents <= 2 * len(_NORTH_STARTS):
        raise ValueError(f"agents is {agents}; allowed: 1 to {2 * len(_NORTH_STARTS)}")
    centres: tuple[Cell, ...] = _CENTRES
    if entrances == "unequal":
        in_corner = {(row, col) for row, col in _CENTRES if row < 7 and col < 24}
        centres = (*_CLOSE_CENTRES, *(cell for cell in _CENTRES if cell not in in_corner))
    return crosses(
        height=ROOMS_HEIGHT,
        width=ROOMS_WIDTH,
        centres=centres,
        starts=_room_starts()[:agents],
        walls=_room_walls(entrances),
    )


def _turned(cell: Cell) -> Cell:
    """The position of a cell after the board is rotated by 180 degrees."""
    return ROOMS_HEIGHT - 1 - cell[0], ROOMS_WIDTH - 1 - cell[1]


def _room_walls(entrances: Entrances) -> list[Cell]:
    if entrances == "none":
        return []
    north = {
        (row, col)
        for rows, columns in _NORTH_WALLS.items()
        for row in rows
        for some in columns
        for col in some
    }
    if entrances == "multiple":
        north -= set(_OPENINGS)
    return sorted(north | set(map(_turned, north)))


def _room_starts() -> list[Start]:
    """The starts of all 12 agents, facing the corridor."""
    starts: list[Start] = []
    for west, east in zip(_NORTH_STARTS[::2], _NORTH_STARTS[1::2], strict=True):
        north = [(*cell, DOWN) for cell in (west, east)]
        starts += [*north, *((*_turned(cell), UP) for cell in (west, east))]
    return starts


def random(
    height: int, width: int, *, agents: int, density: float, clustering: float = 0.0, seed: int = 0
) -> Map:
    """A board with random sites and no walls; agents start on random cells without a site.

    Sites are placed one by one: with probability `clustering` on a free cell next to an existing site,
    otherwise on any free cell. At 0 they are independent; near 1 they form a single patch.

    Args:
        height: The number of rows H, at least 1.
        width: The number of columns W, at least 1.
        agents: The number of agents N, at least 1.
        density: Sites per cell, above 0, at most 1. The number of sites is density x H x W, rounded, at
            least 1.
        clustering: A probability, 0..1.
        seed: The seed of the random numbers.

    Raises:
        ValueError: If an argument is out of range, or sites and agents do not fit on the board.
    """
    _check_random(height, width, agents, density, clustering)
    rng = np.random.default_rng(seed)
    cells = [(row, col) for row in range(height) for col in range(width)]
    count = max(1, round(density * len(cells)))
    if count + agents > len(cells):
        raise ValueError(
            f"{count} sites and {agents} agents do not fit on {len(cells)} cells; lower density or agents"
        )
    free, beside, sites = set(cells), set[Cell](), set[Cell]()
    while len(sites) < count:
        near = beside and rng.random() < clustering
        choices = sorted(beside if near else free)
        row, col = choices[rng.integers(len(choices))]
        sites.add((row, col))
        free.discard((row, col))
        beside |= {(row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)}
        beside &= free
    places = sorted(free)
    chosen = rng.choice(len(places), agents, replace=False)
    starts = [(*places[at], int(rng.integers(4))) for at in chosen]
    return Map(height=height, width=width, sites=tuple(sorted(sites)), starts=tuple(starts))


def _check_random(height: int, width: int, agents: int, density: float, clustering: float) -> None:
    for name, number in (("height", height), ("width", width), ("agents", agents)):
        if number < 1:
            raise ValueError(f"{name} is {number}; allowed: an integer >= 1")
    if not 0 < density <= 1:
        raise ValueError(f"density is {density}; allowed: above 0, at most 1")
    if not 0 <= clustering <= 1:
        raise ValueError(f"clustering is {clustering}; allowed: 0..1")
