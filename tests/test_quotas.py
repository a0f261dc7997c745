"""Quotas, closed seasons and patches, rotation: what is allowed when, and what the rest costs.

With `regrow_prob=(1.0,)` every site that begins a turn empty grows an apple in it: a site that is harvested
at once bears an apple every second turn, a yield of 1/2.
"""

import pytest
from boards import Play

from cprl import Observation, Rules, maps
from cprl.commons.near import patches, sites_around
from cprl.institutions import ClosedPatches, ClosedSeason, Quota, Rotation

BOARD = """
>AA..
..AA<
"""
SURE = {"regrow_prob": (1.0,)}


def test_a_quota_stops_what_is_above_it_until_the_next_window():
    # Four sites bear 4 x 1/2 = 2 apples a turn, so 1 for each of two agents; half of it in 2 turns is 1.
    play = Play(BOARD, institutions=[Quota(share=0.5, window_steps=2)], **SURE)
    assert play.turn("forward").harvest == [1, 1]
    assert play.turn("forward").harvest == [0, 0]
    assert not any(play.violated)
    assert play.turn("stay").harvest == [1, 1], "the apple is still there, and a new window begins"
    assert play.turn("backward").harvest == [0, 0]
    assert play.counts("excess_bites") == [0, 0]


def test_a_quota_with_a_fine_lets_bites_happen_and_charges_those_above_it():
    play = Play(BOARD, institutions=[Quota(share=0.5, window_steps=2, fine=2)], **SURE)
    assert play.turn("forward").fines == [0, 0]
    play.turn("forward", "stay")
    # 1 - 2 = -1.
    assert (play.harvest, play.fines, play.reward) == ([1, 0], [2, 0], [-1, 0])
    assert play.violated == [True, False]
    assert play.counts("excess_bites") == play.counts("violations") == [1, 0]
    assert play.turn("backward", "forward").fines == [0, 0], "in the next window"
    assert play.harvest == [1, 1]


def test_a_part_of_an_apple_is_none():
    # 0.9 x 1 apple in a window of 1 turn: nobody may harvest.
    with pytest.warns(UserWarning, match=r"window_steps is 1: .* 0\.9 apples at most, .* 2 turns"):
        play = Play(BOARD, institutions=[Quota(share=0.9, window_steps=1)], **SURE)
    assert play.turn("forward").harvest == [0, 0]
    play = Play(BOARD, institutions=[Quota(share=1, window_steps=1)], **SURE)
    assert play.turn("forward").harvest == [1, 1]
    assert Play(BOARD, institutions=[Quota(share=0)], **SURE).turn("forward").harvest == [0, 0]


def test_a_rounding_error_does_not_cost_an_apple():
    # 10 x 0.1 x 1 is 1 apple, although 0.1 cannot be held exactly.
    play = Play(BOARD, institutions=[Quota(share=0.1, window_steps=10)], **SURE)
    assert play.turn("forward").harvest == [1, 1]


def test_a_quota_by_stock_shrinks_with_the_stock_that_a_window_begins_with():
    # A share of 1 in 2 turns is 2 apples on a full board.
    play = Play(BOARD, institutions=[Quota(share=1, window_steps=2, by_stock=True)], **SURE)
    assert play.turn("forward").harvest == [1, 1]
    assert play.turn("forward").harvest == [1, 1]
    # (0, 1) and (1, 3) have grown again, the other two sites are empty: 2 of 4, so 1 apple.
    assert play.output.stock[0, 0] == 2
    assert play.turn("backward").harvest == [1, 1]
    assert play.turn("forward").harvest == [0, 0], "an apple grew there in turn 3, but the quota is used up"


def test_two_quotas_both_hold():
    # 1 apple in 2 turns, and 1 in 4 turns.
    quotas = [Quota(share=0.5, window_steps=2), Quota(share=0.25, window_steps=4)]
    play = Play(BOARD, institutions=quotas, **SURE)
    assert play.turn("forward").harvest == [1, 1]
    play.turn("forward")
    assert play.turn("stay").harvest == [0, 0], "a window of the first begins, not of the second"
    play.turn("stay")
    assert play.turn("stay").harvest == [1, 1]


