"""What a turn does: moves and clashes, beams and time-outs, harvest and regrowth, and the end."""

from collections import Counter

import numpy as np
import pytest
from boards import Play, assert_same, copied, only_quirks

from cprl import Rules, maps
from cprl.commons.batch import Batch
from cprl.commons.near import distance, neighbours


def test_each_walk_is_relative_to_the_heading():
    board = """
        A......
        .......
        ...>...
        .......
    """
    ends = {"forward": (2, 4), "backward": (2, 2), "left": (1, 3), "right": (3, 3), "stay": (2, 3)}
    for action, place in ends.items():
        assert Play(board).turn(action).places == [place], action


def test_agents_begin_at_their_starts_or_at_a_random_permutation_of_them():
    board = "A>...\n.....\nv...<\n"
    orders, fixed = Counter(), Play(board)
    shuffled = Play(board, worlds=100, seed=4, shuffle_starts=True)
    alone = Batch(shuffled.game, 1, seed=4, first_world=37)
    starts = fixed.game.map.starts
    for episode in range(12):
        now = (shuffled if episode == 0 else shuffled.again()).batch.now
        for row, col, heading in zip(now.row, now.col, now.heading, strict=True):
            agents = zip(row, col, heading, strict=True)
            orders[tuple(starts.index(start) for start in agents)] += 1  # a place keeps its heading
        alone.begin()
        assert fixed.again().places == [start[:2] for start in starts]
    assert len(orders) == 6
    assert all(140 < count < 260 for count in orders.values()), orders
    assert (alone.now.row[0] == now.row[37]).all()
    assert (alone.now.col[0] == now.col[37]).all()


def test_turning_left_and_right_turns_the_heading_by_a_quarter():
    play = Play(".A.\n.^.")
    assert play.turn("turn_left").board == ".A.\n.<."
    assert play.turn("turn_right").turn("turn_right").board == ".A.\n.>."


@pytest.mark.parametrize("action", ["forward", "left", "backward"])
def test_edges_and_inner_walls_stop_a_move(action):
    assert Play("#A..\n>#..\n....").turn(action).places == [(1, 0)]


CLASHES = {
    "agents who want the same cell both stay": ("A......\n..>.<..", "A......\n..>.<.."),
    "an agent enters a cell that another leaves": ("A....\n.>>..", "A....\n..>>."),
    "two agents cannot swap cells": ("A...\n.><.", "A...\n.><."),
    "four in a ring all move": ("A....\n.>v..\n.^<..", "A....\n.^>..\n.<v.."),
    # The two on the right want the cell between them; each of the others wants the cell of the next.
    "a cancelled move cancels those behind it": ("A.......\n.>>>.<..", "A.......\n.>>>.<.."),
}


@pytest.mark.parametrize("rule", CLASHES)
def test_when_all_go_forward(rule):
    before, after = CLASHES[rule]
    assert Play(before).turn("forward").board == after
    assert Play("A....\n.>>..").turn("forward", "stay").places == [(1, 1), (1, 2)], "one keeps its cell"


def test_clashes_do_not_depend_on_agent_indices():
    drawing = "A.......\n.>>>.<..\n...^...."
    straight = Play(drawing).turn("forward").places
    order = [4, 2, 0, 3, 1]
    shuffled = Play(drawing, order=order).turn("forward").places
    assert shuffled == [straight[i] for i in order]


def test_as_run_a_pair_goes_back_even_onto_a_third_agent():
    # 0 follows 1; 1 and 2 want one cell. Pair (0, 1): no clash. Pair (1, 2): both go back, 1 onto 0.
    play = Play("A......\n.>>.<..", clashes="pairwise")
    assert play.turn("forward").places == [(1, 2), (1, 2), (1, 4)]


def test_a_tagged_agent_occupies_no_cell_and_waits_until_its_cell_is_free():
    board = "A.....\n.>.^.."
    play = Play(board, freeze_steps=2).turn("beam", "stay")
    assert play.in_play == [True, False]
    play.turn("forward", "forward").turn("forward", "forward")
    assert play.places == [(1, 3), (1, 3)], "agent 0 stands where agent 1 was tagged"
    assert play.in_play == [True, False], "agent 1 has served its time and waits"
    play.turn("stay", "forward")
    assert play.in_play == [True, False]
    play.turn("forward", "forward")
    assert play.in_play == [True, True], "the cell is free"
    assert play.turn("stay", "forward").places == [(1, 4), (0, 3)]


