"""The one loop that plays an episode: when worlds begin and are reset, and what it leaves to who looks on."""

import torch
from matrix_game import MatrixGame
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl import CommonsEnv, Game, Rules, keys, maps
from cprl.measuring.playing import evaluate, turns

CORRIDOR = Game(map=maps.parse(">.AA.A"), rules=Rules(regrow_prob=(0.0,), episode_steps=9))
"""An agent that walks ahead bites in turns 2, 3 and 5, and then the board is dead."""


def walking(moment):
    return moment.set(keys.ACTION, torch.zeros_like(moment[keys.IN_PLAY], dtype=torch.int64))


def test_worlds_begin_at_the_call_and_the_last_board_stands():
    env = CommonsEnv(CORRIDOR, 2, seed=0)
    played = turns(env, walking)
    assert env.output.stock.tolist() == [[3], [3]], "before the first turn is asked for"
    stocks = []
    for batch in played:
        assert batch["next", keys.STOCK].tolist() == env.output.stock.tolist()
        stocks.append(env.output.stock[0, 0])
    assert stocks == [3, 2, 1, 1, 0]
    assert env.output.done.all(), "nobody has reset them"
    assert next(turns(env, walking))["next", keys.STOCK].tolist() == [[3], [3]], "the next episode"


def test_a_world_of_another_game_is_reset_when_the_next_turn_is_asked_for():
    env = MatrixGame(3, steps=2)
    ended = []
    for batch in turns(env, walking_in_a_matrix):
        done = batch["next", keys.DONE][:, 0]
        assert (env.turn[:, 0] == env.steps[:, 0]).tolist() == done.tolist(), "not yet reset"
        ended.append(done.tolist())
    # Of 2, 3 and 4 turns; the first world plays on, and ends a second time with the last.
    assert ended == [
        [False, False, False],
        [True, False, False],
        [False, True, False],
        [True, False, True],
    ]
    assert env.turn[:, 0].tolist() == [0, 1, 0], "and when nothing more is asked for"
    assert [episode.steps for episode in evaluate(MatrixGame(3, steps=2), walking_in_a_matrix)] == [2, 3, 4]


def walking_in_a_matrix(moment):
    return moment.set(keys.ACTION, torch.zeros(*moment.batch_size, 2, dtype=torch.int64))


def test_who_looks_on_computes_as_outside():
    inside = []

    def policy(moment):
        inside.append((torch.is_grad_enabled(), exploration_type()))
        return walking(moment)

    outside = torch.is_grad_enabled(), exploration_type()
    for explore, kind in ((True, ExplorationType.RANDOM), (False, ExplorationType.DETERMINISTIC)):
        for _ in turns(CommonsEnv(CORRIDOR, 1, seed=0), policy, explore=explore):
            assert (torch.is_grad_enabled(), exploration_type()) == outside
        assert set(inside) == {(False, kind)}
        inside.clear()
