"""Drawings, maps and generated boards, and those on which nobody can harvest anything."""

import itertools
import pickle
import warnings
from dataclasses import replace

import pytest

from cprl import Game, Map, Rules, maps
from cprl.institutions import Boundaries, ClosedPatches, Quota

BOARDS_OF_THE_STUDY = {  # name: (height, width, sites, agents), from shared/paper/maps.txt
    "single_basic": (7, 24, 13, 1),
    "single_complex": (7, 24, 45, 1),
    "two_complex": (7, 24, 45, 2),
    "commons": (12, 24, 89, 4),
}


def test_agents_and_sites_are_numbered_in_reading_order_unless_they_are_given():
    board = maps.parse("..A<\n^#.A")
    assert (board.height, board.width) == (2, 4)
    assert board.sites == ((0, 2), (1, 3))
    assert board.starts == ((0, 3, 3), (1, 0, 0))
    assert board.walls == ((1, 1),)
    drawing = ".>A.\nv##.\nA<.^"
    assert maps.parse(drawing).drawing() == drawing
    given = Map(height=2, width=3, sites=[(0, 0)], starts=[(1, 2, 1), (1, 0, 3)])
    assert given.starts == ((1, 2, 1), (1, 0, 3))


@pytest.mark.parametrize(("name", "size"), BOARDS_OF_THE_STUDY.items())
def test_the_named_boards_have_the_published_sizes_and_numbers_of_agents(name, size):
    board = maps.published(name)
    assert (board.height, board.width, len(board.sites), board.agents) == size
    if name == "commons":
        assert board.starts == ((0, 1, 1), (2, 2, 2), (1, 3, 2), (0, 2, 1))


def board(**changes):
    fields = {"height": 2, "width": 3, "sites": ((0, 0),), "starts": ((1, 1, 0),), "walls": ((1, 2),)}
    return Map(**{**fields, **changes})


def scattered(**changes):
    return maps.random(**{"height": 3, "width": 4, "agents": 2, "density": 0.5, **changes})


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (maps.parse, {"drawing": "A.>\nA."}, "row 1 ends after column 1, row 0 after column 2"),
        (maps.parse, {"drawing": "A.>\n.x."}, "unknown sign 'x' at row 1, column 1"),
        (maps.parse, {"drawing": "A.>\n. ."}, "unknown sign ' ' at row 1, column 1"),
        (maps.parse, {"drawing": "...\n.>."}, "Map.sites"),
        (maps.parse, {"drawing": "..A\n..."}, "Map.starts"),
        (maps.parse, {"drawing": ""}, "the drawing is empty"),
        (maps.published, {"name": "comons"}, "'comons'; allowed: 'single_basic', .*'commons'"),
        (board, {"starts": ((1, 1, 0), (1, 1, 2))}, "start at row 1, column 1 is there twice"),
        (board, {"starts": ((1, 2, 0),)}, "start at row 1, column 2 is on a wall"),
        (board, {"sites": ((1, 2),)}, "site at row 1, column 2 is on a wall"),
        (board, {"sites": ((0, 0), (0, 0))}, "site at row 0, column 0 is there twice"),
        (board, {"sites": ((0, 1),), "river": ((0, 1),)}, "site at row 0, column 1 is on the river"),
        (board, {"river": ((0, 1),), "waste": (0, 0)}, "Map.waste"),
        (board, {"starts": ((0, 3, 0),)}, "start at row 0, column 3 lies outside the board"),
        (board, {"starts": ((0, 0, 4),)}, "Map.starts"),
        (board, {"starts": ()}, "Map.starts"),
        (board, {"height": 0}, "Map.height"),
        (maps.rooms, {"entrances": "two"}, "entrances"),
        (maps.rooms, {"agents": 0}, "agents is 0"),
        (maps.rooms, {"agents": 13}, "agents is 13"),
        (scattered, {"height": 0}, "height is 0"),
        (scattered, {"agents": 0}, "agents is 0"),
        (scattered, {"density": 0}, "density is 0"),
        (scattered, {"density": 1.5}, "density is 1.5"),
        (scattered, {"clustering": -0.1}, "clustering"),
        (scattered, {"density": 1}, "12 sites and 2 agents do not fit on 12 cells"),
    ],
)
def test_a_board_that_cannot_be_is_refused_with_the_place_of_what_is_wrong(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_a_drawing_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / "board.txt").write_text("A.>", encoding="utf-8-sig")
    assert maps.read_file(tmp_path / "board.txt") == maps.parse("A.>")


