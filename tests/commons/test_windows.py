"""Windows, drawn as signs: `S` self, `o` other agents, `m` heading marks, `b` beams."""

from dataclasses import replace

import numpy as np
import pytest
from boards import Play, drawn, only_quirks

from cprl import Observation, Quirks2019, maps
from cprl.commons.cells import APPLE, GROUND, MARK, OTHER, WALL


def windows(play, *agents):
    return [play.window(agent).splitlines() for agent in agents]


@pytest.mark.parametrize(
    ("turns", "seen"),
    [
        (["stay"], ["A..", ".mA", ".S."]),
        (["turn_right"], ["###", "Am.", ".S."]),
        (["turn_left"], ["###", "Am.", ".S."]),
        (["turn_left", "turn_left"], ["###", ".mA", ".S."]),
    ],
)
def test_the_window_turns_with_the_agent_and_shows_its_own_row_last(turns, seen):
    board = """
        A..
        ..A
        .^.
        A..
    """
    play = Play(board, window_rows=3, window_columns=3, may_fire=False)
    for action in turns:
        play.turn(action)
    assert windows(play, 0) == [seen]


def test_everything_outside_the_board_is_wall():
    play = Play("A>.\n...", window_rows=4, window_columns=5)
    assert windows(play, 0) == [["#####", "#####", "##m.#", "##S.#"]]


@pytest.mark.parametrize("quirks", [None, Quirks2019()])
def test_what_was_painted_before_leaves_no_trace_in_windows_also_beyond_the_board(quirks):
    board = """
        <A^
        v.>
    """
    rules = {"window_rows": 4, "window_columns": 5, "signals": 2, "quirks": quirks}
    play = Play(board, **rules)
    for action in ("beam 2", "turn_left 1", "backward", "beam", "turn_right 2", "left 1", "beam 1", "stay"):
        play.turn(action)
        first_picture = Play(board, **rules).put(**play.batch.state())
        assert np.array_equal(play.output.observation, first_picture.output.observation)


def test_each_agent_sees_itself_blue_and_others_red():
    play = Play("A....\n.>.<.", window_rows=4, window_columns=3)
    assert windows(play, 0, 1) == [["..#", ".o#", ".m#", ".S#"], ["#.A", "#o.", "#m.", "#S."]]


FIRE_OVER_APPLES = drawn(
    """
    .AA....
    .>A.<.^
    .......
    """
)


@pytest.mark.parametrize(
    ("paint_over", "seen"),
    [(False, ["bob", "bbb", "bob", "bbb", "AAb", "AS."]), (True, ["bbb", "bbb", "bbb", "bbb", "bbb", "AS."])],
)
def test_marks_and_beams_are_painted_over_apples_and_agents_as_run_alone(paint_over, seen):
    quirks = only_quirks(paint_over=paint_over)
    play = Play(FIRE_OVER_APPLES, window_rows=6, window_columns=3, quirks=quirks, hits_to_tag=2)
    play.turn("beam", "stay", "stay")
    assert play.in_play == [True, True, True]
    assert windows(play, 0) == [seen]


def test_an_agent_out_of_play_sees_itself_but_is_hidden_from_others():
    play = Play("A....\n.>.<.", window_rows=3, window_columns=3).turn("beam", "stay")
    assert windows(play, 0, 1) == [["bb#", "bb#", ".S#"], ["#o.", "#bb", "#Sb"]]


def test_an_agent_that_returns_acts_for_a_turn_before_others_see_it():
    play = Play("A.....\n.>.<..", window_rows=3, window_columns=3, freeze_steps=2).turn("beam", "stay")
    play.turn("stay").turn("stay")
    assert play.in_play == [True, True], "it has returned"
    assert windows(play, 0) == [["..#", ".m#", ".S#"]], "two cells ahead there seems to be nobody"
    play.turn("forward", "forward")
    assert play.places == [(1, 1), (1, 3)], "they bump into each other"
    assert windows(play, 0) == [[".o#", ".m#", ".S#"]]


def test_the_beam_of_an_agent_that_is_tagged_as_it_fires_is_seen():
    play = Play("A......\n>..<...\n...^...", window_rows=3, window_columns=7, beam_width_cells=1)
    play.turn("beam", "beam", "stay")
    assert play.in_play == [False, False, True]
    assert windows(play, 2) == [["A......", "bbbbbb.", "...S..."]]


