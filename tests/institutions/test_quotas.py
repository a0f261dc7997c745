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


PATCHES = ">AA....A.<"
"""A patch of two sites, and one of a single site."""
FIELD, LATE = ">.AA.A\n.....<", "forward/stay"
NEXT, BOTH, NONE, FIRST = [0, 1], [1, 1], [0, 0], [1, 0]


@pytest.mark.parametrize(
    ("board", "limits", "rules", "turns", "harvests"),
    [
        # Four sites bear 4 x 1/2 = 2 apples a turn, so 1 for each of two agents; half of it in 2 turns is 1.
        # In turn 3 the apple is still there, and a new window begins.
        (
            BOARD,
            [Quota(share=0.5, window_steps=2)],
            SURE,
            "forward forward stay backward",
            [BOTH, NONE, BOTH, NONE],
        ),
        # 10 x 0.1 x 1 is 1 apple, although 0.1 cannot be held exactly; a share of 0 is none.
        (BOARD, [Quota(share=0.1, window_steps=10)], SURE, "forward", [BOTH]),
        (BOARD, [Quota(share=1, window_steps=1)], SURE, "forward", [BOTH]),
        (BOARD, [Quota(share=0)], SURE, "forward", [NONE]),
        # A share of 1 in 2 turns is 2 apples on a full board, and 1 in the window that begins with 2 of 4
        # sites full; an apple grew in turn 3 where one bites in turn 4, but the quota is used up.
        (
            BOARD,
            [Quota(share=1, window_steps=2, by_stock=True)],
            SURE,
            "forward forward backward forward",
            [BOTH, BOTH, BOTH, NONE],
        ),
        # Two quotas both hold, 1 apple in 2 turns and 1 in 4.
        (
            BOARD,
            [Quota(share=0.5, window_steps=2), Quota(share=0.25, window_steps=4)],
            SURE,
            "forward forward stay stay stay",
            [BOTH, NONE, NONE, NONE, BOTH],
        ),
        # Every third turn is closed; a season may be open or closed for ever.
        (
            FIELD,
            [ClosedSeason(period_steps=3, closed_steps=1)],
            {},
            f"stay {LATE} {LATE} stay",
            [NONE] * 3 + [FIRST],
        ),
        (BOARD, [ClosedSeason(period_steps=2, closed_steps=0)], {}, "forward forward", [BOTH, BOTH]),
        (BOARD, [ClosedSeason(period_steps=2, closed_steps=2)], {}, "forward forward", [NONE, NONE]),
        # A patch is closed in turns that begin with too few apples on it: from the start, after one bite, or
        # not any more, where the site in column 1 has grown in turn 2.
        (PATCHES, [ClosedPatches(below=2)], {}, "forward forward", [FIRST, NONE]),
        (PATCHES, [ClosedPatches(below=2)], SURE, f"forward stay {LATE}", [FIRST, NONE, FIRST]),
        # Turns 1 and 2 are agent 0's, turns 3 and 4 agent 1's, turn 5 is agent 0's again.
        (
            ">AAAAA.\n.AAAAA<",
            [Rotation(window_steps=2)],
            {},
            "forward forward forward forward forward",
            [FIRST, FIRST, NEXT, NEXT, FIRST],
        ),
    ],
)
def test_a_limit_without_a_fine_stops_bites_and_no_rule_is_broken(board, limits, rules, turns, harvests):
    play = Play(board, institutions=limits, **rules)
    for turn, harvest in zip(turns.split(), harvests, strict=True):
        before = play.output.stock[0, 0]
        assert play.turn(*turn.split("/")).harvest == harvest
        assert play.output.stock[0, 0] == before - sum(harvest) + play.output.regrown[0, 0]
        assert (play.fines, play.violated) == ([0, 0], [False, False])
    assert play.counts("excess_bites") == play.counts("closed_bites") == [0, 0]


def test_a_bite_in_a_closed_season_costs_its_fine():
    play = Play(FIELD, institutions=[ClosedSeason(period_steps=3, closed_steps=1, fine=0.5)])
    play.turn("stay").turn("forward", "stay").turn("forward", "stay")
    assert (play.harvest, play.fines, play.reward) == ([1, 0], [0.5, 0], [0.5, 0])
    assert play.violated == [True, False]
    assert play.counts("closed_bites") == [1, 0]
    assert play.turn("forward", "stay").fines == [0, 0]
    assert play.harvest == [1, 0]


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


def test_agents_see_whether_the_season_is_closed_and_until_when():
    play = Play(BOARD, institutions=[ClosedSeason(period_steps=4, closed_steps=1)])
    # Open for turns 1 to 3 of 4: 3/4, 2/4, 1/4 of a period until it closes, then 1/4 until it opens.
    seen = [play.shown(2)[0], *(play.turn("stay").shown(2)[0] for _ in range(4))]
    assert seen == [[0, 191], [0, 128], [0, 64], [255, 64], [0, 191]]


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


def test_a_bite_in_a_closed_patch_costs_its_fine():
    play = Play(PATCHES, institutions=[ClosedPatches(below=2, fine=3)])
    assert play.turn("forward").fines == [0, 0]
    play.turn("forward")
    # 1 - 3 = -2.
    assert (play.harvest, play.fines, play.reward) == ([1, 1], [3, 3], [-2, -2])
    assert play.counts("closed_bites") == [1, 1]
    assert play.violated == [True, True]


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
