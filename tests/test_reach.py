"""A map on which no agent can harvest anything is legal, and one is warned of it."""

import pickle
import warnings
from dataclasses import replace

import pytest

from cprl import Game, Rules, maps
from cprl.institutions import Boundaries, Quota

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


def test_a_gap_in_the_wall_is_enough_and_so_is_one_agent_on_the_other_side():
    without_a_warning("..A..#....\n.AAA...>..\n..A..#..<.")
    without_a_warning("..A..#....\n.AAA.#.>..\n..A.<#....")


def test_nobody_passes_between_walls_that_touch_at_a_corner():
    with pytest.warns(UserWarning, match="can harvest any of the 1 sites"):
        game("A.#.\n.#..\n#..<")


def test_agents_are_no_walls_for_each_other():
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


def test_a_game_that_is_sent_to_another_process_does_not_warn_again():
    with pytest.warns(UserWarning, match=WARNING):
        parted = game(PARTED)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert pickle.loads(pickle.dumps(parted)) == parted