def test_agents_see_what_is_left_of_their_quota_and_of_the_window():
    play = Play(BOARD, institutions=[Quota(share=1, window_steps=4)], **SURE)
    # 4 apples in 4 turns; 255 x 3/4 = 191.25.
    assert play.shown(2)[0] == [255, 255]
    assert play.turn("forward", "stay").shown(2) == [[191, 191], [255, 191]]
    assert play.shown(78)[1] == [255, 191] * 39, "the planes repeat them"
    play.turn("stay").turn("stay").turn("forward", "stay")
    assert play.shown(2)[0] == [255, 255], "what they see is of the coming turn, in a new window"


def test_what_is_shown_is_relative_to_the_largest_quota():
    play = Play(BOARD, institutions=[Quota(share=2, window_steps=1)], **SURE)
    # 2 apples, of which 1 is taken: 1/2 x 255 = 127.5.
    assert play.shown(2)[0] == [255, 255]
    stocked = Quota(share=1, window_steps=2, by_stock=True)
    play = Play(BOARD, institutions=[stocked], **SURE).turn("forward").turn("forward")
    assert play.shown(2)[0] == [128, 255], "half of the sites are empty, so half of the quota"


def test_a_closed_season_stops_bites_or_charges_them():
    # Turns 3, 6, 9, ... are closed.
    def at_turn_3(**fine):
        season = ClosedSeason(period_steps=3, closed_steps=1, **fine)
        play = Play(">.AA.A\n.....<", institutions=[season])
        assert play.turn("stay").turn("forward", "stay").harvest == [0, 0]
        return play.turn("forward", "stay")

    play = at_turn_3()
    assert (play.harvest, play.fines, play.violated) == ([0, 0], [0, 0], [False, False])
    assert play.turn("stay").harvest == [1, 0], "open again"
    play = at_turn_3(fine=0.5)
    assert (play.harvest, play.fines, play.reward) == ([1, 0], [0.5, 0], [0.5, 0])
    assert play.violated == [True, False]
    assert play.counts("closed_bites") == [1, 0]
    assert play.turn("forward", "stay").fines == [0, 0]
    assert play.harvest == [1, 0]


def test_agents_see_whether_the_season_is_closed_and_until_when():
    play = Play(BOARD, institutions=[ClosedSeason(period_steps=4, closed_steps=1)])
    # Open for turns 1 to 3 of 4: 3/4, 2/4, 1/4 of a period until it closes, then 1/4 until it opens.
    seen = [play.shown(2)[0], *(play.turn("stay").shown(2)[0] for _ in range(4))]
    assert seen == [[0, 191], [0, 128], [0, 64], [255, 64], [0, 191]]


@pytest.mark.parametrize(("closed", "harvest"), [(0, 1), (2, 0)])
def test_a_season_may_be_open_or_closed_for_ever(closed, harvest):
    season = ClosedSeason(period_steps=2, closed_steps=closed)
    play = Play(BOARD, institutions=[season])
    for _ in range(2):
        assert play.turn("forward").harvest == [harvest] * 2


def test_agents_take_turns_in_harvesting():
    # Windows of 2 turns: turns 1 and 2 are agent 0's, turns 3 and 4 agent 1's, turn 5 is agent 0's again.
    play = Play(">AAAAA.\n.AAAAA<", institutions=[Rotation(window_steps=2)])
    assert [play.turn("forward").harvest for _ in range(5)] == [[1, 0], [1, 0], [0, 1], [0, 1], [1, 0]]
    assert play.board == "...AA>.\n.<..AA."
    assert not any(play.violated)


def test_a_bite_in_the_window_of_another_costs_its_fine():
    play = Play(">AAA.\n.AAA<", institutions=[Rotation(window_steps=1, fine=1.5)])
    assert play.turn("forward").fines == [0, 1.5]
    # 1 - 1.5 = -0.5.
    assert play.turn("forward").reward == [-0.5, 1]
    assert (play.violated, play.counts("closed_bites")) == ([True, False], [1, 1])


