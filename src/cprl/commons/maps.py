"""Boards: draw a Map (`parse`, `read_file`), name one (`published`), or generate one (`crosses`, `rooms`,
`random`).

A drawing has one line per row and one sign per cell: `A` is an apple site, `.` open ground, `#` an inner
wall, `P` a spawn place, `~` a river's water, `H` its waste, and `> ^ < v` an agent with its heading. Drawings
of other libraries are read by their own signs, see `LEGENDS`. All cells outside the board are wall.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np

from cprl.commons.headings import DOWN, LEFT, RIGHT, UP
from cprl.values import Natural, PositiveShare, Range, Seed, Share, Value, Where, checked, refusal
from cprl.values.array_types import Bool

Cell = tuple[int, int]
"""(row, col), counted from 0 at the top left."""
Start = tuple[int, int, int]
"""(row, col, heading) where an agent begins; headings as in `cprl.commons.headings`."""

Meaning = Literal["site", "ground", "wall", "spawn", "water", "waste", "up", "right", "down", "left"]
"""The meaning of a sign: a kind of cell, or an agent's start with its heading. "water" and "waste" are cells
of a river without and with waste."""
SIGN_OF: Final[dict[Meaning, str]] = {
    **{"site": "A", "ground": ".", "wall": "#", "spawn": "P", "water": "~", "waste": "H"},
    **{"up": "^", "right": ">", "down": "v", "left": "<"},
}
_HEADINGS: Final[dict[Meaning, int]] = {"up": UP, "right": RIGHT, "down": DOWN, "left": LEFT}
SIGN_OF_HEADING: Final = {heading: SIGN_OF[name] for name, heading in _HEADINGS.items()}
_SHARED_SIGNS: Final[dict[str, Meaning]] = {"A": "site", " ": "ground", "P": "spawn"}
"""The signs that drawings of all other libraries share."""
LEGENDS: Final[dict[str, dict[str, Meaning]]] = {
    "cprl": {sign: meaning for meaning, sign in SIGN_OF.items()},
    "melting_pot": {**_SHARED_SIGNS, "W": "wall", "Q": "up", "I": "ground"},
    "ssd": {**_SHARED_SIGNS, "@": "wall"},
    "ssd_cleanup": {**_SHARED_SIGNS, "@": "wall", "B": "site", "S": "ground", "R": "water", "H": "waste"},
    "socialjax": {**_SHARED_SIGNS, "W": "wall", "Q": "up"},
}
"""The signs of drawings, by name: those of cprl; of Melting Pot's commons_harvest, whose tiles `I` of hidden
rewards are ground here; of harvest and of cleanup in sequential_social_dilemma_games, where the stream `S` is
ground here; and of SocialJax' harvest."""

LONGEST_SIDE_CELLS: Final = 10_000
LARGEST_BOARD_CELLS: Final = 2**20
"""The largest number of cells. Tables and working memory of such a board take some 100 MB."""
Side = Annotated[int, Range(1, LONGEST_SIDE_CELLS)]


