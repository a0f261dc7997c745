"""Map: a board, where walls and apple sites are, and where agents start."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from cprl.commons.world import DOWN, LEFT, RIGHT, UP

Cell = tuple[int, int]
Start = tuple[int, int, int]

SIGN_OF_HEADING: Final = {UP: "^", RIGHT: ">", DOWN: "v", LEFT: "<"}
HEADING_OF_SIGN: Final = {sign: heading for heading, sign in SIGN_OF_HEADING.items()}
SITE, GROUND, WALL = "A", ".", "#"


@dataclass(frozen=True, kw_only=True)
class Map:
    """A board: where walls and apple sites are, and where agents start.

    Raises:
        ValueError: names the row and column of what does not fit.
    """

    height: int
    """Rows H, at least 1."""
    width: int
    """Columns W, at least 1."""
    sites: tuple[Cell, ...]
    """(row, col) of each of the K cells where an apple can hang; full when an episode begins."""
    starts: tuple[Start, ...]
    """(row, col, heading) of each of the N agents, agent 0 first; heading 0 up, 1 right, 2 down, 3 left."""
    walls: tuple[Cell, ...] = ()
    """(row, col) of each inner wall."""

    def __post_init__(self) -> None:
        for name in ("sites", "starts", "walls"):
            cells = tuple(tuple(int(number) for number in cell) for cell in getattr(self, name))
            object.__setattr__(self, name, cells)
        _check_size(self)
        _check_cells(self)

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return len(self.starts)

    def drawing(self) -> str:
        """The board as `parse` reads it; agents are shown before sites, their numbers are not shown."""
        signs = [[GROUND] * self.width for _ in range(self.height)]
        for row, col in self.sites:
            signs[row][col] = SITE
        for row, col in self.walls:
            signs[row][col] = WALL
        for row, col, heading in self.starts:
            signs[row][col] = SIGN_OF_HEADING[heading]
        return "\n".join("".join(row) for row in signs)


def _check_size(board: Map) -> None:
    if board.height < 1 or board.width < 1:
        raise ValueError(f"a Map of {board.height} rows and {board.width} columns; both must be at least 1")
    for name, cells in (("sites", board.sites), ("starts", board.starts)):
        if not cells:
            raise ValueError(f"Map.{name} is empty; at least one is wanted")
    for row, col, heading in board.starts:
        if heading not in SIGN_OF_HEADING:
            raise ValueError(
                f"the start at row {row}, column {col} has heading {heading}; allowed: 0, 1, 2, 3"
            )


def _check_cells(board: Map) -> None:
    starts = [(row, col) for row, col, _ in board.starts]
    for name, cells in (("site", board.sites), ("start", starts), ("wall", board.walls)):
        for row, col in cells:
            if not (0 <= row < board.height and 0 <= col < board.width):
                raise ValueError(
                    f"the {name} at row {row}, column {col} lies outside a board of "
                    f"{board.height} rows and {board.width} columns"
                )
        for row, col in _twice(cells):
            raise ValueError(f"two {name}s at row {row}, column {col}; a cell has room for one")
    for name, cells in (("site", board.sites), ("start", starts)):
        for row, col in sorted(set(cells) & set(board.walls)):
            raise ValueError(f"the {name} at row {row}, column {col} is on a wall")


def _twice(cells: Iterable[Cell]) -> Iterable[Cell]:
    seen: set[Cell] = set()
    for cell in cells:
        if cell in seen:
            yield cell
        seen.add(cell)
