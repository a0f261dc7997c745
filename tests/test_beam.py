"""Beams: the agents they hit, the walls that stop them, and time-outs."""

import pytest
from boards import Play

from cprl.institutions import Sanctioner

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


def test_an_agent_tagged_as_it_fires_still_hits_another():
    play = Play("A.......\n.>.^.^..", beam_length_cells=2)
    play.turn("stay", "turn_right", "stay").turn("beam", "beam", "stay")
    assert play.in_play == [True, False, False]


def test_an_agent_tagged_in_a_turn_still_harvests_in_that_turn():
    play = Play("..A..\n.>^..").turn("beam", "forward")
    assert play.harvest == [0, 1]
    assert play.in_play == [True, False]


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


def test_the_beam_action_of_an_agent_that_may_not_fire_does_nothing():
    play = Play("A...\n.>.^", institutions=[Sanctioner(agents=(1,))]).turn("beam", "stay")
    assert not play.output.fired.any()
    assert play.in_play == [True, True]