FACING_DOWN = "....\n.v..\n...A\n>..."


def test_the_mark_shows_the_heading_and_as_run_it_is_behind_an_agent_that_faces_down():
    ahead = Play(FACING_DOWN, window_rows=4, window_columns=3)
    quirks = only_quirks(mark_behind_if_vertical=True)
    behind = Play(FACING_DOWN, window_rows=4, window_columns=3, quirks=quirks)
    assert windows(ahead, 0, 1) == [["###", ".mo", ".m.", ".S."], ["A.#", "..#", "mm#", ".S#"]]
    assert windows(behind, 0, 1) == [["###", ".mo", "...", ".S."], ["A.#", "..#", ".m#", ".S#"]]


@pytest.mark.parametrize(("old_stock", "ahead"), [(False, "A"), (True, "m")])
def test_as_run_the_picture_shows_the_apples_of_the_start_of_the_turn(old_stock, ahead):
    rules = {"regrow_prob": (0.0, 1.0), "quirks": only_quirks(picture_shows_old_stock=old_stock)}
    play = Play("A.A\n^..", window_rows=2, window_columns=3, **rules).turn("forward")
    play.turn("backward")
    assert play.output.regrown[0, 0] == 1, "the apple bitten has grown again"
    assert windows(play, 0) == [[f"#{ahead}.", "#S."]]
    assert windows(play.turn("stay"), 0) == [["#A.", "#S."]]


def test_as_run_the_cells_of_earlier_agents_stay_painted_as_self():
    board = "A....\n.>.<."
    stays = Play(board, window_rows=3, window_columns=3, quirks=only_quirks(self_paint_stays=True))
    goes = Play(board, window_rows=3, window_columns=3)
    assert windows(goes, 0, 1) == [[".o#", ".m#", ".S#"], ["#o.", "#m.", "#S."]]
    assert windows(stays, 0, 1) == [[".o#", ".m#", ".S#"], ["#S.", "#m.", "#S."]]


def test_as_run_the_mark_of_a_later_agent_covers_an_earlier_agent():
    quirks = only_quirks(paint_over=True)
    covered = Play("A....\n..<<.", window_rows=3, window_columns=3, quirks=quirks)
    seen = Play("A....\n..<<.", window_rows=3, window_columns=3)
    assert windows(covered, 1) == [["#m.", "#m.", "#S."]]
    assert windows(seen, 1) == [["#m.", "#o.", "#S."]]


def test_boards_show_the_classes_of_all_cells():
    play = Play("A.#\n.>.\n...")
    shown = play.batch.boards()[0]
    expected = [[APPLE, GROUND, WALL], [GROUND, OTHER, MARK], [GROUND, GROUND, GROUND]]
    assert np.array_equal(shown, expected)


WHOLE = Observation(area="full")


def test_a_beam_is_drawn_from_where_it_was_fired_also_if_its_shooter_was_tagged_and_is_elsewhere():
    board = replace(maps.parse(">...<A\n......\n......"), spawns=((2, 0), (2, 5)))
    rules = {"freeze_steps": 0, "respawn_at_spawns": True, "beam_length_cells": 4, "beam_width_cells": 1}
    play = Play(board, observation=WHOLE, **rules).turn("beam")
    assert play.output.tagged_by[0].tolist() == [[False, True], [True, False]]
    assert sorted(play.places) == [(2, 0), (2, 5)]
    assert play.window(0).splitlines()[0] == "bbbbbA", "both beams, over the places that their shooters left"
    assert sorted("".join(play.window(0).splitlines()[1:]).replace(".", "")) == ["S", "o"]
    copy = Play(board, observation=WHOLE, **rules).put(**play.batch.state())
    assert copy.window(0) == play.window(0), "the place of a shot is part of the state"


def test_an_agent_that_is_tagged_and_misses_no_turn_is_in_play_and_drawn():
    play = Play(">..<A", freeze_steps=0, observation=WHOLE).turn("beam", "stay")
    assert play.output.tagged_by[0, 1, 0]
    assert play.in_play == [True, True]
    assert play.window(0) == "SbboA"
    frozen = Play(">..<A", freeze_steps=1, observation=WHOLE).turn("beam", "stay")
    assert frozen.in_play == [True, False]
    assert frozen.window(0) == "SbbbA"
