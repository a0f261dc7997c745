"""Games of people who share: what is paid and seen, what is refused, and that experiments play them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

import cprl
from cprl import Custom, Experiment, Study
from cprl.algorithms import (
    DQN,
    LOLA,
    PPO,
    DQNSettings,
    LOLASettings,
    RolloutSettings,
    Tabular,
    TabularSettings,
)
from cprl.commands.recipe import parse
from cprl.envs import make_env, spaces_of
from cprl.envs.state import check_restorable
from cprl.envs.taking import TakingEnv, TakingGame
from cprl.evaluation.evaluate import differences
from cprl.experiment import changes
from cprl.population import Learning, Scripted, Team
from cprl.reporting import write_report
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights
from cprl.studies.trials import trials_of
from cprl.system.compat import LeanStepEnv
from cprl.theory import CallableWorth, PowerWorth, SharingGame, appropriation, herders

DONES = ("done", "terminated", "truncated")
LAB = TakingGame(appropriation(), turns=3)
"""Eight agents; action k puts k / 2 tokens into the resource."""
PAIR = TakingGame(herders(2), levels=5, most=2.0, turns=3)
"""Two herders; action k grazes k / 2 animals."""
STEEP = CallableWorth(function=lambda total: 8 - total**3, most=2)


def own_game():
    """A game of the user's own function, for `Custom`."""
    return TakingGame(SharingGame(agents=2, worth=STEEP, cost=1.0), levels=3, turns=2)


def step(env, carried, *actions):
    """One step with the joint action of each world: what was stepped, and what is carried on."""
    carried["agents", "action"] = torch.tensor(actions)
    return env.step_and_maybe_reset(carried)


def rewards(game, *actions):
    """What joint actions pay, one in each world, [B][N]."""
    env = make_env(game, worlds=len(actions))
    now, _ = step(env, env.reset(), *actions)
    return now["next", "agents", "reward"][..., 0].tolist()


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


def test_a_game_of_one_turn_shows_the_number_one_and_terminates():
    env = make_env(replace(PAIR, turns=1), worlds=2)
    now, moment = step(env, env.reset(), (0, 1), (1, 1))
    assert [now["next", name].tolist() for name in DONES] == [[[True]] * 2, [[True]] * 2, [[False]] * 2]
    assert moment["agents", "observation"].tolist() == [[[1.0]] * 2] * 2
    assert make_env(replace(PAIR, memory=0)).reset()["agents", "observation"].shape == (1, 2, 1)


def test_a_repeated_game_is_truncated_by_its_clock_and_begins_again():
    env = make_env(PAIR)
    moment, found = env.reset(), []
    for _ in range(4):
        now, moment = step(env, moment, (1, 1))
        found.append([now["next", name].item() for name in DONES])
    on = [False] * 3
    assert found == [on, on, [True, False, True], on]


def test_a_world_that_is_over_stays_as_it_is_and_pays_nothing():
    env = make_env(replace(PAIR, turns=2), worlds=2)
    one = torch.ones(2, 2, dtype=torch.int64)
    moment = env.reset()
    for _ in range(2):
        moment = env.step(moment.set(("agents", "action"), one))["next"]
    mask = torch.tensor([[False], [True]])
    moment = env.reset(moment.select("agents", *DONES).set("_reset", mask))
    seen = moment["agents", "observation"][:, 0].tolist()
    assert seen == [[1, 0.25, 0.25], [0, 0, 0]]
    again = env.step(moment.set(("agents", "action"), 2 * one))["next"]
    assert again["agents", "reward"][..., 0].tolist() == [[0, 0], [5, 5]]  # one animal each: v(2) - 1 = 5
    assert again["truncated"].tolist() == [[True], [False]]
    assert again["agents", "observation"][:, 0].tolist() == [[1, 0.25, 0.25], [1, 0.5, 0.5]]


CHANCY = TakingGame(herders(3), turns=4, memory=2, continue_prob=0.6)


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("game", [replace(LAB, turns=1), LAB, CHANCY, own_game()])
def test_it_is_an_environment_of_torchrl_that_can_be_put_where_it_was(game, worlds):
    env = make_env(game, worlds=worlds)
    check_env_specs(env)
    assert isinstance(env, TakingEnv)
    moment = env.step(env.rand_action(env.reset()))
    assert moment["next", "agents", "reward"].shape == (worlds, game.agents, 1)
    check_restorable(lambda: make_env(game, worlds=worlds))
    spaces = spaces_of(env)
    assert (spaces.agents, spaces.actions) == (game.agents, game.levels)
    assert (spaces.observation_dtype, spaces.observation_scale) == ("float32", 1.0)