def test_agents_see_whether_they_may_harvest_in_the_coming_turn_and_what_is_left_of_the_window():
    play = Play(BOARD, institutions=[Rotation(window_steps=2)])
    # Before turns 1, 2, 3: a whole window of agent 0 is left, half of it, a whole one of agent 1.
    seen = [play.shown(2), *(play.turn("stay").shown(2) for _ in range(2))]
    assert seen == [[[255, 255], [0, 255]], [[255, 128], [0, 128]], [[0, 255], [255, 255]]]
    assert play.again().shown(2) == [[255, 255], [0, 255]], "an episode begins with agent 0"


PATCHES = ">AA....A.<"


def test_a_patch_is_closed_in_turns_that_begin_with_too_few_apples_on_it():
    # The sites in columns 1 and 2 are a patch of 2, the one in column 7 a patch of 1.
    play = Play(PATCHES, institutions=[ClosedPatches(below=2)])
    assert play.turn("forward").harvest == [1, 0]
    assert play.turn("forward").harvest == [0, 0], "both patches hold one apple"
    assert play.output.stock[0, 0] == 2
    assert not any(play.violated)


def test_a_bite_in_a_closed_patch_costs_its_fine():
    play = Play(PATCHES, institutions=[ClosedPatches(below=2, fine=3)])
    assert play.turn("forward").fines == [0, 0]
    play.turn("forward")
    # 1 - 3 = -2.
    assert (play.harvest, play.fines, play.reward) == ([1, 1], [3, 3], [-2, -2])
    assert play.counts("closed_bites") == [1, 1]
    assert play.violated == [True, True]


def test_a_patch_that_grows_is_open_again():
    play = Play(PATCHES, institutions=[ClosedPatches(below=2)], **SURE)
    play.turn("forward").turn("stay")
    assert play.turn("forward", "stay").harvest == [1, 0], "the site in column 1 grew in turn 2"


def test_patches_are_sites_that_are_connected_by_being_near():
    board = maps.parse("A.A.A..A\n........\nA>......")
    # Columns 0, 2, 4 are each two cells apart, 7 is three from 4; (2, 0) is two below (0, 0).
    assert patches(sites_around(board, Rules())).tolist() == [0, 0, 0, 1, 0]
    assert patches(sites_around(board, Rules(regrow_radius_cells=1))).tolist() == [0, 1, 2, 3, 4]
    assert patches(sites_around(board, Rules(regrow_radius_cells=3))).tolist() == [0, 0, 0, 0, 0]


def test_quota_season_and_patch_break_one_rule_each_and_all_fines_are_due():
    fined = [Quota(share=0, fine=1), ClosedSeason(period_steps=1, closed_steps=1, fine=2)]
    play = Play(PATCHES, institutions=[*fined, ClosedPatches(below=9, fine=4)]).turn("forward")
    assert (play.fines, play.reward) == ([7, 0], [-6, 0])
    assert play.counts("excess_bites") == [1, 0]
    assert play.counts("closed_bites") == [2, 0], "once for the season, once for the patch"
    assert play.counts("violations") == [1, 0]


@pytest.mark.parametrize("encoding", ["rgb", "one_hot"])
def test_planes_hold_as_many_entries_as_needed_in_every_form_of_observation(encoding):
    # Nine quotas have 18 entries; a window of 3 x 3 cells holds 9 of them, so they take two planes.
    many = tuple(Quota(window_steps=9 + n) for n in range(9))
    rules = {"window_rows": 3, "window_columns": 3, **SURE}
    play = Play(BOARD, institutions=many, observation=Observation(encoding=encoding), **rules)
    assert play.game.channels == (*play.game.cell_channels, "institutions", "institutions")
    assert play.shown(18)[0] == [255] * 18
    # After a turn 8/9 of the first window is left, 9/10 of the second: 226.7, 229.5, ...
    times = [int(255 * (8 + n) / (9 + n) + 0.5) for n in range(9)]
    assert play.turn("stay").shown(18)[0][1::2] == times
