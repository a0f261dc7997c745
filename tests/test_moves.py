"""Moves and clashes: boards before and after a turn."""

from collections import Counter
from dataclasses import replace

import pytest
from boards import Play

from cprl.commons.batch import Batch


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
    at = fixed.places
    headings = dict(zip(at, fixed.batch.now.heading[0].tolist(), strict=True))
    game = replace(fixed.game, rules=replace(fixed.game.rules, shuffle_starts=True))
    batch = Batch(game, 100, seed=4)
    output = batch.new_output()
    for _ in range(12):
        batch.begin(output)
        places = [list(zip(*world, strict=True)) for world in zip(batch.now.row, batch.now.col, strict=True)]
        orders.update(tuple(at.index(place) for place in world) for world in places)
        for world, facing in zip(places, batch.now.heading.tolist(), strict=True):
            assert [headings[place] for place in world] == facing, "a place keeps its heading"
        fixed.batch.begin(fixed.output)
        assert fixed.places == at
    assert len(orders) == 6
    assert all(140 < count < 260 for count in orders.values()), orders
    alone = Batch(game, 1, seed=4, first_world=37)
    for _ in range(12):
        alone.begin(alone.new_output())
    assert (alone.now.row[0] == batch.now.row[37]).all()
    assert (alone.now.col[0] == batch.now.col[37]).all()


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
    play = Play("A......\n.>>.<..", pairwise_clashes=True)
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
        play = Play("A....\n.>^..", freeze_steps=3, freeze_counts_tag_turn=counts_tag_turn)
        play.turn("beam", "stay")
        for _ in range(missed):
            assert play.in_play == [True, False]
            play.turn("stay", "forward")
        assert play.in_play == [True, True]
        assert play.places[1] == (1, 2), "no action of an agent out of play counts"
        assert play.turn("stay", "forward").places[1] == (0, 2)
