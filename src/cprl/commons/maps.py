"""Boards: a Map is drawn (`parse`, `read`), known by name (`named`), or generated (`crosses`, `rooms`,
`random`).

A drawing is rows of signs: `A` an apple site, `.` open ground, `#` an inner wall, `P` a spawn place, `~` and
`H` a river's water and waste, `> ^ < v` an agent with its heading. Drawings of others are read by their own
signs, see `LEGENDS`. Everything outside the board is wall.
"""

from bisect import bisect_left, insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from inspect import cleandoc
from math import isqrt
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np

from cprl.commons.headings import DOWN, LEFT, RIGHT, UP
from cprl.values import Natural, PositiveShare, Range, Seed, Share, Value, Where, checked, refusal
from cprl.values.arrays import Bool

Cell = tuple[int, int]
Start = tuple[int, int, int]

SIGN_OF_HEADING: Final = {UP: "^", RIGHT: ">", DOWN: "v", LEFT: "<"}
HEADING_OF_SIGN: Final = {sign: heading for heading, sign in SIGN_OF_HEADING.items()}
SITE, GROUND, WALL, SPAWN, WATER, WASTE = "A", ".", "#", "P", "~", "H"

Meaning = Literal["site", "ground", "wall", "spawn", "water", "waste", "up", "right", "down", "left"]
"""What a sign stands for: a cell, of the river with or without waste, or an agent's start with its
heading."""
_HEADINGS: Final = {"up": UP, "right": RIGHT, "down": DOWN, "left": LEFT}
_SPACES: Final[dict[str, Meaning]] = {"A": "site", " ": "ground", "P": "spawn"}
LEGENDS: Final[dict[str, dict[str, Meaning]]] = {
    "cprl": {
        **{SITE: "site", GROUND: "ground", WALL: "wall", SPAWN: "spawn", WATER: "water", WASTE: "waste"},
        **{"^": "up", ">": "right", "v": "down", "<": "left"},
    },
    "melting_pot": {**_SPACES, "W": "wall", "Q": "up", "I": "ground"},
    "ssd": {**_SPACES, "@": "wall"},
    "ssd_cleanup": {**_SPACES, "@": "wall", "B": "site", "S": "ground", "R": "water", "H": "waste"},
    "socialjax": {**_SPACES, "W": "wall", "Q": "up"},
}
"""The signs of drawings by name: our own; Melting Pot's commons_harvest, whose tiles `I` of hidden rewards
are ground here; sequential_social_dilemma_games' harvest, and its cleanup, whose stream `S` is ground here;
SocialJax' harvest."""

LONGEST_SIDE_CELLS: Final = 10_000
LARGEST_BOARD_CELLS: Final = 2**20
"""The largest number of cells: on a board this large, tables and working memory take some 100 MB."""
Side = Annotated[int, Range(1, LONGEST_SIDE_CELLS)]


