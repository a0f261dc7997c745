"""Matrix games: what is paid and seen, when an episode ends, and that experiments play them."""

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
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.commands.recipe import parse
from cprl.envs import make_env, spaces_of
from cprl.envs.matrix import (
    MatrixEnv,
    MatrixGame,
    chicken,
    matching_pennies,
    prisoners_dilemma,
    stag_hunt,
)
from cprl.envs.state import check_restorable
from cprl.evaluation.evaluate import differences
from cprl.experiment import changes
from cprl.population import Learning, Scripted
from cprl.reporting import write_report
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights
from cprl.studies.trials import trials_of
from cprl.system.compat import LeanStepEnv

C, D = 0, 1
IPD = prisoners_dilemma(turns=3)
DONES = ("done", "terminated", "truncated")
THREE = MatrixGame(np.arange(24.0).reshape(2, 2, 2, 3), turns=2)
"""Three agents; joint action (a, b, c) pays agent n 3 * (4a + 2b + c) + n."""


def step(env, carried, *actions):
    """One step with the joint action of each world: what was stepped, and what is carried on."""
    carried["agents", "action"] = torch.tensor(actions)
    return env.step_and_maybe_reset(carried)


def rewards(game, *actions):
    """What one joint action pays each agent."""
    env = make_env(game)
    now, _ = step(env, env.reset(), actions)
    return now["next", "agents", "reward"][0, :, 0].tolist()


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
    found = [rewards(game, *joint) for joint in ((C, C), (C, D), (D, C), (D, D))]
    assert found == [cooperate, exploited, exploits, defect]


def test_of_three_agents_each_is_paid_its_own_payoff():
    assert rewards(THREE, 1, 0, 1) == [15.0, 16.0, 17.0]  # 3 * (4 + 1) = 15
    assert rewards(THREE, 0, 1, 0) == [6.0, 7.0, 8.0]  # 3 * 2 = 6


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


def test_a_game_of_one_turn_shows_the_number_one_and_terminates():
    env = make_env(prisoners_dilemma(), worlds=2)
    now, moment = step(env, env.reset(), (C, D), (D, D))
    assert [now["next", name].tolist() for name in DONES] == [[[True]] * 2, [[True]] * 2, [[False]] * 2]
    assert moment["agents", "observation"].tolist() == [[[1.0]] * 2] * 2
    assert not moment["done"].any()
    assert make_env(prisoners_dilemma(turns=4, memory=0)).reset()["agents", "observation"].shape == (1, 2, 1)


def test_an_iterated_game_is_truncated_by_its_clock_and_begins_again():
    env = make_env(IPD)
    moment, found = env.reset(), []
    for _ in range(4):
        now, moment = step(env, moment, (C, D))
        found.append([now["next", name].item() for name in DONES])
    on = [False] * 3
    assert found == [on, on, [True, False, True], on]
    now, _ = step(env, env.reset(), (C, D))
    assert number_seen(now["next"]) == [[1, 2]], "the last observation is of the last joint action"


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


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize(
    "game",
    [
        prisoners_dilemma(),
        IPD,
        THREE,
        prisoners_dilemma(turns=9, memory=3, continue_prob=0.5),
        MatrixGame([[1.0], [0.0]]),
    ],
)
def test_it_is_an_environment_of_torchrl_that_can_be_put_where_it_was(game, worlds):
    env = make_env(game, worlds=worlds)
    check_env_specs(env)
    assert isinstance(env, MatrixEnv)
    moment = env.step(env.rand_action(env.reset()))
    assert moment["agents", "action"].dtype == torch.int64
    assert moment["next", "agents", "reward"].shape == (worlds, game.agents, 1)
    check_restorable(lambda: make_env(game, worlds=worlds))
    spaces = spaces_of(env)
    assert (spaces.agents, spaces.actions, spaces.observation_dtype) == (game.agents, game.actions, "float32")
    assert spaces.observation_scale == 1.0


