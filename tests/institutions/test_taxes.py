"""Taxes and levies: what is taken when, and who gets it."""

from dataclasses import replace

import numpy as np
import pytest
from boards import Play

from cprl.institutions import Levies, Tax

BOARD = """
>AAA..A
......<
"""
"""Agent 0 harvests an apple a turn, agent 1 none."""


HALF = Tax(rate=0.5, redistribution="none")
BRACKETS = Tax(brackets=((0, 0), (0.5, 0.2), (2, 1)), redistribution="none", period_steps=3)
MANY = Tax(brackets=((0, 0.1), (1, 0.2), (2, 0.3)), redistribution="none")
BITES, STAYS = ("forward", "stay"), ("stay", "stay")


@pytest.mark.parametrize(
    ("taxes", "turns", "fines", "transfers"),
    [
        # 1 apple: 1/4 is taken, and lost, or 1/8 goes to each of two agents; nothing where nothing is bitten.
        ((Tax(rate=0.25),), (BITES,), [0.25, 0], [0.125, 0.125]),
        ((Tax(rate=0.25, redistribution="none"),), (BITES,), [0.25, 0], [0, 0]),
        ((Tax(rate=0.25),), (BITES, STAYS), [0, 0], [0, 0]),
        # In periods of 2 turns nothing after the first, 2 x 0.5 after the second, one apple in the next.
        ((replace(HALF, period_steps=2),), (BITES,), [0, 0], [0, 0]),
        ((replace(HALF, period_steps=2),), (BITES, BITES), [1, 0], [0, 0]),
        ((replace(HALF, period_steps=2),), (BITES, BITES, BITES, STAYS), [0.5, 0], [0, 0]),
        # 3 apples: 0.5 x 0 + 1.5 x 0.2 + 1 x 1 = 1.3; 1 apple: 0.5 x 0.2.
        ((BRACKETS,), (BITES, BITES, BITES), [1.3, 0], [0, 0]),
        ((BRACKETS,), (BITES, STAYS, STAYS), [0.1, 0], [0, 0]),
        # A tax with fewer brackets than another keeps its last rate: 3 x 0.5 of the period, 0.1 of this turn.
        ((replace(HALF, period_steps=3), MANY), (BITES,), [0.1, 0], [0, 0]),
        ((replace(HALF, period_steps=3), MANY), (BITES, BITES, BITES), [1.6, 0], [0, 0]),
        # Several taxes have the same base, in either order.
        ((Tax(rate=0.5), replace(HALF, rate=0.25)), (BITES,), [0.75, 0], [0.25, 0.25]),
        ((replace(HALF, rate=0.25), Tax(rate=0.5)), (BITES,), [0.75, 0], [0.25, 0.25]),
        # Taken: 0.25 + 0.25 + 0.5. Given to 0: 0.25 + 0.125 + 0.25, to 1: 0.125 + 0.25.
        (
            (Levies(groups=((0,), (1,)), local_rate=0.25, joint_rate=0.25), Tax(rate=0.5)),
            (BITES,),
            [1, 0],
            [0.625, 0.375],
        ),
    ],
)
def test_a_turn_takes_and_gives(taxes, turns, fines, transfers):
    play = Play(BOARD, institutions=taxes)
    for turn in turns:
        play.turn(*turn)
    assert (play.fines, play.transfers) == (pytest.approx(fines), pytest.approx(transfers))
    paid = np.array(play.harvest) - play.fines + play.transfers
    assert play.reward == pytest.approx(paid.tolist(), abs=1e-6)
    assert not any(play.violated)


def test_what_is_left_of_a_period_is_collected_when_the_episode_ends():
    taxes = [Tax(rate=0.5, period_steps=50)]
    play = Play(BOARD, institutions=taxes, episode_steps=2).turn(*BITES).turn(*BITES)
    assert play.output.truncated.all()
    assert (play.fines, play.transfers, play.reward) == ([1, 0], [0.5, 0.5], [0.5, 0.5])
    play = Play(">A.<", institutions=taxes).turn(*BITES)
    assert play.output.terminated.all()
    assert (play.fines, play.transfers) == ([0.5, 0], [0.25, 0.25])


def test_the_next_episode_owes_nothing_for_the_last_one():
    play = Play(BOARD, institutions=[Tax(rate=0.5, period_steps=2)]).turn(*BITES)
    play.again()
    assert play.turn("stay").turn("stay").fines == [0, 0]


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


def test_a_world_that_has_ended_pays_nothing_and_keeps_its_counts():
    play = Play(">A.<", institutions=[Tax(rate=0.5), Tax(rate=0.5, period_steps=2)]).turn("forward", "stay")
    assert play.fines == [1, 0]
    before = play.batch.state()
    play.turn("stay")
    assert play.fines == play.transfers == play.reward == [0, 0]
    assert all((array == before[name]).all() for name, array in play.batch.state().items())