WALLS_BY_ROW = {  # regions.md, after Perolat et al.: columns of wall, by row
    **dict.fromkeys(range(5), (24, 28)),
    5: [22, 24, 28, 29, 30],
    6: [22, 24],
    7: [*range(23), 24, *range(28, 53)],
    11: [*range(25), 28, *range(30, 53)],
    12: [28, 30],
    13: [22, 23, 24, 28, 30],
    **dict.fromkeys(range(14, 19), (24, 28)),
}
OPENINGS = [
    *[(1, 24), (3, 28), (7, 1), (7, 8), (7, 40), (7, 48)],
    *[(11, 4), (11, 12), (11, 44), (11, 51), (15, 24), (17, 28)],
]


def reached(board, start):
    """The cells that an agent can reach on foot."""
    walls, seen, waiting = set(board.walls), {start}, [start]
    while waiting:
        row, col = waiting.pop()
        for cell in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            inside = 0 <= cell[0] < board.height and 0 <= cell[1] < board.width
            if inside and cell not in walls and cell not in seen:
                seen.add(cell)
                waiting.append(cell)
    return seen


def test_the_rooms_have_the_walls_of_the_paper():
    single = {(row, col) for row, columns in WALLS_BY_ROW.items() for col in columns}
    assert len(single) == 132
    assert set(maps.rooms("single").walls) == set(maps.rooms("unequal").walls) == single
    assert set(maps.rooms("multiple").walls) == single - set(OPENINGS)
    assert len(maps.rooms("multiple").walls) == 120
    assert maps.rooms("none").walls == ()


@pytest.mark.parametrize("entrances", ["single", "multiple", "none", "unequal"])
def test_every_room_has_45_sites_3_agents_and_a_way_out(entrances):
    board = maps.rooms(entrances)
    assert (board.height, board.width, board.agents, len(board.sites)) == (19, 53, 12, 180)
    assert len(reached(board, (9, 26))) == 19 * 53 - len(board.walls)
    for rows in (range(7), range(12, 19)):
        for columns in (range(24), range(29, 53)):
            assert sum(row in rows and col in columns for row, col in board.sites) == 45
            assert sum(row in rows and col in columns for row, col, _ in board.starts) == 3
    assert not {start[:2] for start in board.starts} & set(board.sites)
    assert maps.parse(board.drawing()).sites == board.sites


def test_all_boards_of_rooms_but_unequal_are_symmetric_under_half_a_turn():
    for entrances in ("single", "multiple", "none"):
        board = maps.rooms(entrances)
        for cells in (board.sites, board.walls, [start[:2] for start in board.starts]):
            assert {(18 - row, 52 - col) for row, col in cells} == set(cells)


def test_the_cells_of_a_room_hold_its_apples_and_its_agents_and_no_corridor():
    cells = maps.room_cells()
    four = maps.rooms(agents=4).starts
    assert all(cells[room][start[:2]] for room, start in enumerate(four)), "fewer agents are spread"
    assert cells.shape == (len(maps.ROOM_NAMES), 19, 53)
    assert cells.sum((1, 2)).tolist() == [7 * 24] * 4
    assert cells.any(0).sum() == 4 * 7 * 24, "no cell is in two rooms"
    assert not cells[:, 8:11].any()
    assert not cells[:, :, 25:28].any()
    for entrances in ("single", "unequal"):
        board = maps.rooms(entrances)
        for room in range(4):
            assert sum(cells[room][site] for site in board.sites) == 45
        assert all(cells[agent % 4][start[:2]] for agent, start in enumerate(board.starts))
    assert [room for room in range(4) if cells[room, 3, 6]] == [maps.ROOM_NAMES.index("north-west")]


def test_crosses_are_centres_with_their_four_neighbours():
    board = maps.crosses(height=4, width=6, centres=[(1, 1), (2, 2)], starts=[(3, 5, 3)], walls=[(0, 5)])
    assert board.drawing() == ".A...#\nAAA...\n.AAA..\n..A..<"
    with pytest.raises(ValueError, match="the site at row -1, column 3 lies outside"):
        maps.crosses(height=4, width=6, centres=[(0, 3)], starts=[(3, 5, 3)])