@dataclass(frozen=True, kw_only=True)
class Map(Value):
    """A board with its walls, its apple sites and the starts of the agents. Every cell outside it is wall."""

    height: Side
    """The number of rows H; H x W is at most 2**20."""
    width: Side
    """The number of columns W."""
    sites: Annotated[tuple[Cell, ...], Where(lambda sites: len(sites) > 0, "at least one (row, column)")]
    """(row, col) of each of the K sites, the cells that can hold an apple; all do when an episode begins."""
    starts: Annotated[
        tuple[Start, ...],
        Where(
            lambda starts: len(starts) > 0 and all(heading in SIGN_OF_HEADING for *_, heading in starts),
            "at least one (row, column, heading), each heading 0 to 3",
        ),
    ]
    """(row, col, heading) of each of the N agents, agent 0 first; heading 0 up, 1 right, 2 down, 3 left."""
    walls: tuple[Cell, ...] = ()
    """(row, col) of each inner wall."""
    spawns: tuple[Cell, ...] = ()
    """(row, col) of each spawn place: agents whose start is one of them begin each episode at another one,
    drawn by chance, no two at the same; agents with another start begin there."""

    river: tuple[Cell, ...] = ()
    """(row, col) of each of the R cells of a river, which can have waste, see `Rules.pollution_prob`; agents
    walk over them."""
    waste: tuple[Natural, ...] = ()
    """The indices of the river's cells that have waste when an episode begins."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(index >= len(self.river) for index in self.waste):
            raise refusal("Map.waste", self.waste, f"indices of Map.river, which has {len(self.river)} cells")
        if len(set(self.waste)) < len(self.waste):
            raise refusal("Map.waste", self.waste, "each cell once")
        check_cells("Map", self.height, self.width)
        _check_cells(self)

    def __repr__(self) -> str:
        return f"Map({self.height} x {self.width}, {len(self.sites)} sites, {self.agents} agents)"

    def _repr_html_(self) -> str:
        """Return the board as SVG, for notebooks; the game knows nothing of pictures."""
        return import_module("cprl.pictures.svg").board_svg(self)

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return len(self.starts)

    def drawing(self) -> str:
        """Return the board as a drawing for `parse`. An agent hides a site or spawn place on its cell; its
        index is not shown."""
        signs = [[GROUND] * self.width for _ in range(self.height)]
        for row, col in self.sites:
            signs[row][col] = SITE
        for row, col in self.spawns:
            signs[row][col] = SPAWN
        for index, (row, col) in enumerate(self.river):
            signs[row][col] = WASTE if index in self.waste else WATER
        for row, col in self.walls:
            signs[row][col] = WALL
        for row, col, heading in self.starts:
            signs[row][col] = SIGN_OF_HEADING[heading]
        return "\n".join("".join(row) for row in signs)


def check_cells(name: str, height: int, width: int) -> None:
    if height * width > LARGEST_BOARD_CELLS:
        raise ValueError(
            f"{name} has {height:,} x {width:,} = {height * width:,} cells; allowed: at most "
            f"{LARGEST_BOARD_CELLS:,}"
        )


def _check_cells(board: Map) -> None:
    """Raise a ValueError for a cell outside the board, on a wall, or named twice, and a site on a river."""
    walls, river = set(board.walls), set(board.river)
    starts = [(row, col) for row, col, _ in board.starts]
    kinds = {
        "site": board.sites,
        "start": starts,
        "spawn place": board.spawns,
        "river": board.river,
        "wall": board.walls,
    }
    for name, cells in kinds.items():
        seen: set[Cell] = set()
        for row, col in cells:
            problem = ""
            if not (0 <= row < board.height and 0 <= col < board.width):
                problem = (
                    f"lies outside the board of {board.height} rows and {board.width} columns; allowed: rows "
                    f"0 to {board.height - 1}, columns 0 to {board.width - 1}"
                )
            elif (row, col) in seen:
                problem = "is there twice; allowed: one per cell"
            elif name != "wall" and (row, col) in walls:
                problem = "is on a wall; allowed: open ground"
            elif name == "site" and (row, col) in river:
                problem = "is on the river; allowed: ground"
            if problem:
                raise ValueError(f"the {name} at row {row}, column {col} {problem}")
            seen.add((row, col))


def parse(drawing: str, *, legend: str | Mapping[str, Meaning] = "cprl", agents: int | None = None) -> Map:
    """Read a drawing of any size.

    Agents are numbered in reading order, rows and columns from 0; agents that are not drawn start at spawn
    places, in reading order, and look up. Empty lines around the drawing are ignored, and common indentation
    is if no sign is a space.

    Args:
        legend: one of `LEGENDS`, or what each sign means.
        agents: the number of agents N; None for as many as are drawn.
    """
    signs = LEGENDS[checked("legend", legend, Literal[tuple(LEGENDS)])] if isinstance(legend, str) else legend
    for sign, meaning in signs.items():
        checked(f"legend[{sign!r}]", meaning, Meaning)
    rows = _rows(drawing, signs)
    cells = [(r, c, signs[sign]) for r, row in enumerate(rows) for c, sign in enumerate(row)]

    def places(kind: Meaning) -> tuple[Cell, ...]:
        return tuple((r, c) for r, c, meaning in cells if meaning == kind)

    starts = [(r, c, _HEADINGS[meaning]) for r, c, meaning in cells if meaning in _HEADINGS]
    spawns, drawn = places("spawn"), len(starts)
    river = [cell for cell in cells if cell[2] in ("water", "waste")]
    if agents is None and not starts and spawns:
        raise refusal("agents", agents, f"1 to {len(spawns)}: the drawing has spawn places, and no agent")
    if agents is not None:
        starts += [(*spawn, UP) for spawn in spawns]
        starts = starts[: checked("agents", agents, Annotated[int, Range(1, max(1, drawn + len(spawns)))])]
    return Map(
        height=len(rows),
        width=len(rows[0]),
        sites=places("site"),
        starts=tuple(starts),
        walls=places("wall"),
        spawns=spawns,
        river=tuple((r, c) for r, c, meaning in river),
        waste=tuple(index for index, (*_, meaning) in enumerate(river) if meaning == "waste"),
    )


def read(path: str | Path, *, legend: str | Mapping[str, Meaning] = "cprl", agents: int | None = None) -> Map:
    """Read a drawing from a file in UTF-8, see `parse`."""
    if Path(path).stat().st_size > _LARGEST_DRAWING_BYTES:
        raise ValueError(f"{path} has more than {_LARGEST_DRAWING_BYTES:,} bytes; allowed: a drawing")
    try:
        return parse(Path(path).read_text(encoding="utf-8-sig"), legend=legend, agents=agents)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


_LARGEST_DRAWING_BYTES: Final = 10_000_000


def _rows(drawing: str, signs: Mapping[str, Meaning]) -> list[str]:
    """Return the rows of a drawing, all of them of the same length."""
    if " " in signs:
        lines = drawing.splitlines()
        full = [number for number, line in enumerate(lines) if line.strip()]
        lines = lines[full[0] : full[-1] + 1] if full else []
        width = max(map(len, lines), default=0)
        rows = [line.ljust(width) for line in lines]
    else:
        rows = [row.rstrip() for row in cleandoc(drawing).splitlines()]
    if not rows:
        raise ValueError("the drawing is empty; allowed: at least one row of signs")
    for r, row in enumerate(rows):
        for c, sign in enumerate(row):
            if sign not in signs:
                known = " ".join("space" if known == " " else known for known in signs)
                raise ValueError(f"unknown sign {sign!r} at row {r}, column {c}; allowed: {known}")
        if len(row) != len(rows[0]):
            raise ValueError(
                f"row {r} ends after column {len(row) - 1}, row 0 after column {len(rows[0]) - 1}; "
                "all rows of a drawing must have the same length"
            )
    return rows


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
    "commons": ((0, 1, RIGHT), (2, 2, DOWN), (1, 3, DOWN), (0, 2, RIGHT))
}
"""Starts of boards on which the published program does not number its agents in reading order."""

NAMES: Final = tuple(_DRAWINGS)
"""The four published boards, after [W]."""


def named(name: str) -> Map:
    """Return a published board, by its name in `NAMES`."""
    checked("name", name, Literal[NAMES])
    board = parse(_DRAWINGS[name])
    starts = _NUMBERED_STARTS.get(name, board.starts)
    return replace(board, starts=starts)


def with_agents(board: Map, agents: int) -> Map:
    """Return a board with its first starts, or with more of them: at spawn places, in their order, and then
    on the free ground nearest to the first start.

    Further agents look the way of the last one. Ground is free where no wall, site, spawn place or start is;
    of two cells equally near, the one that is read first comes first.
    """
    checked("agents", agents, Annotated[int, Range(1, LARGEST_BOARD_CELLS)])
    begun = {(row, col) for row, col, _ in board.starts}
    taken = {*board.sites, *board.walls, *board.spawns, *begun}
    cells = [(row, col) for row in range(board.height) for col in range(board.width)]
    top, left, _ = board.starts[0]
    free = [cell for cell in cells if cell not in taken]
    free.sort(key=lambda cell: abs(cell[0] - top) + abs(cell[1] - left))
    free = [*(spawn for spawn in board.spawns if spawn not in begun), *free]
    if agents > board.agents + len(free):
        allowed = f"at most {board.agents + len(free)} on this board, whose other cells are walls and sites"
        raise refusal("agents", agents, allowed)
    heading = board.starts[-1][2]
    further = [(row, col, heading) for row, col in free[: max(0, agents - board.agents)]]
    return replace(board, starts=(*board.starts[:agents], *further))


Entrances = Literal["single", "multiple", "none", "unequal"]

_ROOMS: Final = """
    ..A....A....A....A....A.#...#.A....A....A....A....A..
    .AAA..AAA..AAA..AAA..AAAo...#AAA..AAA..AAA..AAA..AAA.
    ..A....A....A....A....A.#...#.A....A....A....A....A..
    ......v...v...v.........#...o.........v...v...v......
    .....A....A....A....A...#...#...A....A....A....A.....
    ....AAA..AAA..AAA..AAA#.#...###AAA..AAA..AAA..AAA....
    .....A....A....A....A.#.#.......A....A....A....A.....
    #o######o##############.#...############o#######o####
    .....................................................
    .....................................................
    .....................................................
    ####o#######o############...#.##############o######o#
    .....A....A....A....A.......#.#.A....A....A....A.....
    ....AAA..AAA..AAA..AAA###...#.#AAA..AAA..AAA..AAA....
    .....A....A....A....A...#...#...A....A....A....A.....
    ......^...^...^.........o...#.........^...^...^......
    ..A....A....A....A....A.#...#.A....A....A....A....A..
    .AAA..AAA..AAA..AAA..AAA#...oAAA..AAA..AAA..AAA..AAA.
    ..A....A....A....A....A.#...#.A....A....A....A....A..