def test_agents_that_wait_for_one_cell_return_in_the_order_in_which_they_were_tagged():
    # 1 is tagged at (1, 3), then 2 comes there and is tagged too; the freeze of 1 is the longer wait.
    beam = {"beam_length_cells": 2, "beam_width_cells": 1}
    play = Play("A......\n.>.^...\n...^...", freeze_steps=3, **beam)
    play.turn("beam", "stay", "stay").turn("stay", "stay", "forward")
    assert play.places == [(1, 1), (1, 3), (1, 3)]
    play.turn("beam", "stay", "stay")
    assert play.in_play == [True, False, False]
    play.turn("stay")
    assert play.in_play == [True, True, False], "agent 1 was first"
    play.turn("stay").turn("stay").turn("stay")
    assert play.in_play == [True, True, False], "agent 2 waits as long as agent 1 keeps the cell"
    play.turn("stay", "left", "stay")
    assert play.in_play == [True, True, True]


def test_a_time_out_of_three_misses_three_turns_and_as_run_two():
    for counts_tag_turn, missed in ((False, 3), (True, 2)):
        quirks = only_quirks(freeze_counts_tag_turn=counts_tag_turn)
        play = Play("A....\n.>^..", freeze_steps=3, quirks=quirks)
        play.turn("beam", "stay")
        for _ in range(missed):
            assert play.in_play == [True, False]
            play.turn("stay", "forward")
        assert play.in_play == [True, True]
        assert play.places[1] == (1, 2), "no action of an agent out of play counts"
        assert play.turn("stay", "forward").places[1] == (0, 2)


BY_HEADING = {"beam_length_cells": (1, 4, 1, 1)}


@pytest.mark.parametrize(
    ("board", "actions", "rules", "in_play"),
    [
        # A beam reaches its length and no further; the length may depend on the heading.
        ("A.......\n.>...^^.", "beam stay stay", {"beam_length_cells": 4}, [True, False, True]),
        ("A.....\n.>...^", "beam stay", BY_HEADING, [True, False]),
        ("A.....\n.v...<", "stay beam", BY_HEADING, [True, True]),
        # Two that shoot each other are both tagged; hits are found on the cells after the moves.
        ("A....\n.>.<.", "beam beam", {}, [False, False]),
        ("A....\n.....\n.>.^.", "beam forward", {"beam_width_cells": 1}, [True, True]),
    ],
)
def test_a_beam_tags_whom_it_reaches(board, actions, rules, in_play):
    assert Play(board, **rules).turn(*actions.split()).in_play == in_play


def test_a_beam_is_three_cells_wide_and_misses_an_agent_beside_the_shooter():
    board = """
        A.v..
        .....
        .>v..
        .v...
        ..v..
    """
    hit = Play(board).turn("stay", "beam", "stay", "stay", "stay")
    assert hit.in_play == [True, True, False, True, True]


def test_a_wall_stops_each_column_of_a_beam_on_its_own():
    board = """
        A.....
        ..#.v.
        .>..v.
        ..#.v.
    """
    play = Play(board, window_columns=5).turn("stay", "beam", "stay", "stay")
    assert play.in_play == [True, True, False, True]
    # Agent 1 looks right: the far agents to its left and right are spared, the one ahead is gone.
    assert play.window(1).splitlines() == ["#####", "..b.#", ".obo#", "..b.#", ".#b##", "..S.#"]


def test_an_agent_tagged_in_a_turn_still_hits_another_or_harvests_in_that_turn():
    play = Play("A.......\n.>.^.^..", beam_length_cells=2)
    play.turn("stay", "turn_right", "stay").turn("beam", "beam", "stay")
    assert play.in_play == [True, False, False]
    play = Play("..A..\n.>^..").turn("beam", "forward")
    assert (play.harvest, play.in_play) == ([0, 1], [True, False])


def test_an_agent_in_two_beams_takes_one_hit_per_turn():
    play = Play("A......\n>..^..<", hits_to_tag=2)
    play.turn("beam", "stay", "beam")
    assert play.output.hit_by[0].tolist()[1] == [True, False, True]
    assert not play.output.tagged_by.any()
    play.turn("beam", "stay", "stay")
    assert play.output.tagged_by[0].tolist()[1] == [True, False, False]
    assert play.in_play == [True, False, True]


def test_hits_are_kept_between_turns_and_a_tag_or_a_new_episode_clears_them():
    play = Play("A....\n.>.^.", hits_to_tag=2, freeze_steps=1)
    play.turn("beam", "stay").turn("stay").turn("stay")
    assert play.batch.now.hits[0].tolist() == [0, 1]
    assert play.turn("beam", "stay").in_play == [True, False], "the second hit, three turns later"
    assert play.batch.now.hits[0].tolist() == [0, 0]
    assert play.turn("beam", "stay").in_play == [True, True], "nobody hits an agent out of play"
    assert play.batch.now.hits[0].tolist() == [0, 0]
    assert play.turn("beam", "stay").in_play == [True, True], "one hit since the tag"
    play.again()
    assert play.turn("beam", "stay").in_play == [True, True], "one hit in this episode"