@dataclass(frozen=True, kw_only=True)
class Map(Value):
    """A board: its size, walls and apple sites, and where agents start. All cells outside it are wall."""

    height: Side
    """The number of rows H; H x W is at most 2**20."""
    width: Side
    """The number of columns W."""
    sites: Annotated[tuple[Cell, ...], Where(lambda sites: len(sites) > 0, "at least one (row, column)")]
    """(row, col) of each of the K sites, the cells that can hold an apple."""
    starts: Annotated[
        tuple[Start, ...],
        Where(
            lambda starts: len(starts) > 0 and all(heading in SIGN_OF_HEADING for *_, heading in starts),
            "at least one (row, column, heading), each heading 0 to 3",
        ),
    ]
    """(row, col, heading) where each of the N agents starts, agent 0 first; heading 0 is up, 1 right, 2 down,
    3 left."""
    walls: tuple[Cell, ...] = ()
    """(row, col) of each inner wall."""
    spawns: tuple[Cell, ...] = ()
    """(row, col) of each spawn place. An agent whose start is a spawn place begins each episode at a spawn
    place drawn by chance, no two agents at the same; all other agents begin at their starts."""

    river: tuple[Cell, ...] = ()
    """(row, col) of each of the R cells of a river, which can have waste, see `cprl.commons.river.River`.
    Agents can walk over them."""
    waste: tuple[Natural, ...] = ()
    """The indices of the river's cells that have waste when an episode begins."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(index >= len(self.river) for index in self.waste):
            raise refusal("Map.waste", self.waste, f"indices of Map.river, which has {len(self.river)} cells")
        if len(set(self.waste)) < len(self.waste):
            raise refusal("Map.waste", self.waste, "each cell once")
        check_board_size("Map", self.height, self.width)
        _check_cells(self)

    def __repr__(self) -> str:
        return f"Map({self.height} x {self.width}, {len(self.sites)} sites, {self.agents} agents)"

    def _repr_html_(self) -> str:
        """Return a picture of the board, for notebooks; the game knows nothing of pictures."""
        return import_module("cprl.pictures.image").board_html(self)

    @property
    def agents(self) -> int:
        """Return the number of agents N."""
        return len(self.starts)

    def drawing(self) -> str:
        """Return the board as a drawing, which `parse` can read.

        An agent hides a site or spawn place on its cell, and its index is not shown.
        """
        signs = [[SIGN_OF["ground"]] * self.width for _ in range(self.height)]
        for row, col in self.sites:
            signs[row][col] = SIGN_OF["site"]
        for row, col in self.spawns:
            signs[row][col] = SIGN_OF["spawn"]
        for index, (row, col) in enumerate(self.river):
            signs[row][col] = SIGN_OF["waste"] if index in self.waste else SIGN_OF["water"]
        for row, col in self.walls:
            signs[row][col] = SIGN_OF["wall"]
        for row, col, heading in self.starts:
            signs[row][col] = SIGN_OF_HEADING[heading]
        return "\n".join("".join(row) for row in signs)


def check_board_size(name: str, height: int, width: int) -> None:
    """Refuse a board with too many cells; `name` stands for the board in the message."""
    if height * width > LARGEST_BOARD_CELLS:
        raise ValueError(
            f"{name} has {height:,} x {width:,} = {height * width:,} cells; allowed: at most "
            f"{LARGEST_BOARD_CELLS:,}"
        )


def _check_cells(board: Map) -> None:
    """Raise a ValueError for a cell that is outside the board, on a wall or listed twice, or a site on a
    river."""
    cells_by_kind = {
        "site": board.sites,
        "start": [(row, col) for row, col, _ in board.starts],
        "spawn place": board.spawns,
        "river": board.river,
        "wall": board.walls,
    }
    walls = set(board.walls)
    river = set(board.river)
    for kind, cells in cells_by_kind.items():
        earlier_cells: set[Cell] = set()
        for cell in cells:
            problem = _cell_problem(board, kind, cell, earlier_cells, walls, river)
            if problem:
                raise ValueError(f"the {kind} at row {cell[0]}, column {cell[1]} {problem}")
            earlier_cells.add(cell)


def _cell_problem(
    board: Map, kind: str, cell: Cell, earlier_cells: set[Cell], walls: set[Cell], river: set[Cell]
) -> str:
    """Return why a site, start, wall or the like cannot be on a cell, and what is allowed; "" if it can.

    `earlier_cells`: the cells before it of the same kind. `walls` and `river`: those of the board, as sets,
    since tuples are slow to search.
    """
    row, col = cell
    if not (0 <= row < board.height and 0 <= col < board.width):
        return (
            f"lies outside the board of {board.height} rows and {board.width} columns; allowed: rows "
            f"0 to {board.height - 1}, columns 0 to {board.width - 1}"
        )
    if cell in earlier_cells:
        return "is there twice; allowed: one per cell"
    if kind != "wall" and cell in walls:
        return "is on a wall; allowed: open ground"
    if kind == "site" and cell in river:
        return "is on the river; allowed: ground"
    return ""


def parse(drawing: str, *, legend: str | Mapping[str, Meaning] = "cprl", agents: int | None = None) -> Map:
    """Read a map from a drawing, see the top of this module; `parse("A.\\n>.")` has one site and one agent.

    Agents are numbered in reading order. Agents that are not drawn start at spawn places, in reading order,
    and head up. Empty lines around the drawing are ignored; so is common indentation, unless a space is one
    of the signs.

    Args:
        drawing: the drawing, of any size.
        legend: the meaning of each sign, or the name of a legend in `LEGENDS`.
        agents: the number of agents N; None for as many as are drawn.

    Raises:
        ValueError: for unknown signs, rows of different lengths, or a board that `Map` refuses.
    """
    signs = LEGENDS[checked("legend", legend, Literal[tuple(LEGENDS)])] if isinstance(legend, str) else legend
    for sign, meaning in signs.items():
        checked(f"legend[{sign!r}]", meaning, Meaning)
    rows = _rows(drawing, signs)
    meanings = {(row, col): signs[sign] for row, line in enumerate(rows) for col, sign in enumerate(line)}
    drawn_starts = [(*cell, _HEADINGS[meaning]) for cell, meaning in meanings.items() if meaning in _HEADINGS]
    spawns = _cells_with(meanings, "spawn")
    river = _cells_with(meanings, "water", "waste")
    return Map(
        height=len(rows),
        width=len(rows[0]),
        sites=_cells_with(meanings, "site"),
        starts=_starts_of_agents(drawn_starts, spawns, agents),
        walls=_cells_with(meanings, "wall"),
        spawns=spawns,
        river=river,
        waste=tuple(index for index, cell in enumerate(river) if meanings[cell] == "waste"),
    )


def _cells_with(meanings: Mapping[Cell, Meaning], *wanted: Meaning) -> tuple[Cell, ...]:
    """Return the cells of a drawing that have one of these meanings, in reading order."""
    return tuple(cell for cell, meaning in meanings.items() if meaning in wanted)


def _starts_of_agents(
    drawn_starts: list[Start], spawns: tuple[Cell, ...], agents: int | None
) -> tuple[Start, ...]:
    """Return the starts of N agents: first the drawn ones, then spawn places, where agents head up."""
    if agents is None and not drawn_starts and spawns:
        raise refusal("agents", agents, f"1 to {len(spawns)}: the drawing has spawn places, and no agent")
    if agents is None:
        return tuple(drawn_starts)
    starts = [*drawn_starts, *((*spawn, UP) for spawn in spawns)]
    return tuple(starts[: checked("agents", agents, Annotated[int, Range(1, max(1, len(starts)))])])


def read_file(
    path: str | Path, *, legend: str | Mapping[str, Meaning] = "cprl", agents: int | None = None
) -> Map:
    """Read a map from a file with a drawing, in UTF-8; arguments and errors are those of `parse`."""
    if Path(path).stat().st_size > _LARGEST_DRAWING_BYTES:
        raise ValueError(f"{path} has more than {_LARGEST_DRAWING_BYTES:,} bytes; allowed: a drawing")
    try:
        return parse(Path(path).read_text(encoding="utf-8-sig"), legend=legend, agents=agents)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


_LARGEST_DRAWING_BYTES: Final = 10_000_000


def _rows(drawing: str, signs: Mapping[str, Meaning]) -> list[str]:
    """Return the rows of a drawing, all of the same length; raise a ValueError for an unknown sign."""
    if " " in signs:
        lines = drawing.splitlines()
        filled = [number for number, line in enumerate(lines) if line.strip()]
        lines = lines[filled[0] : filled[-1] + 1] if filled else []
        width = max(map(len, lines), default=0)
        rows = [line.ljust(width) for line in lines]
    else:
        rows = [row.rstrip() for row in cleandoc(drawing).splitlines()]
    if not rows:
        raise ValueError("the drawing is empty; allowed: at least one row of signs")
    for row, line in enumerate(rows):
        for col, sign in enumerate(line):
            if sign not in signs:
                allowed = " ".join("space" if known == " " else known for known in signs)
                raise ValueError(f"unknown sign {sign!r} at row {row}, column {col}; allowed: {allowed}")
        if len(line) != len(rows[0]):
            raise ValueError(
                f"row {row} ends after column {len(line) - 1}, row 0 after column {len(rows[0]) - 1}; "
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
"""The starts on boards where the published program does not number its agents in reading order."""

NAMES: Final = tuple(_DRAWINGS)
"""The names of the four boards that Wiatrak (2019) published."""


def published(name: str) -> Map:
    """Return a published board by its name, one of `NAMES`."""
    checked("name", name, Literal[NAMES])
    board = parse(_DRAWINGS[name])
    starts = _NUMBERED_STARTS.get(name, board.starts)
    return replace(board, starts=starts)


def with_agents(board: Map, agents: int) -> Map:
    """Return the board with starts for another number of agents; refuse more than fit on it.

    For fewer agents the first starts are kept. Further agents start at the free spawn places, in their order,
    and then on the free ground nearest to the first start, with the heading of the last start. Ground is free
    where no wall, site, spawn place or start is; among cells equally near, reading order decides.
    """
    checked("agents", agents, Annotated[int, Range(1, LARGEST_BOARD_CELLS)])
    start_cells = {(row, col) for row, col, _ in board.starts}
    taken = {*board.sites, *board.walls, *board.spawns, *start_cells}
    cells = [(row, col) for row in range(board.height) for col in range(board.width)]
    first_row, first_col, _ = board.starts[0]
    free_ground = [cell for cell in cells if cell not in taken]
    free_ground.sort(key=lambda cell: abs(cell[0] - first_row) + abs(cell[1] - first_col))
    free_spawns = [spawn for spawn in board.spawns if spawn not in start_cells]
    free_cells = [*free_spawns, *free_ground]
    most_agents = board.agents + len(free_cells)
    if agents > most_agents:
        allowed = f"at most {most_agents} on this board, whose other cells are walls and sites"
        raise refusal("agents", agents, allowed)
    heading = board.starts[-1][2]
    added = [(row, col, heading) for row, col in free_cells[: max(0, agents - board.agents)]]
    return replace(board, starts=(*board.starts[:agents], *added))


Entrances = Literal["single", "multiple", "none", "unequal"]
"""The kinds of entrances that the rooms of `rooms` can have."""

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
"""The drawing of `rooms`, with walls at "o" that are open ground under "multiple"."""

_CLOSE_ROOM: Final = """
    ..A...A...A...A...A.....
    .AAA.AAA.AAA.AAA.AAA....
    ..A.A.A.A.A.A.A.A.A.....
    ...AAAvAAAvAAAvAAA......
    ....A...A...A...A.......
    ......................#.
    ......................#.
