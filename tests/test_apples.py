"""Apples: harvest, regrowth and the end of an episode."""

from collections import Counter

import numpy as np
import pytest
from boards import Play

from cprl import Game, Rules, maps
from cprl.commons.batch import Batch
from cprl.commons.near import distance, neighbours


def test_an_agent_harvests_the_apple_that_it_steps_on():
    play = Play(">A.A\n....").turn("forward")
    assert play.harvest == [1]
    assert play.output.stock[0, 0] == 1
    assert play.turn("stay").harvest == [0], "the site is empty"


def test_every_site_is_full_at_the_start_of_an_episode_also_the_one_on_which_an_agent_starts():
    board = maps.Map(height=1, width=4, sites=((0, 0), (0, 3)), starts=((0, 0, 1), (0, 2, 3)))
    assert Play(board).output.stock[0, 0] == 2
    assert Play(board).turn("stay").harvest == [1, 0]
    assert Play(board).turn("forward", "stay").harvest == [0, 0], "it walked away"
    assert Play(board).turn("stay").again().output.stock[0, 0] == 2


def test_as_run_the_agent_of_lower_index_on_a_cell_gets_the_apple():
    # Pair (1, 2) goes back, 1 onto the cell that 0 has entered: a site.
    board = maps.Map(height=2, width=7, sites=((1, 2), (0, 6)), starts=((1, 1, 1), (1, 2, 1), (1, 4, 3)))
    play = Play(board, pairwise_clashes=True).turn("forward")
    assert play.places[:2] == [(1, 2), (1, 2)]
    assert play.harvest == [1, 0, 0]


def test_an_apple_can_be_harvested_the_turn_after_it_grew_and_as_run_in_the_same_turn():
    for at_once, harvests in ((False, [1, 0, 1]), (True, [1, 1, 1])):
        play = Play(">A.\n.A.", regrow_prob=(0.0, 1.0), regrow_before_bites=at_once)
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
        play = Play(">A.\n...", ends_one_turn_late=late).turn("forward")
        assert bool(play.output.terminated[0, 0]) is not late
        assert bool(play.turn("stay").output.terminated[0, 0])


def test_the_episode_continues_on_an_empty_board_if_apples_can_grow_without_apples_near():
    play = Play(">A.\n...", regrow_prob=(0.001,), episode_steps=3).turn("forward")
    assert not play.output.done[0, 0]
    play.turn("stay").turn("stay")
    assert play.output.truncated[0, 0]
    assert not play.output.terminated[0, 0]


def test_an_episode_that_loses_its_last_apple_in_the_last_turn_is_terminated_not_truncated():
    play = Play(">A.\n...", episode_steps=1).turn("forward")
    assert play.output.terminated[0, 0]
    assert not play.output.truncated[0, 0]


def test_a_world_that_has_ended_does_not_change_and_pays_nothing():
    play = Play(">AA\n..<", episode_steps=1, regrow_prob=(1.0,)).turn("forward", "beam")
    before = {name: array.copy() for name, array in play.batch.now._asdict().items()}
    windows = play.output.observation.copy()
    play.turn("forward", "beam")
    assert play.harvest == [0, 0]
    assert not play.output.fired.any()
    assert play.output.done[0, 0]
    assert play.output.truncated[0, 0]
    assert np.array_equal(play.output.observation, windows)
    for name, array in play.batch.now._asdict().items():
        assert np.array_equal(array, before[name]), name


@pytest.mark.parametrize(("norm", "near"), [("euclidean", 12), ("manhattan", 12), ("chebyshev", 24)])
def test_the_norm_decides_how_many_cells_are_near(norm, near):
    full = maps.parse("\n".join(["AAAAAAA"] * 6 + ["AAAAAA>"]))
    middle = full.sites.index((3, 3))
    first, _ = neighbours(full, Rules(regrow_norm=norm))
    assert first[middle + 1] - first[middle] == near


def test_each_norm_measures_a_knights_move():
    assert distance("euclidean", 1, 2) == pytest.approx(5**0.5)
    assert distance("manhattan", -1, 2) == 3
    assert distance("chebyshev", 1, -2) == 2


def test_apples_grow_as_often_as_the_rules_say():
    # One site with n apples near, watched over many worlds in its first empty turn.
    prob = (0.0, 0.1, 0.25, 0.6)
    board = maps.parse(">A......\n.AAA...A\n........")
    game = Game(map=board, rules=Rules(regrow_prob=prob, may_fire=False))
    batch = Batch(game, 40_000, seed=7)
    output = batch.begin(batch.new_output())
    forward, stay = np.zeros((40_000, 1), np.int64), np.full((40_000, 1), 6)
    batch.play(forward, output)
    assert (output.harvest == 1).all()
    batch.play(stay, output)
    grown = Counter(output.regrown[:, 0].tolist())
    # 3 apples within distance 2 of (0, 1): (1, 1), (1, 2), (1, 3) is sqrt(5) away -> 2 count.
    share = grown[1] / 40_000
    assert share == pytest.approx(0.25, abs=4 * (0.25 * 0.75 / 40_000) ** 0.5)