@pytest.mark.parametrize("game", [replace(PAIR, turns=4, continue_prob=0.6), CHANCY])
def test_the_lean_step_equals_torchrls_own(game):
    class Stock(TakingEnv):
        _step_and_maybe_reset = EnvBase._step_and_maybe_reset

    assert TakingEnv._step_and_maybe_reset is LeanStepEnv._step_and_maybe_reset
    envs = [kind(game, 4, seed=3) for kind in (TakingEnv, Stock)]
    moments, kept = [env.reset() for env in envs], []
    for turn in range(20):
        torch.manual_seed(turn)
        action = envs[0].action_spec["agents", "action"].rand()
        nows, moments = zip(
            *(
                env.step_and_maybe_reset(own.set(("agents", "action"), action))
                for env, own in zip(envs, moments, strict=True)
            ),
            strict=True,
        )
        assert_equal(*nows)
        assert_equal(*(own.exclude(("agents", "action")) for own in moments))  # which is overwritten
        kept.append((nows[0], nows[0].clone()))
    for now, then in kept:
        assert_equal(now, then)  # what was returned never changes


def assert_equal(one, other):
    mine, theirs = (dict(own.items(True, True)) for own in (one, other))
    assert mine.keys() == theirs.keys()
    for name in mine:
        assert torch.equal(mine[name], theirs[name]), name


@settings(max_examples=15, deadline=None)
@given(worlds=st.integers(2, 5), world=st.integers(0, 4), seed=st.integers(0, 2**32 - 1))
def test_a_world_does_not_notice_its_neighbours(worlds, world, seed):
    world %= worlds
    game = replace(PAIR, turns=5, continue_prob=0.7, memory=2)
    actions = torch.randint(5, (8, worlds, 2), generator=torch.Generator().manual_seed(seed))
    many = rolled(make_env(game, worlds=worlds, seed=seed), actions)
    alone = rolled(make_env(game, seed=seed, first_world=world), actions[:, world : world + 1])
    for moment, own in zip(many, alone, strict=True):
        assert_equal(moment[world : world + 1], own)


def rolled(env, actions):
    moment, found = env.reset(), []
    for joint in actions:
        now, moment = env.step_and_maybe_reset(moment.set(("agents", "action"), joint))
        found.append(now)
    return found


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TakingGame(PowerWorth()), r"sharing is a PowerWorth; allowed: a cprl.theory.SharingGame"),
        (lambda: replace(LAB, most=10.5), r"most is 10.5; allowed: up to sharing.most_each, 10"),
        (lambda: replace(LAB, most=0), r"most is 0; allowed: None or a number above 0"),
        (lambda: TakingGame(herders(2, cost=11)), r"most is None"),
        (lambda: replace(LAB, levels=None), r"levels"),
        (lambda: replace(LAB, levels=1), r"levels is 1; allowed: an integer in 2..65536"),
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


@pytest.mark.parametrize(
    ("game", "action", "message"),
    [
        (PAIR, torch.tensor([[0, 5]]), r"has numbers from 0 to 5; allowed: 0 to 4"),
        (PAIR, torch.tensor([[-1, 0]]), r"has numbers from -1 to 0"),
        (PAIR, torch.tensor([[0.0, 1.0]]), r"is torch.float32 \[1, 2\]; allowed: int64 \[1, 2\]"),
        (PAIR, None, r"is missing"),
    ],
)
def test_actions_that_nobody_can_take_are_refused_and_change_nothing(game, action, message):
    env = make_env(game)
    env.reset()
    before = {name: value.clone() for name, value in env.state_dict().items()}
    group = TensorDict({"observation": torch.zeros(1, 2, 3)}, [1, 2])
    carried = TensorDict({"agents": group}, [1])
    group._tensordict.update({} if action is None else {"action": action})  # past tensordict's own check
    with pytest.raises(ValueError, match=message):
        env.step_and_maybe_reset(carried)
    assert all(torch.equal(value, before[name]) for name, value in env.state_dict().items())


SMALL = DQNSettings(
    hidden_cells=(8,), learning_starts=8, buffer_size=50, batch_size=4, target_every_episodes=1
)
ROLLOUTS = RolloutSettings(rollout_steps=10, minibatch_size=5, hidden_cells=(8,))
EXPERIMENT = Experiment(
    name="herders",
    game=replace(PAIR, turns=5),
    agents=[Learning(DQN(settings=SMALL)), Learning(PPO(settings=ROLLOUTS), reward="team")],
    replicas=2,
    episodes=8,
    evaluation_episodes=3,
    engine="eager",
)


def test_its_recipe_holds_it_and_gives_it_back_without_importing_anything():
    table = json.loads(json.dumps(EXPERIMENT.to_recipe()))
    assert table["experiment"]["game"] == {
        "kind": "TakingGame",
        "sharing": {
            "kind": "SharingGame",
            "agents": 2,
            "worth": {"kind": "PowerWorth", "top": 10, "factor": 1, "power": 2},
            "cost": 1,
            "most_each": None,
            "payment": 0,
        },
        "levels": 5,
        "most": 2,
        "turns": 5,
        "memory": None,
        "continue_prob": 1,
    }
    back = Experiment.from_recipe(table)
    assert back == EXPERIMENT
    assert back.game == EXPERIMENT.game
    assert hash(back.game) == hash(EXPERIMENT.game)
    other = replace(EXPERIMENT, game=replace(EXPERIMENT.game, sharing=herders(2, cost=2.0)))
    assert changes(EXPERIMENT, other) == ["experiment.game.sharing.cost was 1.0, is 2.0"]