"""
"""The drawing of the north-west room under "unequal"."""

ROOM_NAMES: Final = ("north-west", "north-east", "south-east", "south-west")
_ROOM_SLICES: Final = tuple(
    (slice(*rows), slice(*columns))
    for rows, columns in (((0, 7), (0, 24)), ((0, 7), (29, 53)), ((12, 19), (29, 53)), ((12, 19), (0, 24)))
)
"""The rows and columns of each room, in the order of `ROOM_NAMES`; all other cells are corridor or wall."""
_ROOM_STARTS: Final = (0, 5, 11, 6, 1, 4, 10, 7, 2, 3, 9, 8)
"""For each agent the index of its start in `_ROOMS`, in reading order: agents fill the rooms in turn."""


def crosses(
    *, height: int, width: int, centres: Iterable[Cell], starts: Iterable[Start], walls: Iterable[Cell] = ()
) -> Map:
    """Return a board whose sites form crosses, each of a centre and its four neighbours.

    Args:
        height: the number of rows.
        width: the number of columns.
        centres: (row, col) of the centre of each cross; a cell in two crosses is one site.
        starts: (row, col, heading) where each agent starts.
        walls: (row, col) of each inner wall.
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
    """Return a board of four rooms around a plus-shaped corridor, 19 x 53, after Perolat et al. (2017).

    It has 36 crosses with 180 sites. The starts are chosen by cprl: up to three agents per room, assigned in
    turn to the north-west, north-east, south-east and south-west room.

    Args:
        entrances: "single" gives each room one entrance with a bend, "multiple" several, and "none" removes
            all walls. "unequal" is "single" with the crosses of the north-west room closer together.
        agents: the number of agents, at most 12.
    """
    checked("entrances", entrances, Entrances)
    agents = checked("agents", agents, Annotated[int, Range(1, 12)])
    rows = _ROOMS.split()
    if entrances == "unequal":
        close_rows = _CLOSE_ROOM.split()
        rows[: len(close_rows)] = [
            room_row + row[len(room_row) :] for room_row, row in zip(close_rows, rows, strict=False)
        ]
    opening = SIGN_OF["ground"] if entrances == "multiple" else SIGN_OF["wall"]
    board = parse("\n".join(rows).replace("o", opening))
    walls = () if entrances == "none" else board.walls
    starts = tuple(board.starts[number] for number in _ROOM_STARTS[:agents])
    return replace(board, starts=starts, walls=walls)


