"""Map: a board with its walls, its apple sites and the starts of the agents."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from cprl.arguments import as_integer, integer, listed, refusal
from cprl.commons.world import DOWN, LEFT, RIGHT, UP

Cell = tuple[int, int]
Start = tuple[int, int, int]

SIGN_OF_HEADING: Final = {UP: "^", RIGHT: ">", DOWN: "v", LEFT: "<"}
HEADING_OF_SIGN: Final = {sign: heading for heading, sign in SIGN_OF_HEADING.items()}
SITE, GROUND, WALL = "A", ".", "#"

LONGEST_SIDE_CELLS: Final = 10_000
LARGEST_BOARD_CELLS: Final = 2**20
"""The largest number of cells: on a board this large, tables and working memory take some 100 MB."""


@dataclass(frozen=True, kw_only=True)
class Map:
    """A board with its walls, its apple sites and the starts of the agents. Every cell outside it is wall.

    Raises:
        ValueError: If the board cannot be played; the message names the row and column.
    """

    height: int
    """The number of rows H, 1..10,000; H x W is at most 2**20."""
    width: int
    """The number of columns W, 1..10,000."""
    sites: tuple[Cell, ...]
    """(row, col) of each of the K sites, the cells that can hold an apple; all do when an episode begins."""
    starts: tuple[Start, ...]
    """(row, col, heading) of each of the N agents, agent 0 first; heading 0 up, 1 right, 2 down, 3 left."""
    walls: tuple[Cell, ...] = ()
    """(row, col) of each inner wall."""

    def __post_init__(self) -> None:
        for name in ("height", "width"):
            object.__setattr__(self, name, integer(f"Map.{name}", getattr(self, name), 1, LONGEST_SIDE_CELLS))
        check_cells("Map", self.height, self.width)
        for name in ("sites", "starts", "walls"):
            entry = CELL if name != "starts" else START
            cells = cells_of(f"Map.{name}", getattr(self, name), entry)
            object.__setattr__(self, name, cells)
        _check_entries(self)
        _check_cells(self)

    def __repr__(self) -> str:
        return f"Map({self.height} x {self.width}, {len(self.sites)} sites, {self.agents} agents)"

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return len(self.starts)

    def drawing(self) -> str:
        """The board as a drawing for `parse`. An agent hides a site on its cell; its index is not shown."""
        signs = [[GROUND] * self.width for _ in range(self.height)]
        for row, col in self.sites:
            signs[row][col] = SITE
        for row, col in self.walls:
            signs[row][col] = WALL
        for row, col, heading in self.starts:
            signs[row][col] = SIGN_OF_HEADING[heading]
        return "\n".join("".join(row) for row in signs)


CELL: Final = ("row", "col")
START: Final = ("row", "col", "heading")


def check_cells(name: str, height: int, width: int) -> None:
    """Checks the number of cells of a board.

    Raises:
        ValueError: If there are too many.
    """
    if height * width > LARGEST_BOARD_CELLS:
        raise ValueError(
            f"{name} has {height:,} x {width:,} = {height * width:,} cells; allowed: at most "
            f"{LARGEST_BOARD_CELLS:,}"
        )


def cells_of(name: str, entries: Any, form: tuple[str, ...] = CELL) -> tuple[Any, ...]:
    """Cells or starts as tuples of ints; nothing is rounded.

    Args:
        name: Their name in messages.
        entries: A sequence of them.
        form: What the numbers of an entry are.

    Raises:
        ValueError: If they are anything else; the message names the entry.
    """
    allowed = f"({', '.join(form)}), integers"
    if not isinstance(entries, type) and callable(getattr(entries, "tolist", None)):
        with suppress(NotImplementedError):  # of a tensor without data, which is refused below
            entries = entries.tolist()
    found = []
    for place, entry in enumerate(listed(name, entries, f"a sequence of {allowed} each")):
        numbers = tuple(map(as_integer, listed(f"{name}[{place}]", entry, allowed)))
        if len(numbers) != len(form) or None in numbers:
            raise refusal(f"{name}[{place}]", entry, allowed)
        found.append(numbers)
    return tuple(found)


def _check_entries(board: Map) -> None:
    for name, cells in (("sites", board.sites), ("starts", board.starts)):
        if not cells:
            raise ValueError(f"Map.{name} is empty; allowed: at least one entry")
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
                    f"the {name} at row {row}, column {col} lies outside the board of "
                    f"{board.height} rows and {board.width} columns; allowed: rows 0 to {board.height - 1}, "
                    f"columns 0 to {board.width - 1}"
                )
        for row, col in _duplicates(cells):
            raise ValueError(f"two {name}s at row {row}, column {col}; allowed: one per cell")
    for name, cells in (("site", board.sites), ("start", starts)):
        for row, col in sorted(set(cells) & set(board.walls)):
            raise ValueError(f"the {name} at row {row}, column {col} is on a wall; allowed: open ground")


def _duplicates(cells: Iterable[Cell]) -> Iterable[Cell]:
    seen: set[Cell] = set()
    for cell in cells:
        if cell in seen:
            yield cell
        seen.add(cell)
