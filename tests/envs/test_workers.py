"""CommonsEnv in worker processes of TorchRL: with `first_world` they play the worlds of one large batch."""

from functools import partial

import pytest
import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv

from cprl import CommonsEnv, Game, Rules, keys, maps

GAME = Game(map=maps.parse(">A"), rules=Rules(regrow_prob=(0.3,), may_fire=False))
TURNS = 30


def eat_and_step_back(tensordict):
    """Forward onto the apple when it is there, else backward: when it is there again is chance."""
    return tensordict.set(keys.ACTION, torch.where(tensordict[keys.STOCK] == 1, 0, 1))


def networks_by_name(seed, firsts=(0, 4)):
    return [partial(CommonsEnv, GAME, worlds=4, seed=seed, first_world=first) for first in firsts]


def stock_of(steps):
    return steps["next", keys.STOCK].reshape(8, TURNS)


@pytest.fixture(scope="module")
def whole():
    return stock_of(
        CommonsEnv(GAME, worlds=8, seed=7).rollout(TURNS, eat_and_step_back, break_when_any_done=False)
    )


def test_the_parts_of_first_world_are_the_worlds_of_one_large_batch(whole):
    played = SerialEnv(2, networks_by_name(7)).rollout(TURNS, eat_and_step_back, break_when_any_done=False)
    assert torch.equal(stock_of(played), whole)
    assert not torch.equal(whole[:4], whole[4:])


def test_without_first_world_the_same_seed_plays_the_same_worlds_twice(whole):
    parts = networks_by_name(7, firsts=(0, 0))
    stock = stock_of(SerialEnv(2, parts).rollout(TURNS, eat_and_step_back, break_when_any_done=False))
    assert torch.equal(stock[:4], stock[4:])


def test_set_seed_on_all_parts_gives_each_a_seed_of_its_own(whole):
    env = SerialEnv(2, networks_by_name(0))
    env.set_seed(7)
    stock = stock_of(env.rollout(TURNS, eat_and_step_back, break_when_any_done=False))
    assert torch.equal(stock[:4], whole[:4]), "the first part has the seed itself"
    assert not torch.equal(stock[4:], whole[4:]), "the second one the seed after it"
    assert not torch.equal(stock[:4], stock[4:])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_processes_play_the_worlds_of_one_large_batch_too(whole):
    parallel = ParallelEnv(2, networks_by_name(7))
    assert torch.equal(stock_of(parallel.rollout(TURNS, eat_and_step_back, break_when_any_done=False)), whole)
    parallel.close()
    collector = MultiSyncCollector(
        networks_by_name(7),
        eat_and_step_back,
        frames_per_batch=8 * TURNS,
        total_frames=8 * TURNS,
        cat_results="stack",
    )
    (batch,) = collector
    assert torch.equal(stock_of(batch), whole)
    collector.shutdown()
