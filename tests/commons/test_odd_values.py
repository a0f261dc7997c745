"""What the game, its environments, policies and metrics cannot do as asked is refused by name."""

from functools import partial

import numpy as np
import phases
import pytest
import torch

from cprl import CommonsEnv, Game, Map, Rules, maps
from cprl.commons.batch import Batch
from cprl.commons.near import neighbours
from cprl.envs import CommonsGymnasiumEnv, parallel_env
from cprl.evaluation.film import record_episode

GAME = Game(map=maps.parse(">A.\n.A."), rules=Rules(may_fire=False))
BOARD = partial(Map, height=3, width=3, sites=((0, 0),), starts=((1, 1, 0),))
NAN = float("nan")


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: BOARD(sites=((0, 1.7),)), "Map.sites"),
        (lambda: BOARD(starts=((1, 1, 0.5),)), "Map.starts"),
        (lambda: BOARD(width=10**6), "Map.width"),
        (lambda: BOARD(height=9999, width=9999), "Map has"),
        (lambda: maps.random(9, 9, agents=1, density=NAN), "density"),
        (lambda: Rules(hits_to_tag=10**5000), "hits_to_tag"),
        (lambda: CommonsEnv(GAME, seed=2**64), "seed"),
        (lambda: CommonsEnv(GAME, device="x"), "device"),
        (lambda: CommonsGymnasiumEnv(GAME).step(0), "reset"),
        (lambda: phases.find_phases([0, 1e9], {"a": [1, 2]}), "episodes"),
        (lambda: record_episode("run", episode=2**32), "episode"),
    ],
)
def test_it_is_refused_by_its_name(call, name):
    with pytest.raises(ValueError, match=name):
        call()


def test_worlds_that_do_not_fit_into_memory_are_refused_before_they_are_allocated():
    for make in (Batch, CommonsEnv):
        with pytest.raises(MemoryError, match=r"worlds is 4,000,000,000: .* GiB are free: use"):
            make(GAME, 4_000_000_000)


def test_a_beam_wider_than_the_board_is_as_wide_as_the_board():
    boards = maps.parse("..A..\n.>.<.\n....^")
    widest, wide = (Game(map=boards, rules=Rules(beam_width_cells=n)) for n in (2**31 - 1, 11))
    assert widest.tables.beam_half_width == 4
    assert widest.tables.background.size < 1000
    actions = np.random.default_rng(0).integers(0, 8, (60, 2, 3))
    outputs = []
    for game in (widest, wide):
        batch = Batch(game, 2)
        output = batch.begin()
        outputs.append([])
        for action in actions:
            batch.play(action, output)
            outputs[-1].append((output.tagged_by.copy(), output.observation.copy(), batch.now.row.copy()))
    assert any(tagged.any() for tagged, _, _ in outputs[0])
    for one, other in zip(*outputs, strict=True):
        assert all(map(np.array_equal, one, other))


def test_a_large_random_board_has_its_sites_and_agents():
    board = maps.random(300, 300, agents=12, density=0.3, clustering=0.8, seed=1)
    assert (len(board.sites), board.agents) == (27_000, 12)


@pytest.mark.integration
def test_sites_far_apart_are_counted_without_walking_over_the_board():
    board = Map(height=400, width=400, sites=((0, 0), (399, 399), (0, 5)), starts=((1, 1, 0),))
    first, sites = neighbours(board, Rules(regrow_radius_cells=400))
    assert first.tolist() == [0, 1, 1, 2]
    assert sites.tolist() == [2, 0]
    crowded = maps.random(200, 200, agents=1, density=0.5)
    with pytest.raises(ValueError, match=r"radius_cells is 1000 and the map has 20,000"):
        Game(map=crowded, rules=Rules(regrow_radius_cells=1000))


@pytest.mark.parametrize(
    "which", [np.ones(1, bool), np.ones(3, bool), np.ones(2, np.int64), np.ones((2, 1), bool)]
)
def test_a_mask_of_another_form_is_refused_before_the_kernel_reads_it_and_worlds_that_have_not_begun(which):
    batch = Batch(GAME, 2)
    with pytest.raises(ValueError, match="have not begun"):
        batch.check(np.zeros((2, 1), np.int64))
    with pytest.raises(ValueError, match="selected leaves worlds out"):
        batch.begin(batch.new_output(), np.array([True, False]))
    output = batch.begin()
    with pytest.raises(ValueError, match=r"selected is .*"):
        batch.begin(output, which)
    assert batch.now.episode.tolist() == [[0], [0]]


def stepped(env, action, how):
    moment = env.reset()
    if action is not None:
        moment.set(("agents", "action"), action)
    return getattr(env, how)(moment)


@pytest.mark.parametrize("how", ["step", "step_and_maybe_reset"])
@pytest.mark.parametrize(
    ("action", "message"),
    [
        (None, r'\("agents", "action"\) is missing'),
        (torch.zeros(2, 1), r'\("agents", "action"\) is torch.float32'),
        (torch.ones(2, 1, dtype=torch.bool), "is torch.bool"),
        (torch.zeros(2, 1, 1, dtype=torch.int64), r"is torch.int64 \[2, 1, 1\]"),
        (torch.full((2, 1), -1), "action -1 of agent 0 in world 0 is unknown"),
    ],
)
def test_wrong_actions_are_refused_and_no_world_changes(action, message, how):
    env = CommonsEnv(GAME, 2)
    with pytest.raises(ValueError, match=message):
        stepped(env, action, how)
    assert env.worlds.now.step.sum() == 0


@pytest.mark.parametrize("dtype", [torch.int32, torch.int16, torch.int8, torch.uint8])
def test_actions_of_other_integers_play_the_same(dtype):
    action = torch.tensor([[3], [2]])
    exact, other = (stepped(CommonsEnv(GAME, 2, seed=0), own, "step") for own in (action, action.to(dtype)))
    assert torch.equal(exact["next", "agents", "observation"], other["next", "agents", "observation"])


@pytest.mark.parametrize("action", [0.5, 1.0, "3", None, True, NAN, np.float32(1), np.ones(1, int), -1, 7])
def test_one_world_takes_exact_actions_only(action):
    world, parallel = CommonsGymnasiumEnv(GAME), parallel_env(GAME)
    world.reset(), parallel.reset()
    for step in (partial(world.step, action), partial(parallel.step, {"agent_0": action})):
        with pytest.raises(ValueError, match=r"the action of agent_0 is .*"):
            step()
    assert world.world.batch.now.step.sum() == 0
    for seed in (-1, 1.5, 2**64, "3"):
        with pytest.raises(ValueError, match=r"seed is .*"):
            world.reset(seed=seed)


@pytest.mark.parametrize("action", [3, np.int8(3), np.uint64(3), np.array(3), torch.tensor(3)])
def test_one_world_takes_integers_of_any_library(action):
    world = CommonsGymnasiumEnv(GAME)
    world.reset()
    world.step(action)
    assert world.world.batch.now.step.sum() == 1