def test_a_random_board_has_the_size_density_and_agents_asked_for():
    board = maps.random(20, 40, agents=12, density=246 / 800, clustering=0.7, seed=4)
    assert (board.height, board.width, board.agents, len(board.sites)) == (20, 40, 12, 246)
    assert not {start[:2] for start in board.starts} & set(board.sites)
    assert board == maps.random(20, 40, agents=12, density=246 / 800, clustering=0.7, seed=4)
    assert board != maps.random(20, 40, agents=12, density=246 / 800, clustering=0.7, seed=5)


def test_more_clustering_puts_sites_closer_together():
    def mean_neighbours(clustering):
        board = maps.random(15, 31, agents=1, density=0.2, clustering=clustering, seed=1)
        sites = set(board.sites)
        return sum((r + 1, c) in sites or (r, c + 1) in sites for r, c in sites) / len(sites)

    loose, middle, tight = map(mean_neighbours, (0, 0.6, 1))
    assert loose < middle < tight
    patch = maps.random(15, 31, agents=1, density=0.2, clustering=1, seed=1)
    ground = set(itertools.product(range(15), range(31))) - set(patch.sites)
    alone = Map(height=15, width=31, sites=patch.sites, starts=((*patch.sites[0], 0),), walls=tuple(ground))
    assert reached(alone, patch.sites[0]) == set(patch.sites), "one patch"


PARTED = """
    ..A..#....
    .AAA.#.>..
    ..A..#..<.
"""
WARNING = r"can harvest any of the 5 sites of Game\.map: walls keep .* all starts \(row 1, column 7; row 2"


def game(drawing, *institutions, **rules):
    return Game(map=maps.parse(drawing), rules=Rules(**rules), institutions=institutions)


def without_a_warning(drawing, *institutions, **rules):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert game(drawing, *institutions, **rules).map == maps.parse(drawing)


def test_one_is_warned_of_a_wall_between_all_agents_and_all_apples():
    with pytest.warns(UserWarning, match=WARNING) as told:
        parted = game(PARTED)
    assert len(told) == 1
    assert told[0].filename == __file__, "it points to where the game is made"
    with pytest.warns(UserWarning, match=WARNING):
        replace(parted, rules=Rules(freeze_steps=3))
    with warnings.catch_warnings():  # one that is sent to another process does not warn again
        warnings.simplefilter("error")
        assert pickle.loads(pickle.dumps(parted)) == parted


def test_a_gap_or_one_agent_is_enough_but_no_corner_and_agents_are_no_walls():
    without_a_warning("..A..#....\n.AAA...>..\n..A..#..<.")
    without_a_warning("..A..#....\n.AAA.#.>..\n..A.<#....")
    with pytest.warns(UserWarning, match="can harvest any of the 1 sites"):
        game("A.#.\n.#..\n#..<")
    without_a_warning("A<<", Boundaries.drawn("1.."))


def test_boundaries_that_stop_bites_are_reckoned_with_and_fines_are_not():
    board, regions = "A.#.A\n>.#.<", "11#00\n11#00"
    with pytest.warns(UserWarning, match="of the 2 sites of Game.map: walls and Boundaries keep"):
        game(board, Boundaries.drawn(regions, owners=("0", "1#")))
    without_a_warning(board, Boundaries.drawn(regions, owners=("0", "1#")), shuffle_starts=True)
    without_a_warning(board, Boundaries.drawn(regions, owners=("0", "1#"), bite_fine=1.0), Quota(share=0.5))
    without_a_warning(board, Boundaries.drawn(regions, owners=("1", "0#")))
    with pytest.warns(UserWarning, match="of the 1 sites"):
        game("A..>", Boundaries.drawn("-..."))


def test_one_is_warned_of_patches_that_never_open():
    with pytest.warns(UserWarning, match=r"ClosedPatches\.below is 3") as told:
        game("AA....A.>", ClosedPatches(below=3))
    assert told[0].filename == __file__
    without_a_warning("AA....A.>", ClosedPatches(below=2))
    without_a_warning("AA....A.>", ClosedPatches(below=3, fine=1.0))