def room_cells() -> Bool:
    """Return the cells of each room of `rooms`, bool [4, 19, 53], in the order of `ROOM_NAMES`.

    Cells of the corridor are in no room. The rooms have the same cells under all `entrances`, also without
    walls. Agent i starts in room i % 4.
    """
    cells = np.zeros((len(_ROOM_SLICES), 19, 53), np.bool_)
    for room, (rows, columns) in enumerate(_ROOM_SLICES):
        cells[room, rows, columns] = True
    return cells


def random(
    height: int, width: int, *, agents: int, density: float, clustering: float = 0.0, seed: int = 0
) -> Map:
    """Generate a board with random sites and without walls; agents start on random cells without a site.

    Args:
        height: the number of rows H.
        width: the number of columns W.
        agents: the number of agents N.
        density: the share of cells that are sites, above 0, at most 1. The number of sites is
            density x H x W, rounded, and at least 1.
        clustering: the probability with which a site is placed on a free cell next to an earlier site, and
            not on any free cell. At 0 sites are independent; near 1 they form a single patch.
        seed: the seed of the random numbers; equal arguments give equal boards.

    Raises:
        ValueError: for sizes or shares out of range, or more sites and agents than cells.
    """
    height = checked("height", height, Side)
    width = checked("width", width, Side)
    check_board_size("the board", height, width)
    agents = checked("agents", agents, Annotated[int, Range(1, LARGEST_BOARD_CELLS)])
    density = checked("density", density, PositiveShare)
    clustering = checked("clustering", clustering, Share)
    rng = np.random.default_rng(checked("seed", seed, Seed))
    cell_count = height * width
    site_count = max(1, round(density * cell_count))
    if site_count + agents > cell_count:
        raise ValueError(
            f"{site_count} sites and {agents} agents do not fit on {cell_count} cells; allowed: a lower "
            "density, or fewer agents"
        )
    is_free = _free_of_random_sites(height, width, site_count, clustering, rng)
    free_cells = np.argwhere(is_free)
    start_cells = free_cells[rng.choice(len(free_cells), agents, replace=False)].tolist()
    starts = tuple((row, col, int(rng.integers(4))) for row, col in start_cells)
    sites = tuple((row, col) for row, col in np.argwhere(~is_free).tolist())
    return Map(height=height, width=width, sites=sites, starts=starts)


