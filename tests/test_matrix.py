"""Matrix games: what is paid and seen, when an episode ends, and that experiments play them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_stage_games import DILEMMA, DONES, IPD, SMALL, THREE, rewards, step

import cprl
from cprl import Custom
from cprl.algorithms import DQN
from cprl.envs import make_env
from cprl.envs.matrix import MatrixGame, chicken, matching_pennies, prisoners_dilemma, stag_hunt
from cprl.population import Learning

C, D = 0, 1


def number_seen(moment):
    """The number of the joint action that each agent sees, [B][N]."""
    return moment["agents", "observation"].argmax(-1).tolist()


@pytest.mark.parametrize(
    ("game", "cooperate", "exploited", "exploits", "defect"),
    [
        (prisoners_dilemma(), [-1, -1], [-3, 0], [0, -3], [-2, -2]),
        (prisoners_dilemma(reward=3, sucker=0, temptation=4, punishment=1), [3, 3], [0, 4], [4, 0], [1, 1]),
        (stag_hunt(), [4, 4], [0, 3], [3, 0], [1, 1]),
        (chicken(), [3, 3], [1, 4], [4, 1], [0, 0]),
        (matching_pennies(), [1, -1], [-1, 1], [-1, 1], [1, -1]),
    ],
)
def test_published_games_pay_what_was_published(game, cooperate, exploited, exploits, defect):
    found = rewards(game, (C, C), (C, D), (D, C), (D, D))
    assert found == [cooperate, exploited, exploits, defect]


def test_of_three_agents_each_is_paid_its_own_payoff():
    assert rewards(THREE, (1, 0, 1)) == [[15.0, 16.0, 17.0]]  # 3 * (4 + 1) = 15
    assert rewards(THREE, (0, 1, 0)) == [[6.0, 7.0, 8.0]]  # 3 * 2 = 6


def test_agents_see_the_last_joint_action_from_their_own_side():
    env = make_env(IPD)
    moment = env.reset()
    assert moment["agents", "observation"][0].tolist() == [[0, 0, 0, 0, 1]] * 2, "none yet"
    _, moment = step(env, moment, (D, C))
    assert moment["agents", "observation"][0].tolist() == [[0, 0, 1, 0, 0], [0, 1, 0, 0, 0]]
    _, moment = step(env, moment, (D, D))
    assert number_seen(moment) == [[3, 3]]


def test_of_three_agents_each_sees_its_own_action_first_and_then_the_following_agents():
    env = make_env(THREE)
    _, moment = step(env, env.reset(), (1, 0, 0))
    assert moment["agents", "observation"].shape == (1, 3, 9)
    assert number_seen(moment) == [[4, 1, 2]]  # 100, 001 (agents 1, 2, 0) and 010 (agents 2, 0, 1)


def test_two_remembered_joint_actions_are_seen_the_last_one_first():
    env = make_env(prisoners_dilemma(turns=9, memory=2))
    _, moment = step(env, env.reset(), (C, D))
    assert moment["agents", "observation"][0, 0].tolist() == [0, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    _, moment = step(env, moment, (D, D))
    assert moment["agents", "observation"][0, 0].tolist() == [0, 0, 0, 1, 0, 0, 1, 0, 0, 0]


def test_a_world_that_is_over_stays_as_it_is_and_pays_nothing():
    env = make_env(prisoners_dilemma(turns=2), worlds=2)
    moment = env.reset()
    for _ in range(2):
        moment = env.step(moment.set(("agents", "action"), torch.tensor([[C, D], [C, C]])))["next"]
    mask = torch.tensor([[False], [True]])
    moment = env.reset(moment.select("agents", *DONES).set("_reset", mask))
    assert moment["done"].tolist() == [[True], [False]]
    assert number_seen(moment) == [[1, 2], [4, 4]]
    again = env.step(moment.set(("agents", "action"), torch.tensor([[D, D], [D, D]])))["next"]
    assert again["agents", "reward"][..., 0].tolist() == [[0, 0], [-2, -2]]
    assert again["truncated"].tolist() == [[True], [False]]
    assert number_seen(again) == [[1, 2], [3, 3]]


def lengths(env, episodes):
    """How many turns each episode of each world lasts, and whether it terminated: [B] lists."""
    found = [[] for _ in range(env.batch_size[0])]
    moment, turns = env.reset(), [0] * len(found)
    while min(map(len, found)) < episodes:
        now, moment = step(env, moment, *[(C, C)] * len(found))
        for world, ends in enumerate(now["next", "done"][:, 0].tolist()):
            turns[world] += 1
            if ends:
                found[world].append((turns[world], bool(now["next", "terminated"][world])))
                turns[world] = 0
    return [own[:episodes] for own in found]


def test_with_a_probability_to_continue_episodes_terminate_by_chance_or_are_truncated_by_the_clock():
    env = make_env(prisoners_dilemma(turns=6, continue_prob=0.75), worlds=100)
    found = [own for of_world in lengths(env, 20) for own in of_world]
    assert {turns for turns, is_final in found if not is_final} == {6}
    assert max(turns for turns, _ in found) == 6
    # Of 2000 episodes, 0.75**6 = 17.8 % outlast 6 turns, and 25 % end at once; standard errors below 1 %.
    assert np.mean([not is_final for _, is_final in found]) == pytest.approx(0.178, abs=0.03)
    assert np.mean([turns == 1 for turns, _ in found]) == pytest.approx(0.25, abs=0.03)


def test_lengths_follow_from_seed_and_world_alone():
    game = prisoners_dilemma(turns=50, continue_prob=0.8)
    whole = lengths(make_env(game, worlds=5, seed=7), 4)
    assert lengths(make_env(game, worlds=1, seed=7, first_world=3), 4) == whole[3:4]
    env = make_env(game, worlds=5, seed=1)
    assert lengths(env, 4) != whole
    env.set_seed(7)
    assert lengths(env, 4) == whole


@pytest.mark.parametrize(
    ("payoffs", "message"),
    [
        (((1.0, 2.0), (3.0, 4.0)), r"has the shape \[2, 2\]; allowed: \[A, ..., A, N\]"),
        (np.zeros((2, 3, 2)), r"has the shape \[2, 3, 2\]"),
        (np.zeros((1, 1, 2)), r"has the shape \[1, 1, 2\].*at least 2"),
        (np.full((2, 2, 2), np.inf), r"has inf; allowed: numbers up to"),
        (np.zeros((300, 300, 2)), r"has 180,000 numbers; allowed: up to 65,536"),
        ((((1, 1), (1, 1)), ((1, 1), (1,))), r"allowed: an array of numbers"),
        (3, r"has the shape \[\]"),
    ],
)
def test_tables_that_no_game_can_pay_are_refused(payoffs, message):
    with pytest.raises(ValueError, match=rf"^MatrixGame.payoffs.*{message}"):
        MatrixGame(payoffs)


@pytest.mark.parametrize(
    ("make", "wrong", "message"),
    [
        (prisoners_dilemma, {"temptation": -1.5}, "temptation > reward > punishment > sucker"),
        (stag_hunt, {"temptation": 5}, "reward > temptation > sucker"),
        (chicken, {"punishment": 2}, "temptation > reward > sucker > punishment"),
        (matching_pennies, {"stake": 0}, "stake is 0; allowed: a number above 0"),
    ],
)
def test_payoffs_of_another_game_than_the_named_one_are_refused(make, wrong, message):
    with pytest.raises(ValueError, match=message):
        make(**wrong)


def test_a_subclass_of_the_users_own_is_kept_by_its_name():
    game = Custom("cprl.envs.matrix:prisoners_dilemma", arguments={"turns": 2})
    assert make_env(game).game == prisoners_dilemma(turns=2)


@pytest.mark.slow
def test_dqn_learns_to_defect_in_the_one_shot_dilemma(tmp_path):
    """Defection is dominant, so five of five pairs end there: -2 each (a theorem, not a published figure)."""
    settings = replace(SMALL, learning_rate=1e-2, buffer_size=1000, epsilon_decay_steps=500)
    settings = replace(settings, epsilon_evaluation=0.0)
    experiment = replace(
        DILEMMA,
        game=prisoners_dilemma(),
        agents=[Learning(DQN(settings=settings))] * 2,
        replicas=5,
        episodes=2000,
    )
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    episodes = cprl.evaluate_run(run, episodes=5).trained
    assert all(own.return_.tolist() == [-2.0, -2.0] for replica in episodes.values() for own in replica)
