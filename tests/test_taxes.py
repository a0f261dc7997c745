"""Taxes and levies: what is taken when, and who gets it."""

import pytest
from boards import Play

from cprl.institutions import Levies, Tax

BOARD = """
>AAA..A
......<
"""
"""Agent 0 harvests an apple a turn, agent 1 none."""


def test_a_tax_is_paid_out_in_equal_parts():
    play = Play(BOARD, institutions=[Tax(rate=0.25)]).turn("forward", "stay")
    # 1 apple: 1/4 is taken, 1/8 goes to each of two agents.
    assert (play.fines, play.transfers) == ([0.25, 0], [0.125, 0.125])
    assert play.reward == [0.875, 0.125]
    assert play.harvest == [1, 0]
    assert not any(play.violated)
    assert play.turn("stay").fines == play.transfers == [0, 0]


def test_a_tax_without_redistribution_is_lost():
    play = Play(BOARD, institutions=[Tax(rate=0.25, redistribution="none")]).turn("forward", "stay")
    assert (play.fines, play.transfers, play.reward) == ([0.25, 0], [0, 0], [0.75, 0])


def test_the_tax_of_a_period_is_collected_at_its_end():
    play = Play(BOARD, institutions=[Tax(rate=0.5, redistribution="none", period_steps=2)])
    assert play.turn("forward", "stay").fines == [0, 0]
    # Two apples: 2 x 0.5.
    assert play.turn("forward", "stay").fines == [1, 0]
    assert play.reward == [0, 0]
    play.turn("forward", "stay")
    assert play.turn("stay").fines == [0.5, 0], "one apple in the second period"


def test_what_is_left_of_a_period_is_collected_when_the_time_is_up():
    taxes = [Tax(rate=0.5, period_steps=50)]
    play = Play(BOARD, institutions=taxes, episode_steps=2).turn("forward", "stay").turn("forward", "stay")
    assert play.output.truncated.all()
    assert (play.fines, play.transfers, play.reward) == ([1, 0], [0.5, 0.5], [0.5, 0.5])


def test_what_is_left_of_a_period_is_collected_when_no_apple_is_left():
    play = Play(">A.<", institutions=[Tax(rate=0.5, period_steps=50)]).turn("forward", "stay")
    assert play.output.terminated.all()
    assert (play.fines, play.transfers) == ([0.5, 0], [0.25, 0.25])


def test_the_next_episode_owes_nothing_for_the_last_one():
    play = Play(BOARD, institutions=[Tax(rate=0.5, period_steps=2)]).turn("forward", "stay")
    play.again()
    assert play.turn("stay").turn("stay").fines == [0, 0]


def test_brackets_tax_the_apples_between_their_bounds():
    tax = Tax(brackets=((0, 0), (0.5, 0.2), (2, 1)), redistribution="none", period_steps=3)
    play = Play(BOARD, institutions=[tax]).turn("forward", "stay").turn("forward", "stay")
    # 3 apples: 0.5 x 0 + 1.5 x 0.2 + 1 x 1 = 1.3.
    assert play.turn("forward", "stay").fines == [pytest.approx(1.3), 0]
    # 1 apple: 0.5 x 0.2.
    play = Play(BOARD, institutions=[tax]).turn("forward", "stay").turn("stay").turn("stay")
    assert play.fines == [pytest.approx(0.1), 0]


def test_taxes_with_fewer_brackets_than_others_keep_their_last_rate():
    many = Tax(brackets=((0, 0.1), (1, 0.2), (2, 0.3)), redistribution="none")
    one = Tax(rate=0.5, redistribution="none", period_steps=3)
    play = Play(BOARD, institutions=[one, many]).turn("forward", "stay")
    assert play.fines == [pytest.approx(0.1), 0]
    play.turn("forward", "stay").turn("forward", "stay")
    # 3 x 0.5 of the period, and 0.1 of this turn.
    assert play.fines == [pytest.approx(1.6), 0]


def test_several_taxes_have_the_same_base():
    taxes = [Tax(rate=0.5), Tax(rate=0.25, redistribution="none")]
    for order in (taxes, taxes[::-1]):
        play = Play(BOARD, institutions=order).turn("forward", "stay")
        assert (play.fines, play.transfers) == ([0.75, 0], [0.25, 0.25])


def test_an_agent_out_of_play_gets_its_part():
    play = Play("A..AAA.\n>..^.<.", institutions=[Tax(rate=0.5)], freeze_steps=9)
    play.turn("beam", "stay", "stay")
    assert play.in_play == [True, False, False], "the beam hits both"
    play.turn("left", "stay", "stay")
    assert play.harvest == [1, 0, 0]
    assert play.transfers == [pytest.approx(0.5 / 3)] * 3


def test_levies_are_shared_within_groups_and_among_all():
    board = ">AA...\n>.....\n>.....\n>....."
    levies = Levies(groups=((0, 2), (1, 3)), local_rate=0.4, joint_rate=0.2)
    play = Play(board, institutions=[levies]).turn("forward", "stay", "stay", "stay")
    # Of 1 apple 0.4 goes to agents 0 and 2, 0.2 each; 0.2 goes to all, 0.05 each.
    assert play.fines == [pytest.approx(0.6), 0, 0, 0]
    assert play.transfers == pytest.approx([0.25, 0.05, 0.25, 0.05])
    assert play.reward == pytest.approx([0.65, 0.05, 0.25, 0.05])


def test_groups_of_different_sizes_share_what_is_theirs():
    board = ">AA...\n>AA...\n>....."
    levies = Levies(groups=((1,), (2, 0)), local_rate=0.5, joint_rate=0)
    play = Play(board, institutions=[levies]).turn("forward", "forward", "stay")
    # Agent 1 pays itself; 0 pays 0.5, of which it gets half back.
    assert play.fines == [0.5, 0.5, 0]
    assert play.transfers == [0.25, 0.5, 0.25]


def test_levies_and_a_tax_add_up():
    levies = Levies(groups=((0,), (1,)), local_rate=0.25, joint_rate=0.25)
    play = Play(BOARD, institutions=[levies, Tax(rate=0.5)]).turn("forward", "stay")
    # Taken: 0.25 + 0.25 + 0.5. Given to 0: 0.25 + 0.125 + 0.25, to 1: 0.125 + 0.25.
    assert (play.fines, play.transfers) == ([1, 0], [0.625, 0.375])
    assert play.reward == [0.625, 0.375]


def test_a_world_that_has_ended_pays_nothing_and_keeps_its_counts():
    play = Play(">A.<", institutions=[Tax(rate=0.5), Tax(rate=0.5, period_steps=2)]).turn("forward", "stay")
    assert play.fines == [1, 0]
    before = play.batch.state()
    play.turn("stay")
    assert play.fines == play.transfers == play.reward == [0, 0]
    assert all((array == before[name]).all() for name, array in play.batch.state().items())