def test_every_site_is_full_at_the_start_of_an_episode_also_the_one_on_which_an_agent_starts():
    board = maps.Map(height=1, width=4, sites=((0, 0), (0, 3)), starts=((0, 0, 1), (0, 2, 3)))
    assert Play(board).output.stock[0, 0] == 2
    assert Play(board).turn("stay").harvest == [1, 0]
    assert Play(board).turn("forward", "stay").harvest == [0, 0], "it walked away"
    assert Play(board).turn("stay").again().output.stock[0, 0] == 2


def test_as_run_the_agent_of_lower_index_on_a_cell_gets_the_apple():
    # Pair (1, 2) goes back, 1 onto the cell that 0 has entered: a site.
    board = maps.Map(height=2, width=7, sites=((1, 2), (0, 6)), starts=((1, 1, 1), (1, 2, 1), (1, 4, 3)))
    play = Play(board, clashes="pairwise").turn("forward")
    assert play.places[:2] == [(1, 2), (1, 2)]
    assert play.harvest == [1, 0, 0]


def test_an_apple_can_be_harvested_the_turn_after_it_grew_and_as_run_in_the_same_turn():
    for growth, harvests in (("from_start", [1, 0, 1]), ("before_bites", [1, 1, 1])):
        play = Play(">A.\n.A.", regrow_prob=(0.0, 1.0), growth=growth)
        assert [play.turn(name).harvest[0] for name in ("forward", "stay", "stay")] == harvests


def test_regrowth_counts_the_stock_of_the_start_of_the_turn():
    # The neighbour is bitten in the very turn in which it still counts.
    play = Play("^..\nA..\nA..", regrow_prob=(0.0, 1.0))
    play.turn("backward")
    assert play.output.regrown[0, 0] == 0, "the site bitten was not empty as the turn began"
    play.turn("backward")
    assert play.output.regrown[0, 0] == 1, "the first site grows from the apple bitten meanwhile"
    assert play.output.stock[0, 0] == 1


def test_the_episode_ends_in_the_turn_that_takes_the_last_apple_and_as_run_one_later():
    for late in (False, True):
        play = Play(">A.\n...", quirks=only_quirks(ends_one_turn_late=late)).turn("forward")
        assert bool(play.output.terminated[0, 0]) is not late
        assert bool(play.turn("stay").output.terminated[0, 0])


def ends(play):
    return play.output.terminated[0, 0], play.output.truncated[0, 0], play.output.done[0, 0]


def test_an_empty_board_truncates_an_episode_if_apples_can_grow_and_terminates_it_even_in_the_last_turn():
    play = Play(">A.\n...", regrow_prob=(0.001,), episode_steps=3).turn("forward")
    assert ends(play) == (False, False, False)
    assert ends(play.turn("stay").turn("stay")) == (False, True, True)
    assert ends(Play(">A.\n...", episode_steps=1).turn("forward")) == (True, False, True)


def test_a_world_that_has_ended_does_not_change_and_pays_nothing():
    play = Play(">AA\n..<", episode_steps=1, regrow_prob=(1.0,)).turn("forward", "beam")
    before, windows = copied(play.batch.now), play.output.observation.copy()
    play.turn("forward", "beam")
    assert play.harvest == [0, 0]
    assert not play.output.fired.any()
    assert ends(play) == (False, True, True)
    assert np.array_equal(play.output.observation, windows)
    assert_same(play.batch.now, before)


@pytest.mark.parametrize(
    ("norm", "near", "knights_move"), [("euclidean", 12, 5**0.5), ("manhattan", 12, 3), ("chebyshev", 24, 2)]
)
def test_the_norm_decides_how_many_cells_are_near(norm, near, knights_move):
    full = maps.parse("\n".join(["AAAAAAA"] * 6 + ["AAAAAA>"]))
    middle = full.sites.index((3, 3))
    first, _ = neighbours(full, Rules(regrow_norm=norm))
    assert first[middle + 1] - first[middle] == near
    assert distance(norm, -1, 2) == distance(norm, 2, 1) == pytest.approx(knights_move)


def test_apples_grow_as_often_as_the_rules_say():
    # One site with n apples near, watched over many worlds in its first empty turn.
    board, prob = ">A......\n.AAA...A\n........", (0.0, 0.1, 0.25, 0.6)
    play = Play(board, worlds=40_000, seed=7, regrow_prob=prob, may_fire=False).turn("forward")
    assert (play.output.harvest == 1).all()
    # 3 apples within distance 2 of (0, 1): (1, 1), (1, 2), (1, 3) is sqrt(5) away -> 2 count.
    share = (play.turn("stay").output.regrown == 1).mean()
    assert share == pytest.approx(0.25, abs=4 * (0.25 * 0.75 / 40_000) ** 0.5)
