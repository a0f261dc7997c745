"""Signals: cheap talk, an action's second part, seen by others in the next turn and else without effect."""

from dataclasses import replace

import numpy as np
import pytest
from boards import Play

from cprl import Game, Observation, Rules, maps
from cprl.commons.batch import Batch
from cprl.institutions import Quota

BOARD = """
.....
.>A<.
.....
"""


def planes(play, agent):
    """The cells of each signal's plane that are not 0, with their value."""
    first = len(play.game.cell_channels)
    seen = play.output.observation[0, agent, first : first + play.game.rules.signals]
    return [[(int(x), int(y), int(plane[x, y])) for x, y in np.argwhere(plane)] for plane in seen]


def test_a_signal_is_seen_at_its_sender_in_the_next_turn_and_then_no_more():
    play = Play(BOARD, signals=2, window_rows=4, window_columns=3).turn("stay 2", "stay")
    assert planes(play, 0) == [[], [(3, 1, 255)]], "its own, at its place in the window"
    assert planes(play, 1) == [[], [(1, 1, 255)]], "two cells ahead"
    play.turn("stay", "stay 1")
    assert planes(play, 0) == [[(1, 1, 255)], []]
    play.turn("stay")
    assert planes(play, 0) == planes(play, 1) == [[], []]


def test_an_agent_out_of_play_sends_nothing_and_a_new_episode_begins_in_silence():
    play = Play(BOARD, signals=1, window_rows=4, window_columns=3).turn("beam 1", "stay 1")
    assert planes(play, 0) == [[(3, 1, 255)]]
    assert planes(play.turn("stay", "stay 1"), 0) == [[]]
    assert planes(play.turn("stay 1").again(), 0) == [[]]


@pytest.mark.parametrize("apart", [False, True])
def test_no_paint_is_the_number_of_a_signal_so_that_signals_are_written_onto_the_picture(apart):
    game = Play(BOARD, signals=15, observation=Observation(agents_apart=apart)).game
    paints = game.tables.paints
    assert not ((paints >= 1) & (paints <= game.rules.signals)).any()


@pytest.mark.parametrize("encoding", ["rgb", "one_hot"])
@pytest.mark.parametrize("area", ["window", "full"])
@pytest.mark.parametrize("governed", [False, True])
def test_signals_change_nothing_but_their_planes(encoding, area, governed):
    seen = Observation(encoding=encoding, area=area, stock_gauge=governed)
    rng, rules = np.random.default_rng(0), Rules(cooldown_steps=1)
    own = {"observation": seen, "institutions": (Quota(fine=1.0),) if governed else ()}
    silent = Game(map=maps.published("two_complex"), rules=rules, **own)
    spoken = replace(silent, rules=replace(rules, signals=3))
    kinds, cells = len(silent.actions), len(silent.cell_channels)
    assert spoken.actions[:kinds] == silent.actions
    assert spoken.actions[kinds] == "forward 1"
    assert len(spoken.actions) == 4 * kinds
    assert spoken.channels[cells : cells + 3] == ("signal 1", "signal 2", "signal 3")
    batches = [Batch(game, 4, seed=1) for game in (silent, spoken)]
    outputs = [batch.begin() for batch in batches]
    for _ in range(60):
        actions = rng.integers(kinds, size=(4, 2))
        signals = rng.integers(4, size=(4, 2))
        batches[0].play(actions, outputs[0])
        batches[1].play(actions + kinds * signals, outputs[1])
        one, other = outputs
        for name in one._fields:
            if name != "observation":
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
        spoken_planes = other.observation[:, :, cells : cells + 3]
        others = np.delete(other.observation, range(cells, cells + 3), axis=2)
        np.testing.assert_array_equal(one.observation, others)
        highest = spoken.observation_highest
        heard = (spoken_planes == highest).any((-2, -1))
        assert set(np.unique(spoken_planes)) <= {0, highest}
        for world in range(4):
            for agent in np.flatnonzero(batches[1].now.on_board[world] & (signals[world] > 0)):
                assert heard[world, agent, signals[world, agent] - 1]


def test_the_state_holds_what_was_said_if_there_are_signals():
    play = Play(BOARD, signals=2, window_rows=4, window_columns=3).turn("stay 2", "stay 1")
    state = play.batch.state()
    assert state["signal"].tolist() == [[2, 1]]
    copy = Play(BOARD, signals=2, window_rows=4, window_columns=3).put(**state)
    np.testing.assert_array_equal(copy.output.observation, play.output.observation)
    with pytest.raises(ValueError, match=r"state\['signal'\]"):
        copy.put(signal=state["signal"] + 1)
    assert not Play(BOARD).batch.state()["signal"].any()
