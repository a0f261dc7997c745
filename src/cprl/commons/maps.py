"""Drawings -> Map; the named boards.

A drawing is rows of signs: `A` an apple site, `.` open ground, `#` an inner wall, `> ^ < v` an agent and
its heading. Everything outside the board is wall.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from inspect import cleandoc
from itertools import chain
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


def parse(drawing: str) -> Map:
    """The Map of a drawing, of any size; agents are numbered in reading order, rows and columns from 0.

    Common indentation and empty lines around the drawing are left out.

    Raises:
        ValueError: names the row and column of a ragged row, an unknown sign, or what is missing.
    """
    rows = [row.rstrip() for row in cleandoc(drawing).splitlines()]
    if not rows:
        raise ValueError("the drawing is empty; at least one row of signs is wanted")
    _check_drawing(rows)
    cells = [(r, c, sign) for r, row in enumerate(rows) for c, sign in enumerate(row)]
    return Map(
        height=len(rows),
        width=len(rows[0]),
        sites=tuple((r, c) for r, c, sign in cells if sign == SITE),
        starts=tuple((r, c, HEADING_OF_SIGN[sign]) for r, c, sign in cells if sign in HEADING_OF_SIGN),
        walls=tuple((r, c) for r, c, sign in cells if sign == WALL),
    )


def _check_drawing(rows: list[str]) -> None:
    known = f"{SITE} {GROUND} {WALL} " + " ".join(HEADING_OF_SIGN)
    width = len(rows[0])
    for r, row in enumerate(rows):
        for c, sign in enumerate(row):
            if sign not in known or sign == " ":
                raise ValueError(f"unknown sign {sign!r} at row {r}, column {c}; known: {known}")
        if len(row) != width:
            raise ValueError(
                f"row {r} ends after column {len(row) - 1}, row 0 after column {width - 1}; "
                "all rows of a drawing must be equally long"
            )
    last = f"searched up to row {len(rows) - 1}, column {width - 1}"
    signs = set(chain.from_iterable(rows))
    if SITE not in signs:
        raise ValueError(f"no apple site ({SITE}) in the drawing; {last}")
    if not signs & set(HEADING_OF_SIGN):
        raise ValueError(f"no agent ({' '.join(HEADING_OF_SIGN)}) in the drawing; {last}")


_DRAWINGS: Final = {
    "single_basic": """
        ........................
        ...........A............
        ..........AAA...........
        .>.......AAAAA..........
        ..........AAA...........
        ...........A............
        ........................
    """,
    "single_complex": """
        ..A....A....A....A....A.
        .AAA..AAA..AAA..AAA..AAA
        ..A....A....A....A....A.
        .>......................
        ....A....A....A....A....
        ...AAA..AAA..AAA..AAA...
        ....A....A....A....A....
    """,
    "two_complex": """
        ..A....A....A....A....A.
        .AAA..AAA..AAA..AAA..AAA
        ..A....A....A....A....A.
        .>......................
        ....A....A....A....A....
        ...AAA..AAA..AAA..AAA..^
        ....A....A....A....A....
    """,
    "commons": """
        .>>.........A.........AA
        ...v....A...AA.........A
        ..v..A.AAA.........A....
        .A..AAA.A.......A.AAA...
        AAA..A.A....A..AAA.A..AA
        .A.A..AAA..AAA..A.A....A
        ..AAA..A....A.A..AAA....
        ...A.........AAA..A.....
        ..AAA....A....A.........
        ...A..A.AAA....A..A.AAA.
        ..A..AAA......A..AAA.A..
        ..AA..A......A.A..A.A...
    """,
}

_NUMBERED_STARTS: Final[dict[str, tuple[Start, ...]]] = {
    "commons": ((0, 1, RIGHT), (2, 2, DOWN), (1, 3, DOWN), (0, 2, RIGHT)),
}
"""Where the published program numbers its agents in another than the reading order."""

NAMES: Final = tuple(_DRAWINGS)
"""The four published boards, after [W]."""


def named(name: str) -> Map:
    """One of the published boards, by its name in `NAMES`."""
    if name not in _DRAWINGS:
        raise ValueError(f"no board is called {name!r}; there are {', '.join(NAMES)}")
    board = parse(_DRAWINGS[name])
    starts = _NUMBERED_STARTS.get(name, board.starts)
    return Map(height=board.height, width=board.width, sites=board.sites, starts=starts, walls=board.walls)
