"""Maps from drawings, and the named boards.

A drawing is rows of signs: `A` an apple site, `.` open ground, `#` an inner wall, `> ^ < v` an agent with its
heading. Everything outside the board is wall.
"""

from inspect import cleandoc
from itertools import chain
from typing import Final

from cprl.arguments import choice, object_of
from cprl.commons.maps.board import GROUND, HEADING_OF_SIGN, SITE, WALL, Map, Start
from cprl.commons.world import DOWN, RIGHT


def parse(drawing: str) -> Map:
    """Reads a drawing of any size; agents are numbered in reading order, rows and columns from 0.

    Common indentation and empty lines around the drawing are ignored.

    Raises:
        ValueError: If rows differ in length, a sign is unknown, or there is no site or no agent; the message
            names the row and column.
    """
    object_of("drawing", drawing, str, "text, a row of signs per line")
    rows = [row.rstrip() for row in cleandoc(drawing).splitlines()]
    if not rows:
        raise ValueError("the drawing is empty; allowed: at least one row of signs")
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
                raise ValueError(f"unknown sign {sign!r} at row {r}, column {c}; allowed: {known}")
        if len(row) != width:
            raise ValueError(
                f"row {r} ends after column {len(row) - 1}, row 0 after column {width - 1}; "
                "all rows of a drawing must have the same length"
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
"""Starts of boards on which the published program does not number its agents in reading order."""

NAMES: Final = tuple(_DRAWINGS)
"""The four published boards, after [W]."""


def named(name: str) -> Map:
    """A published board, by its name in `NAMES`.

    Raises:
        ValueError: If there is no board of this name.
    """
    choice("name", name, NAMES)
    board = parse(_DRAWINGS[name])
    starts = _NUMBERED_STARTS.get(name, board.starts)
    return Map(height=board.height, width=board.width, sites=board.sites, starts=starts, walls=board.walls)