def _free_of_random_sites(
    height: int, width: int, site_count: int, clustering: float, rng: np.random.Generator
) -> Bool:
    """Place random sites one by one, and return the cells without a site, bool [H, W]."""
    free = _CellSet(np.ones((height, width), np.bool_))
    free_beside_sites = _CellSet(np.zeros((height, width), np.bool_))
    for _ in range(site_count):
        is_clustered = free_beside_sites.count and rng.random() < clustering
        choices = free_beside_sites if is_clustered else free
        row, col = choices.find(int(rng.integers(choices.count)))
        free.remove(row, col)
        free_beside_sites.remove(row, col)
        for neighbour in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            is_on_board = 0 <= neighbour[0] < height and 0 <= neighbour[1] < width
            if is_on_board and free.contains[neighbour]:
                free_beside_sites.add(*neighbour)
    return free.contains


class _CellSet:
    """A set of cells that finds its n-th cell in reading order quickly, since it counts the cells of each
    row."""

    def __init__(self, contains: Bool) -> None:
        self.contains = contains
        """bool [H, W], True for the cells in the set."""
        self.count = int(contains.sum())
        """The number of cells in the set."""
        self._row_counts = contains.sum(1)

    def find(self, index: int) -> Cell:
        """Return the cell with this index in reading order."""
        ends = self._row_counts.cumsum()
        row = int(ends.searchsorted(index, side="right"))
        columns = np.flatnonzero(self.contains[row])
        # `index - ends[row]` is negative: it counts back from the last cell of the row.
        return row, int(columns[index - ends[row]])

    def add(self, row: int, col: int) -> None:
        """Put a cell into the set, where it may be already."""
        self._set(row, col, True)

    def remove(self, row: int, col: int) -> None:
        """Take a cell out of the set, where it may not be."""
        self._set(row, col, False)

    def _set(self, row: int, col: int, is_contained: bool) -> None:
        """Set whether a cell is in the set, and update the counts."""
        change = is_contained - int(self.contains[row, col])
        self.contains[row, col] = is_contained
        self._row_counts[row] += change
        self.count += change