def test_the_lean_step_equals_torchrls_own():
    class Stock(MatrixEnv):
        _step_and_maybe_reset = EnvBase._step_and_maybe_reset

    assert MatrixEnv._step_and_maybe_reset is LeanStepEnv._step_and_maybe_reset
    game = prisoners_dilemma(turns=4, continue_prob=0.6)
    envs = [kind(game, 4, seed=3) for kind in (MatrixEnv, Stock)]
    moments = [env.reset() for env in envs]
    chance = torch.Generator().manual_seed(0)
    kept = []
    for _ in range(30):
        actions = torch.randint(2, (4, 2), generator=chance)
        nows, moments = zip(
            *(
                env.step_and_maybe_reset(own.set(("agents", "action"), actions))
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


@settings(max_examples=30, deadline=None)
@given(worlds=st.integers(2, 5), world=st.integers(0, 4), seed=st.integers(0, 2**64 - 1))
def test_a_world_does_not_notice_its_neighbours(worlds, world, seed):
    world %= worlds
    game = prisoners_dilemma(turns=5, continue_prob=0.7, memory=2)
    actions = torch.randint(2, (8, worlds, 2), generator=torch.Generator().manual_seed(seed % 2**31))
    many = rolled(make_env(game, worlds=worlds, seed=seed % 2**32), actions)
    alone = rolled(make_env(game, seed=seed % 2**32, first_world=world), actions[:, world : world + 1])
    for moment, own in zip(many, alone, strict=True):
        assert_equal(moment[world : world + 1], own)


def rolled(env, actions):
    moment, found = env.reset(), []
    for joint in actions:
        now, moment = env.step_and_maybe_reset(moment.set(("agents", "action"), joint))
        found.append(now)
    return found


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


def test_a_chance_to_continue_needs_several_turns():
    with pytest.raises(ValueError, match=r"MatrixGame.continue_prob is 0.5"):
        prisoners_dilemma(continue_prob=0.5)


@pytest.mark.parametrize(
    ("make", "wrong", "message"),
    [
        (prisoners_dilemma, {"temptation": -1.5}, "temptation > reward > punishment > sucker"),
        (prisoners_dilemma, {"sucker": "x"}, "sucker is 'x'; allowed: a number"),
        (stag_hunt, {"temptation": 5}, "reward > temptation > sucker"),
        (chicken, {"punishment": 2}, "temptation > reward > sucker > punishment"),
        (matching_pennies, {"stake": 0}, "stake is 0; allowed: a number above 0"),
    ],
)
def test_payoffs_of_another_game_than_the_named_one_are_refused(make, wrong, message):
    with pytest.raises(ValueError, match=message):
        make(**wrong)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([[0, 2]]), r"has numbers from 0 to 2; allowed: 0 to 1"),
        (torch.tensor([[-1, 0]]), r"has numbers from -1 to 0"),
        (torch.tensor([[0.0, 1.0]]), r"is torch.float32 \[1, 2\]; allowed: int64 \[1, 2\]"),
        (torch.tensor([[0]]), r"is torch.int64 \[1, 1\]; allowed: int64 \[1, 2\]"),
        (None, r"is missing"),
    ],
)
def test_actions_that_nobody_can_take_are_refused_and_change_nothing(action, message):
    env = make_env(IPD)
    env.reset()
    before = {name: value.clone() for name, value in env.state_dict().items()}
    agents = {} if action is None else {"action": action}
    group = TensorDict({"observation": torch.zeros(1, 2, 5)}, [1, 2])
    carried = TensorDict({"agents": group}, [1])
    group._tensordict.update(agents)  # past tensordict's own check of shapes
    with pytest.raises(ValueError, match=message):
        env.step_and_maybe_reset(carried)
    assert all(torch.equal(value, before[name]) for name, value in env.state_dict().items())


SMALL = DQNSettings(
    hidden_cells=(8,), learning_starts=8, buffer_size=50, batch_size=4, target_every_episodes=1
)
EXPERIMENT = Experiment(
    name="dilemma",
    game=prisoners_dilemma(turns=5),
    agents=[
        Learning(DQN(settings=SMALL)),
        Learning(PPO(settings=RolloutSettings(rollout_steps=10, minibatch_size=5, hidden_cells=(8,)))),
    ],
    replicas=2,
    episodes=8,
    evaluation_episodes=3,
    engine="eager",
)