"""
"""The board of `rooms`; "o" is a wall, but open under "multiple"."""

_CLOSE_ROOM: Final = """
    ..A...A...A...A...A.....
    .AAA.AAA.AAA.AAA.AAA....
    ..A.A.A.A.A.A.A.A.A.....
    ...AAAvAAAvAAAvAAA......
    ....A...A...A...A.......
    ......................#.
    ......................#.
"""
"""The north-west room under "unequal"."""

ROOM_NAMES: Final = ("north-west", "north-east", "south-east", "south-west")
_ROOM_SLICES: Final = tuple(
    (slice(*rows), slice(*columns))
    for rows, columns in (((0, 7), (0, 24)), ((0, 7), (29, 53)), ((12, 19), (29, 53)), ((12, 19), (0, 24)))
)
"""Rows and columns of each room; all else is corridor or wall."""


def crosses(
    *, height: int, width: int, centres: Iterable[Cell], starts: Iterable[Start], walls: Iterable[Cell] = ()
) -> Map:
    """Return a board whose sites form crosses: each centre and its four neighbours.

    Args:
        centres: (row, col) of the centre of each cross; a cell in two crosses is one site.
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
    """
    checked("entrances", entrances, Entrances)
    agents = checked("agents", agents, Annotated[int, Range(1, 12)])
    rows = _ROOMS.split()
    if entrances == "unequal":
        close = _CLOSE_ROOM.split()
        rows[: len(close)] = [west + row[len(west) :] for west, row in zip(close, rows, strict=False)]
    board = parse("\n".join(rows).replace("o", GROUND if entrances == "multiple" else WALL))
    north, south = board.starts[:6], board.starts[6:]
    starts = [start for n in range(3) for start in (north[n], north[-1 - n], south[-1 - n], south[n])]
    walls = () if entrances == "none" else board.walls
    return replace(board, starts=tuple(starts[:agents]), walls=walls)


def room_cells() -> Bool:
    """Return the cells of each room of `rooms`, bool [4, 19, 53], in the order of `ROOM_NAMES`.

    Those of the corridor are in no room. They are the same without walls. Agent i begins in room i % 4.
    """
    cells = np.zeros((len(_ROOM_SLICES), 19, 53), np.bool_)
    for room, (rows, columns) in enumerate(_ROOM_SLICES):
        cells[room, rows, columns] = True
    return cells


def random(
    height: int, width: int, *, agents: int, density: float, clustering: float = 0.0, seed: int = 0
) -> Map:
    """Return a board with random sites and no walls; agents start on random cells without a site.

    Sites are placed one by one: with probability `clustering` on a free cell next to an existing site,
    otherwise on any free cell. At 0 they are independent; near 1 they form a single patch.

    Args:
        density: Sites per cell, above 0, at most 1. The number of sites is density x H x W, rounded, at
            least 1.
    """
    height = checked("height", height, Side)
    width = checked("width", width, Side)
    check_cells("the board", height, width)
    agents = checked("agents", agents, Annotated[int, Range(1, LARGEST_BOARD_CELLS)])
    density = checked("density", density, PositiveShare)
    clustering = checked("clustering", clustering, Share)
    rng = np.random.default_rng(checked("seed", seed, Seed))
    cells = height * width
    count = max(1, round(density * cells))
    if count + agents > cells:
        raise ValueError(
            f"{count} sites and {agents} agents do not fit on {cells} cells; allowed: a lower density, or "
            "fewer agents"
        )
    free, beside = _Cells(cells, full=True), _Cells(cells)  # beside: free cells next to a site
    for _ in range(count):
        near = beside.count and rng.random() < clustering
        choices = beside if near else free
        cell = choices.at(int(rng.integers(choices.count)))
        free.discard(cell)
        beside.discard(cell)
        row, col = divmod(cell, width)
        for inside, neighbour in (
            (row > 0, cell - width),
            (row < height - 1, cell + width),
            (col > 0, cell - 1),
            (col < width - 1, cell + 1),
        ):
            if inside and free.has[neighbour]:
                beside.add(neighbour)
    places = np.flatnonzero(np.frombuffer(free.has, np.bool_))
    chosen = places[rng.choice(len(places), agents, replace=False)].tolist()
    starts = tuple((*divmod(cell, width), int(rng.integers(4))) for cell in chosen)
    sites = tuple(divmod(cell, width) for cell in range(cells) if not free.has[cell])
    return Map(height=height, width=width, sites=sites, starts=starts)


class _Cells:
    """A set of cells, 0 .. cells - 1, whose n-th smallest is quickly found on large boards too: ascending
    cells in blocks of about the square root of their largest number."""

    def __init__(self, cells: int, *, full: bool = False) -> None:
        self.has = bytearray([full]) * cells
        """By cell, whether it is in the set."""
        self.count = cells * full
        self._size = isqrt(cells) + 1
        firsts = range(0, cells, self._size)
        self._blocks = [list(range(cells)[first : first + self._size] if full else ()) for first in firsts]
        self._lengths = np.array(list(map(len, self._blocks)))

    def at(self, place: int) -> int:
        """Return the cell at a place in ascending order."""
        ends = self._lengths.cumsum()
        block = int(ends.searchsorted(place, side="right"))
        return self._blocks[block][place - int(ends[block])]

    def add(self, cell: int) -> None:
        if not self.has[cell]:
            insort(self._blocks[cell // self._size], cell)
            self._note(cell, 1)

    def discard(self, cell: int) -> None:
        if self.has[cell]:
            block = self._blocks[cell // self._size]
            del block[bisect_left(block, cell)]
            self._note(cell, -1)

    def _note(self, cell: int, more: int) -> None:
        self.has[cell] = more > 0
        self._lengths[cell // self._size] += more
        self.count += more
