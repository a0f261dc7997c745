"""Games of people who share: what is paid and seen, what is refused, and that experiments play them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_stage_games import HERDERS, LAB, PAIR, ROLLOUTS, SMALL, own_game, rewards, step

import cprl
from cprl import Custom, Experiment
from cprl.algorithms import DQN, LOLA, PPO, LOLASettings, Tabular, TabularSettings
from cprl.envs import make_env
from cprl.envs.taking import TakingGame
from cprl.population import Learning, Team
from cprl.theory import PowerWorth, SharingGame, appropriation, herders


def test_herders_are_paid_for_their_animals_what_these_are_worth():
    # Animals 0.5 and 1.5: A = 2, v(2) = 10 - 4 = 6, less 1 each. 2 and 2: v(4) = 0, an animal costs 1.
    assert rewards(PAIR, (1, 3), (4, 4), (0, 4)) == [[2.5, 7.5], [-2, -2], [0, 10]]


def test_appropriators_are_paid_what_the_laboratory_paid():
    # 8 tokens each: F(64) = 23 * 64 - 0.25 * 64^2 = 448, an eighth is 56, and 2 tokens outside pay 10.
    # None in the resource: 10 tokens outside pay 50. 9 each: X = 72, v = 23 - 18 = 5, as outside.
    nash, none, open_access = rewards(LAB, (16,) * 8, (0,) * 8, (18,) * 8)
    assert (nash, none, open_access) == ([66.0] * 8, [50.0] * 8, [50.0] * 8)
    # Half put in 4 and half 5: X = 36 is best for all, v = 14, 9 more than outside a token.
    assert rewards(LAB, (8, 10) * 4) == [[86.0, 95.0] * 4]


GAMES = st.builds(
    lambda agents, top, power, cost, levels, cap: TakingGame(
        SharingGame(agents=agents, worth=PowerWorth(top=top, power=power), cost=cost * top, most_each=cap),
        levels=levels,
    ),
    agents=st.integers(1, 9),
    top=st.floats(0.5, 50),
    power=st.floats(1, 4),
    cost=st.just(0.0) | st.floats(0.01, 0.9),
    levels=st.integers(2, 30),
    cap=st.none() | st.floats(0.01, 2),
)


@settings(max_examples=60, deadline=None)
@given(game=GAMES, seed=st.integers(0, 999))
def test_rewards_are_the_payoffs_of_the_theory(game, seed):
    chance = np.random.default_rng(seed)
    if game.levels is None:
        action = (chance.random((4, game.agents, 1)) * game.most_each).astype(np.float32)
        taken = np.minimum(action[..., 0].astype(np.float64), game.most_each)
    else:
        action = chance.integers(0, game.levels, (4, game.agents))
        taken = np.array(game.amounts)[action]
    env = make_env(game, worlds=4)
    now, _ = env.step_and_maybe_reset(env.reset().set(("agents", "action"), torch.tensor(action)))
    expected = game.sharing.payoffs(taken)
    assert np.allclose(now["next", "agents", "reward"][..., 0], expected, rtol=1e-6, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(game=GAMES)
def test_equilibrium_and_optimum_lie_within_what_agents_can_take_by_default(game):
    most, sharing = game.agents * game.most_each, game.sharing
    assert 0 < sharing.optimum_total <= sharing.nash_total <= most * (1 + 1e-12)
    limit = sharing.most_each
    assert game.most_each == pytest.approx(min(2 * sharing.nash_total / game.agents, limit or np.inf))
    assert (game.amounts[0], game.amounts[-1], len(game.amounts)) == (0, game.most_each, game.levels)


def test_by_default_appropriators_choose_half_tokens_and_herders_have_the_equilibrium_in_the_middle():
    assert LAB.amounts[:3] == (0, 0.5, 1)
    assert LAB.most_each == 10
    assert TakingGame(herders(5)).amounts[10] == pytest.approx(2.5355 / 5, abs=1e-4)
    assert PAIR.amounts == (0, 0.5, 1, 1.5, 2)


def test_agents_see_the_share_that_they_took_and_that_all_took():
    env = make_env(PAIR)
    moment = env.reset()
    assert moment["agents", "observation"][0].tolist() == [[0, 0, 0]] * 2, "no turn yet"
    _, moment = step(env, moment, (0, 0))
    assert moment["agents", "observation"][0].tolist() == [[1, 0, 0]] * 2
    _, moment = step(env, moment, (1, 4))
    assert moment["agents", "observation"][0].tolist() == [[1, 0.25, 0.625], [1, 1, 0.625]]  # 5 of 8 levels
    env = make_env(replace(PAIR, memory=2))
    _, moment = step(env, env.reset(), (1, 4))
    assert moment["agents", "observation"][0, 0].tolist() == [1, 0.25, 0.625, 0, 0, 0]
    _, moment = step(env, moment, (2, 2))
    assert moment["agents", "observation"][0, 0].tolist() == [1, 0.5, 0.5, 1, 0.25, 0.625]


def test_agents_with_other_numbers_see_and_get_the_same_to_the_bit():
    env, order = make_env(replace(LAB, levels=8), worlds=2), torch.randperm(8)
    action = torch.randint(8, (8,), generator=torch.Generator().manual_seed(3))
    now, _ = step(env, env.reset(), action.tolist(), action[order].tolist())
    one, other = now["next", "agents"]
    assert torch.equal(one["observation"][order], other["observation"])
    assert torch.equal(one["reward"][order], other["reward"])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TakingGame(PowerWorth()), "sharing"),
        (lambda: replace(LAB, most=10.5), r"most is 10.5; allowed: up to sharing.most_each, 10"),
        (lambda: replace(LAB, most=0), "most is 0"),
        (lambda: TakingGame(herders(2, cost=11)), r"most is None"),
        (lambda: replace(LAB, levels=1), "levels is 1"),
        (
            lambda: TakingGame(herders(10**6)),
            r"levels is 21; allowed for 1,000,000 agents: so many that they have fewer than 4,194,304 tot",
        ),
        (lambda: replace(LAB, turns=1, continue_prob=0.5), r"continue_prob is 0.5"),
    ],
)
def test_games_that_cannot_be_played_are_refused(make, message):
    with pytest.raises(ValueError, match=rf"^TakingGame\.{message}"):
        make()


def test_a_game_without_gain_can_be_played_with_amounts_of_ones_own():
    assert rewards(TakingGame(herders(2, cost=11), levels=3, most=1.0), (1, 2)) == [[-1.625, -3.25]]


def test_a_worth_of_the_users_own_is_a_game_by_the_name_of_the_function_that_makes_it():
    with pytest.raises(ValueError, match=r"^experiment\.game\.sharing\.worth is a CallableWorth, which a re"):
        replace(HERDERS, game=own_game())
    experiment = replace(HERDERS, game=Custom("test_stage_games:own_game"))
    back = Experiment.from_recipe(experiment.to_recipe(), allow=["test_stage_games:own_game"])
    assert make_env(back.game).game == own_game()


TABLES = Tabular(settings=TabularSettings(epsilon_decay_steps=20))


@pytest.mark.integration
@pytest.mark.parametrize(
    ("agents", "engine"),
    [
        pytest.param([Learning(TABLES)] * 2, "eager", id="tables"),
        pytest.param(
            *([Learning(DQN(settings=SMALL)), Learning(PPO(settings=ROLLOUTS))], "torchrl"),
            marks=pytest.mark.slow,
            id="stock TorchRL",
        ),
        pytest.param(
            *([Team(LOLA(settings=LOLASettings(rollout_steps=2, hidden_cells=(4,))), (0, 1))], "eager"),
            marks=pytest.mark.slow,
            id="LOLA",
        ),
    ],
)
def test_learners_of_every_kind_play_it(agents, engine, tmp_path):
    experiment = replace(HERDERS, agents=agents, episodes=3, engine=engine)
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    evaluated = cprl.evaluate_run(run, episodes=2).measures()["agent_1/return"].estimate
    assert -10 <= evaluated.value <= 50


@pytest.mark.slow
def test_independent_tables_end_at_the_equilibrium_and_one_agent_at_the_optimum(tmp_path):
    """One agent takes 36 of 72 tokens; two, where each knows only what it got, 24 each."""
    for agents, total in ((1, 36), (2, 48)):
        sharing = appropriation(agents, tokens=60.0)
        learner = TabularSettings(gamma=0.0, epsilon_decay_steps=5000, epsilon_end=0.02, epsilon_evaluation=0)
        experiment = replace(
            HERDERS,
            game=TakingGame(sharing, levels=13, most=36.0 if agents == 1 else 48.0, turns=50, memory=0),
            agents=[Learning(Tabular(settings=learner))] * agents,
            replicas=8,
            episodes=200,
        )
        run = cprl.load(cprl.run(experiment, tmp_path / str(agents), watch="off"))
        episodes = cprl.evaluate_run(run, episodes=1).trained
        paid = np.mean([own.return_.sum() for replica in episodes.values() for own in replica]) / 50
        rent = paid - agents * sharing.payment
        assert rent == pytest.approx(sharing.surplus(total), rel=0.03)