def test_a_worth_of_the_users_own_is_a_game_by_the_name_of_the_function_that_makes_it():
    with pytest.raises(ValueError, match=r"^experiment\.game\.sharing\.worth is a CallableWorth, which a re"):
        replace(EXPERIMENT, game=own_game())
    experiment = replace(EXPERIMENT, game=Custom("test_taking:own_game"))
    back = Experiment.from_recipe(experiment.to_recipe(), allow=["test_taking:own_game"])
    assert make_env(back.game).game == own_game()


@pytest.mark.integration
def test_a_population_trains_stops_resumes_loads_and_meets_another(tmp_path, monkeypatch, capsys):
    experiment = replace(EXPERIMENT, callbacks=[Custom("one_road_parts:Stopping")])
    whole = cprl.run(experiment, tmp_path / "whole", watch="off")
    assert "left out" in capsys.readouterr().out
    monkeypatch.setenv("STOP_AT_STEP", "23")
    with pytest.raises(SystemExit):
        cprl.run(experiment, tmp_path / "parts", watch="off")
    monkeypatch.delenv("STOP_AT_STEP")
    parts = cprl.run(experiment, tmp_path / "parts", watch="off", resume=True)
    assert read_episodes(parts).equals(read_episodes(whole))
    one, other = (load_weights(own / "checkpoints" / "final.pt") for own in (parts, whole))
    assert repr(one) == repr(other)
    loaded = cprl.load(whole, allow=["one_road_parts:Stopping"])
    assert loaded.game == experiment.game
    value = cprl.evaluate_run(loaded, episodes=4).measures()["agent_0/return"].estimate.value
    assert -10 <= value <= 50  # five turns: two animals bring 10 alone, and -2 where the other has two too
    second = cprl.load(cprl.run(replace(EXPERIMENT, seed=9), tmp_path / "second", watch="off"))
    played = cprl.crossplay([loaded, second], episodes=2)
    assert played.cell("whole", "second").measures()["focal/return"].estimate is not None
    with pytest.raises(ValueError, match=r"plays a game that reports no harvest; allowed in a report"):
        write_report([whole], tmp_path / "report")
    third = replace(EXPERIMENT, game=replace(EXPERIMENT.game, sharing=herders(2, cost=2.0)))
    third = cprl.load(cprl.run(third, tmp_path / "third", watch="off"))
    with pytest.raises(ValueError, match=r"have different games: TakingGame.sharing"):
        cprl.crossplay([loaded, third], episodes=2)


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
    experiment = replace(EXPERIMENT, agents=agents, episodes=3, engine=engine)
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    evaluated = cprl.evaluate_run(run, episodes=2).measures()["agent_1/return"].estimate
    assert -10 <= evaluated.value <= 50


def test_two_games_differ_in_the_fields_that_differ():
    assert differences(PAIR, replace(PAIR, turns=4)) == ["TakingGame.turns 3 and 4"]


def test_a_study_varies_how_many_share_and_what_it_costs():
    study = Study(EXPERIMENT, {"game.sharing.cost": [1.0, 2.0], "game.levels": [5, 9]})
    found = {(own.experiment.game.sharing.cost, own.experiment.game.levels) for own in trials_of(study)}
    assert found == {(1.0, 5), (1.0, 9), (2.0, 5), (2.0, 9)}


def test_its_numbers_are_flags_of_a_command_line():
    words = ["mine", "--game.turns", "7", "--game.sharing.cost", "2", "--game.sharing.worth.top", "9"]
    experiment, _ = parse(lambda: EXPERIMENT, words)
    sharing = SharingGame(agents=2, worth=PowerWorth(top=9.0), cost=2.0)
    assert experiment.game == replace(EXPERIMENT.game, turns=7, sharing=sharing)


def test_scripted_policies_that_read_a_window_are_refused():
    with pytest.raises(ValueError, match=r"Scripted\('greedy'\) reads the window of a cprl.Game"):
        cprl.run(replace(EXPERIMENT, agents=[Scripted("greedy"), Scripted()]), "never")


@pytest.mark.slow
def test_independent_tables_end_at_the_equilibrium_and_one_agent_at_the_optimum(tmp_path):
    """One agent takes 36 of 72 tokens; two, where each knows only what it got, 24 each."""
    for agents, total in ((1, 36), (2, 48)):
        sharing = appropriation(agents, tokens=60.0)
        learner = TabularSettings(gamma=0.0, epsilon_decay_steps=5000, epsilon_end=0.02, epsilon_evaluation=0)
        experiment = replace(
            EXPERIMENT,
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
