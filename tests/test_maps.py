"""Drawings and maps: what is read, and what is refused."""

import pytest

from cprl import Game, Map, Rules, maps

BOARDS_OF_THE_STUDY = {  # name: (height, width, sites, agents), from shared/paper/maps.txt
    "single_basic": (7, 24, 13, 1),
    "single_complex": (7, 24, 45, 1),
    "two_complex": (7, 24, 45, 2),
    "commons": (12, 24, 89, 4),
}


def test_agents_and_sites_are_numbered_in_reading_order():
    board = maps.parse(
        """
        ..A<
        ^#.A
        """
    )
    assert (board.height, board.width) == (2, 4)
    assert board.sites == ((0, 2), (1, 3))
    assert board.starts == ((0, 3, 3), (1, 0, 0))
    assert board.walls == ((1, 1),)


def test_a_map_draws_itself_as_it_was_read():
    drawing = ".>A.\nv##.\nA..^"
    assert maps.parse(drawing).drawing() == drawing


def test_starts_keep_the_order_given():
    board = Map(height=2, width=3, sites=[(0, 0)], starts=[(1, 2, 1), (1, 0, 3)])
    assert board.starts == ((1, 2, 1), (1, 0, 3))


@pytest.mark.parametrize(("name", "size"), BOARDS_OF_THE_STUDY.items())
def test_the_named_boards_have_the_published_sizes(name, size):
    board = maps.named(name)
    assert (board.height, board.width, len(board.sites), board.agents) == size


def test_commons_numbers_its_agents_as_the_published_program_does():
    assert maps.named("commons").starts == ((0, 1, 1), (2, 2, 2), (1, 3, 2), (0, 2, 1))


@pytest.mark.parametrize(
    ("drawing", "message"),
    [
        ("A.>\nA.", "row 1 ends after column 1, row 0 after column 2"),
        ("A.>\n.x.", "unknown sign 'x' at row 1, column 1"),
        ("A.>\n. .", "unknown sign ' ' at row 1, column 1"),
        ("...\n.>.", "no apple site .* row 1, column 2"),
        ("..A\n...", "no agent .* row 1, column 2"),
        ("", "empty"),
    ],
)
def test_a_bad_drawing_names_row_and_column(drawing, message):
    with pytest.raises(ValueError, match=message):
        maps.parse(drawing)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"starts": ((1, 1, 0), (1, 1, 2))}, "two starts at row 1, column 1"),
        ({"starts": ((1, 2, 0),)}, "start at row 1, column 2 is on a wall"),
        ({"sites": ((1, 2),)}, "site at row 1, column 2 is on a wall"),
        ({"sites": ((0, 0), (0, 0))}, "two sites at row 0, column 0"),
        ({"starts": ((0, 3, 0),)}, "start at row 0, column 3 lies outside a board of 2 rows and 3 columns"),
        ({"starts": ((0, 0, 4),)}, "heading 4"),
        ({"starts": ()}, "starts is empty"),
        ({"sites": ()}, "sites is empty"),
        ({"height": 0}, "0 rows"),
    ],
)
def test_a_map_that_cannot_be_played_is_refused(changes, message):
    fields = {"height": 2, "width": 3, "sites": ((0, 0),), "starts": ((1, 1, 0),), "walls": ((1, 2),)}
    with pytest.raises(ValueError, match=message):
        Map(**{**fields, **changes})


def test_an_unknown_board_says_which_there_are():
    with pytest.raises(ValueError, match=r"'comons'.*single_basic, single_complex, two_complex, commons"):
        maps.named("comons")


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"may_fire": (True,)}, "may_fire has 1 entries; the map has 2 agents"),
        ({"freeze_steps": ((1,), (2,), (3,))}, "freeze_steps has 3 rows; the map has 2 agents"),
        ({"may_bite": ((True, True), (True, True))}, "may_bite is 2 x 2; the map has 2 agents and 1 sites"),
    ],
)
def test_rules_per_agent_must_fit_the_map(rules, message):
    with pytest.raises(ValueError, match=message):
        Game(map=maps.parse(">.A\n..<"), rules=Rules(**rules))