def test_its_recipe_holds_it_and_gives_it_back_without_importing_anything():
    table = json.loads(json.dumps(EXPERIMENT.to_recipe()))
    assert table["experiment"]["game"] == {
        "kind": "MatrixGame",
        "payoffs": [[[-1, -1], [-3, 0]], [[0, -3], [-2, -2]]],
        "turns": 5,
        "memory": None,
        "continue_prob": 1,
    }
    back = Experiment.from_recipe(table)
    assert back == EXPERIMENT
    assert back.game == EXPERIMENT.game
    assert hash(back.game) == hash(EXPERIMENT.game)
    assert changes(EXPERIMENT, replace(EXPERIMENT, game=prisoners_dilemma(turns=6))) == [
        "experiment.game.turns was 5, is 6"
    ]


def test_a_subclass_of_the_users_own_is_kept_by_its_name():
    game = Custom("cprl.envs.matrix:prisoners_dilemma", arguments={"turns": 2})
    assert make_env(game).game == prisoners_dilemma(turns=2)


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
    assert -15 <= value <= 0  # five turns of -3 to 0
    second = cprl.load(cprl.run(replace(EXPERIMENT, seed=9), tmp_path / "second", watch="off"))
    played = cprl.crossplay([loaded, second], episodes=2)
    assert played.cell("whole", "second").measures()["focal/return"].estimate is not None
    with pytest.raises(ValueError, match=r"plays a game that reports no harvest; allowed in a report"):
        write_report([whole], tmp_path / "report")
    third = cprl.load(cprl.run(replace(EXPERIMENT, game=chicken(turns=5)), tmp_path / "third", watch="off"))
    with pytest.raises(ValueError, match=r"have different games: MatrixGame.payoffs"):
        cprl.crossplay([loaded, third], episodes=2)


def test_two_matrix_games_differ_in_the_fields_that_differ():
    assert differences(IPD, prisoners_dilemma(turns=4)) == ["MatrixGame.turns 3 and 4"]


def test_a_study_varies_its_payoffs_and_turns():
    other = stag_hunt().payoffs
    study = Study(EXPERIMENT, {"game.turns": [1, 5], "game.payoffs": [EXPERIMENT.game.payoffs, other]})
    found = {(own.experiment.game.turns, own.experiment.game.payoffs) for own in trials_of(study)}
    assert found == {(turns, table) for turns in (1, 5) for table in (EXPERIMENT.game.payoffs, other)}


def test_its_numbers_are_flags_of_a_command_line():
    words = ["mine", "--game.turns", "7", "--game.memory", "2", "--game.continue-prob", "0.5"]
    experiment, _ = parse(lambda: EXPERIMENT, words)
    assert experiment.game == replace(EXPERIMENT.game, turns=7, memory=2, continue_prob=0.5)


def test_scripted_policies_that_read_a_window_are_refused():
    with pytest.raises(ValueError, match=r"Scripted\('greedy'\) reads the window of a cprl.Game"):
        cprl.run(replace(EXPERIMENT, agents=[Scripted("greedy"), Scripted()]), "never")


@pytest.mark.slow
def test_dqn_learns_to_defect_in_the_one_shot_dilemma(tmp_path):
    """Defection is dominant, so five of five pairs end there: -2 each (a theorem, not a published figure)."""
    settings = replace(SMALL, learning_rate=1e-2, buffer_size=1000, epsilon_decay_steps=500)
    settings = replace(settings, epsilon_evaluation=0.0)
    experiment = replace(
        EXPERIMENT,
        game=prisoners_dilemma(),
        agents=[Learning(DQN(settings=settings))] * 2,
        replicas=5,
        episodes=2000,
    )
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    episodes = cprl.evaluate_run(run, episodes=5).trained
    assert all(own.return_.tolist() == [-2.0, -2.0] for replica in episodes.values() for own in replica)
