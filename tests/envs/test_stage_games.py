"""Matrix games and games of people who share: payments, what is seen, the clock, experiments of them.

They are games of one's own, of recipes/study/theory: all that they show, any user's game can.
"""

import json
from dataclasses import replace
from itertools import product
from operator import attrgetter

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from matrix_games import MatrixGame, chicken, matching_pennies, prisoners_dilemma, stag_hunt
from report import write_report
from restorable import assert_restorable
from same_runs import assert_same_training
from sharing_games import CallableWorth, PowerWorth, SharingGame, appropriation, herders
from taking_games import TakingGame
from tensordict import TensorDict, assert_close
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
from cprl.commands.recipe_command import parse_command
from cprl.envs import make_env, spaces_of
from cprl.experiment import changes
from cprl.measuring.table import by_replica, where
from cprl.population import Learning, Team
from cprl.studies.trials import trials_of

DONES = ("done", "terminated", "truncated")
IPD = prisoners_dilemma(turns=3)
THREE = MatrixGame(torch.arange(24.0).reshape(2, 2, 2, 3), turns=2)
"""Three agents; joint action (a, b, c) pays agent n 3 * (4a + 2b + c) + n."""
LAB = TakingGame(appropriation(), turns=3)
"""Eight agents; action k puts k / 2 tokens into the resource."""
PAIR = TakingGame(herders(2), levels=5, most=2.0, turns=3)
"""Two herders; action k grazes k / 2 animals."""
CHANCY = TakingGame(herders(3), turns=4, memory=2, continue_prob=0.6)
STEEP = CallableWorth(function=lambda total: 8 - total**3, most=2)


EITHER_GAME = pytest.mark.parametrize("game", [IPD, PAIR], ids=["matrix", "taking"])


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


C, D = 0, 1


def number_seen(moment):
    """The number of the joint action that each agent sees, [B][N]."""
    return moment["agents", "observation"].argmax(-1).tolist()


EACH_PAIR = ((C, C), (C, D), (D, C), (D, D))


@pytest.mark.parametrize(
    ("game", "actions", "paid"),
    [
        # What was published.
        (prisoners_dilemma(), EACH_PAIR, [[-1, -1], [-3, 0], [0, -3], [-2, -2]]),
        (
            prisoners_dilemma(reward=3, sucker=0, temptation=4, punishment=1),
            EACH_PAIR,
            [[3, 3], [0, 4], [4, 0], [1, 1]],
        ),
        (stag_hunt(), EACH_PAIR, [[4, 4], [0, 3], [3, 0], [1, 1]]),
        (chicken(), EACH_PAIR, [[3, 3], [1, 4], [4, 1], [0, 0]]),
        (matching_pennies(), EACH_PAIR, [[1, -1], [-1, 1], [-1, 1], [1, -1]]),
        (THREE, ((1, 0, 1), (0, 1, 0)), [[15, 16, 17], [6, 7, 8]]),  # 3 * (4 + 1), 3 * 2
        # Animals 0.5 and 1.5: A = 2, v(2) = 10 - 4 = 6, less 1 each. 2 and 2: v(4) = 0, an animal costs 1.
        (PAIR, ((1, 3), (4, 4), (0, 4)), [[2.5, 7.5], [-2, -2], [0, 10]]),
        (TakingGame(herders(2, cost=11), levels=3, most=1.0), ((1, 2),), [[-1.625, -3.25]]),
        # 8 tokens each: F(64) = 23 * 64 - 0.25 * 64^2 = 448, an eighth is 56, and 2 tokens outside pay 10.
        # None in the resource: 10 tokens outside pay 50. 9 each: X = 72, v = 23 - 18 = 5, as outside.
        (LAB, ((16,) * 8, (0,) * 8, (18,) * 8), [[66] * 8, [50] * 8, [50] * 8]),
        # Half put in 4 and half 5: X = 36 is best for all, v = 14, 9 more than outside a token.
        (LAB, ((8, 10) * 4,), [[86, 95] * 4]),
    ],
)
def test_joint_actions_pay_what_was_published_or_is_worked_by_hand(game, actions, paid):
    assert rewards(game, *actions) == paid


def test_agents_see_the_last_joint_action_from_their_own_side():
    env = make_env(IPD)
    moment = env.reset()
    assert moment["agents", "observation"][0].tolist() == [[0, 0, 0, 0, 1]] * 2, "none yet"
    _, moment = step(env, moment, (D, C))
    assert moment["agents", "observation"][0].tolist() == [[0, 0, 1, 0, 0], [0, 1, 0, 0, 0]]
    _, moment = step(env, moment, (D, D))
    assert number_seen(moment) == [[3, 3]]


def test_of_three_agents_each_sees_its_own_action_first():
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
    return [episodes_of_world[:episodes] for episodes_of_world in found]


def test_with_a_probability_to_continue_episodes_terminate_by_chance_or_are_truncated_by_the_clock():
    env = make_env(prisoners_dilemma(turns=6, continue_prob=0.75), worlds=100)
    found = [episode for world in lengths(env, 20) for episode in world]
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
def test_rewards_are_the_payoffs_of_the_theory_and_its_equilibrium_can_be_taken(game, seed):
    action = np.random.default_rng(seed).integers(0, game.levels, (4, game.agents))
    env = make_env(game, worlds=4)
    now, _ = step(env, env.reset(), *action.tolist())
    expected = game.sharing.payoffs(np.array(game.amounts)[action])
    assert np.allclose(now["next", "agents", "reward"][..., 0], expected, rtol=1e-6, atol=1e-6)
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


def test_a_worth_of_the_users_own_is_a_game_by_the_name_of_the_function_that_makes_it():
    with pytest.raises(ValueError, match=r"^SharingGame\.worth\.function is a function, which a recipe"):
        replace(HERDERS, game=own_game())
    experiment = replace(HERDERS, game=Custom("test_stage_games:own_game"))
    cprl.trust("test_stage_games:own_game")
    back = Experiment.from_recipe(experiment.to_recipe())
    assert make_env(back.game).game == own_game()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MatrixGame(((1.0, 2.0), (3.0, 4.0))), r"MatrixGame.payoffs has the shape \[2, 2\]"),
        (lambda: MatrixGame(np.zeros((2, 3, 2))), r"MatrixGame.payoffs has the shape"),
        (lambda: MatrixGame(np.zeros((1, 1, 2))), r"MatrixGame.payoffs has the shape"),
        (lambda: MatrixGame(np.full((2, 2, 2), np.inf)), r"MatrixGame.payoffs has inf"),
        (lambda: MatrixGame(np.zeros((300, 300, 2))), r"MatrixGame.payoffs has 180,000 numbers"),
        (lambda: MatrixGame((((1, 1), (1, 1)), ((1, 1), (1,)))), r"MatrixGame.payoffs"),
        (lambda: replace(IPD, turns=1, continue_prob=0.5), r"MatrixGame.continue_prob is 0.5"),
        (lambda: prisoners_dilemma(temptation=-1.5), "temptation > reward > punishment > sucker"),
        (lambda: stag_hunt(temptation=5), "reward > temptation > sucker"),
        (lambda: chicken(punishment=2), "temptation > reward > sucker > punishment"),
        (lambda: matching_pennies(stake=0), "stake is 0"),
        (lambda: replace(LAB, most=10.5), r"TakingGame.most is 10.5"),
        (lambda: replace(LAB, most=0), "TakingGame.most is 0"),
        (lambda: TakingGame(herders(2, cost=11)), r"TakingGame.most is None"),
        (lambda: replace(LAB, levels=1), "TakingGame.levels is 1"),
        (lambda: TakingGame(herders(10**6)), r"TakingGame.levels is 21; allowed for 1,000,000 agents"),
        (lambda: replace(LAB, turns=1, continue_prob=0.5), r"TakingGame.continue_prob is 0.5"),
    ],
)
def test_games_that_cannot_be_played_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@EITHER_GAME
def test_a_game_of_one_turn_shows_the_number_one_and_terminates(game):
    env = make_env(replace(game, turns=1), worlds=2)
    now, moment = step(env, env.reset(), (0, 1), (1, 1))
    assert [now["next", name].tolist() for name in DONES] == [[[True]] * 2, [[True]] * 2, [[False]] * 2]
    assert moment["agents", "observation"].tolist() == [[[1.0]] * 2] * 2
    assert not moment["done"].any()
    assert make_env(replace(game, memory=0)).reset()["agents", "observation"].shape == (1, 2, 1)


@EITHER_GAME
def test_a_repeated_game_is_truncated_by_its_clock_and_begins_again(game):
    env = make_env(game)
    moment, found = env.reset(), []
    for _ in range(4):
        now, moment = step(env, moment, (0, 1))
        found.append([now["next", name].item() for name in DONES])
    on = [False] * 3
    assert found == [on, on, [True, False, True], on]


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize(
    "game",
    [
        *(prisoners_dilemma(), IPD, THREE, prisoners_dilemma(turns=9, memory=3, continue_prob=0.5)),
        *(MatrixGame([[1.0], [0.0]]), replace(LAB, turns=1), LAB, CHANCY, own_game()),
    ],
)
def test_it_is_an_environment_of_torchrl_that_can_be_put_where_it_was(game, worlds):
    env = make_env(game, worlds=worlds)
    check_env_specs(env)
    moment = env.step(env.rand_action(env.reset()))
    assert moment["agents", "action"].dtype == torch.int64
    assert moment["next", "agents", "reward"].shape == (worlds, game.agents, 1)
    assert_restorable(lambda: make_env(game, worlds=worlds))
    spaces = spaces_of(env)
    assert (spaces.agents, spaces.actions, spaces.observation_dtype) == (game.agents, game.actions, "float32")
    assert spaces.observation_scale == 1.0


@pytest.mark.parametrize("game", [prisoners_dilemma(turns=4, continue_prob=0.6), CHANCY])
def test_what_was_returned_never_changes_later(game):
    env = make_env(game, worlds=4, seed=2)
    torch.manual_seed(0)
    moment = env.reset()
    returned, copies = [moment], [moment.clone()]
    for _ in range(60):
        now, moment = env.step_and_maybe_reset(moment.update(env.action_spec.rand()))
        returned += [now["next"], moment]
        copies += [now["next"].clone(), moment.clone()]
    assert sum(int(entry["done"].sum()) for entry in returned) > 4
    for entry, copy in zip(returned, copies, strict=True):
        # Actions, and what follows, are written into the carried entry by design.
        assert_close(*(each.exclude(("agents", "action"), "next") for each in (entry, copy)))


@EITHER_GAME
@settings(max_examples=15, deadline=None)
@given(worlds=st.integers(2, 5), world=st.integers(0, 4), seed=st.integers(0, 2**32 - 1))
def test_a_world_does_not_notice_its_neighbours(game, worlds, world, seed):
    world %= worlds
    game = replace(game, turns=5, continue_prob=0.7, memory=2)
    actions = torch.randint(2, (8, worlds, 2), generator=torch.Generator().manual_seed(seed))
    many = rolled(make_env(game, worlds=worlds, seed=seed), actions)
    alone = rolled(make_env(game, seed=seed, first_world=world), actions[:, world : world + 1])
    for moment, lone in zip(many, alone, strict=True):
        assert_close(moment[world : world + 1], lone, rtol=0, atol=0)


def rolled(env, actions):
    """What each step returned."""
    moment, steps = env.reset(), []
    for joint in actions:
        step, moment = env.step_and_maybe_reset(moment.set(("agents", "action"), joint))
        steps.append(step)
    return steps


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.tensor([[0, 5]]), r"has numbers from 0 to 5; allowed: 0 to"),
        (torch.tensor([[-1, 0]]), r"has numbers from -1 to 0"),
        (torch.tensor([[0.0, 1.0]]), r"is torch.float32 \[1, 2\]; allowed: int64 \[1, 2\]"),
        (torch.tensor([[0]]), r"is torch.int64 \[1, 1\]; allowed: int64 \[1, 2\]"),
        (None, r"is missing"),
    ],
)
@EITHER_GAME
def test_actions_that_nobody_can_take_are_refused_and_change_nothing(game, action, message):
    env = make_env(game)
    group = env.reset()["agents"]
    before = {name: value.clone() for name, value in env.state_dict().items()}
    carried = TensorDict({"agents": group}, [1])
    group._tensordict.update({} if action is None else {"action": action})  # past tensordict's own check
    with pytest.raises(ValueError, match=message):
        env.step_and_maybe_reset(carried)
    assert all(torch.equal(value, before[name]) for name, value in env.state_dict().items())


SMALL = DQNSettings(
    hidden_cells=(8,), learning_starts=8, buffer_size=50, batch_size=4, target_every_episodes=1
)
ROLLOUTS = RolloutSettings(rollout_steps=10, minibatch_size=5, hidden_cells=(8,))
DILEMMA = Experiment(
    name="dilemma",
    game=prisoners_dilemma(turns=5),
    agents=[Learning(DQN(settings=SMALL)), Learning(PPO(settings=ROLLOUTS))],
    replicas=2,
    episodes=8,
    evaluation_episodes=3,
    engine="eager",
)
HERDERS = replace(
    DILEMMA,
    name="herders",
    game=replace(PAIR, turns=5),
    agents=[Learning(DQN(settings=SMALL)), Learning(PPO(settings=ROLLOUTS), reward="team")],
)
DEARER = replace(HERDERS, game=replace(HERDERS.game, sharing=herders(2, cost=2.0)))


MATRIX, TAKING = "matrix_games:MatrixGame", "taking_games:TakingGame"
SHARING = {
    "agents": 2,
    "worth": {"top": 10, "factor": 1, "power": 2},
    "cost": 1,
    "most_each": None,
    "payment": 0,
}


@pytest.mark.parametrize(
    ("experiment", "target", "arguments", "other", "change"),
    [
        (
            DILEMMA,
            MATRIX,
            {"payoffs": [[[-1, -1], [-3, 0]], [[0, -3], [-2, -2]]]},
            replace(DILEMMA, game=prisoners_dilemma(turns=6)),
            "experiment.game.arguments.turns was 5, is 6",
        ),
        (
            HERDERS,
            TAKING,
            {"sharing": SHARING, "levels": 5, "most": 2},
            DEARER,
            "experiment.game.arguments.sharing.cost was 1.0, is 2.0",
        ),
    ],
    ids=["matrix", "taking"],
)
def test_its_recipe_holds_it_by_the_name_of_its_class_and_gives_it_back(
    experiment, target, arguments, other, change
):
    recipe = json.loads(json.dumps(experiment.to_recipe()))
    whole = {**arguments, "turns": 5, "memory": None, "continue_prob": 1}
    assert recipe["experiment"]["game"] == {"kind": "Custom", "target": target, "arguments": whole}
    with pytest.raises(ValueError, match=f"--allow {target}"):
        Experiment.from_recipe(recipe)
    cprl.trust(target)
    back = Experiment.from_recipe(recipe)
    assert back == experiment
    assert (back.game, hash(back.game)) == (experiment.game, hash(experiment.game))
    assert changes(experiment, other) == [change]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("experiment", "third", "least", "most", "differing"),
    [
        # Five turns of -3 to 0.
        (DILEMMA, replace(DILEMMA, game=chicken(turns=5)), -15, 0, "MatrixGame.arguments.payoffs"),
        # Two animals bring 10 alone, and -2 where the other has two too.
        (HERDERS, DEARER, -10, 50, "TakingGame.arguments.sharing"),
    ],
    ids=["matrix", "taking"],
)
def test_a_population_trains_stops_resumes_loads_and_meets_another(
    experiment, third, least, most, differing, tmp_path, stopped, capsys
):
    stopping = replace(experiment, callbacks=[Custom("own_parts:Stopping")])
    whole = cprl.run(stopping, tmp_path / "whole", watch="off")
    assert "left out" in capsys.readouterr().out
    stopped(23, stopping, tmp_path / "parts")
    parts = cprl.run(stopping, tmp_path / "parts", watch="off", resume=True)
    assert_same_training(parts, whole)
    cprl.trust("own_parts:Stopping", MATRIX, TAKING)
    loaded = cprl.load(whole)
    assert loaded.game == experiment.game
    found = cprl.estimates(cprl.evaluate_run(loaded, cprl.Fresh(episodes=4)), "agent_0/return", by="policy")
    assert least <= found["trained", "agent_0/return"].value <= most
    second = cprl.load(cprl.run(replace(experiment, seed=9), tmp_path / "second", watch="off"))
    played = cprl.crossplay([loaded, second], cprl.Fresh(episodes=2))
    levels = cprl.estimates(played, "focal/return", by=("focal", "background"))
    assert levels["whole", "second", "focal/return"].replicas
    with pytest.raises(ValueError, match=r"plays a game that reports no harvest; allowed in a report"):
        write_report([whole], tmp_path / "report")
    other_game = cprl.load(cprl.run(third, tmp_path / "third", watch="off"))
    with pytest.raises(ValueError, match=rf"have different games: {differing}"):
        cprl.crossplay([loaded, other_game], cprl.Fresh(episodes=2))


@pytest.mark.parametrize(
    ("experiment", "factors"),
    [
        (DILEMMA, {"game.turns": [1, 5], "game.payoffs": [DILEMMA.game.payoffs, stag_hunt().payoffs]}),
        (HERDERS, {"game.sharing.cost": [1.0, 2.0], "game.levels": [5, 9]}),
    ],
    ids=["matrix", "taking"],
)
def test_a_study_varies_payoffs_turns_costs_and_levels(experiment, factors):
    games = [trial.experiment.game for trial in trials_of(Study(experiment, factors))]
    fields = [attrgetter(name.removeprefix("game.")) for name in factors]
    assert {tuple(field(game) for field in fields) for game in games} == set(product(*factors.values()))


def test_their_numbers_are_flags_of_a_command_line():
    words = ["mine", "--game.turns", "7", "--game.memory", "2", "--game.continue-prob", "0.5"]
    experiment, _ = parse_command(lambda: DILEMMA, words)
    assert experiment.game == replace(DILEMMA.game, turns=7, memory=2, continue_prob=0.5)
    words = ["mine", "--game.turns", "7", "--game.sharing.cost", "2", "--game.sharing.worth.top", "9"]
    experiment, _ = parse_command(lambda: HERDERS, words)
    sharing = SharingGame(agents=2, worth=PowerWorth(top=9.0), cost=2.0)
    assert experiment.game == replace(HERDERS.game, turns=7, sharing=sharing)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("agents", "engine"),
    [
        pytest.param([Learning(Tabular(settings=TabularSettings()))] * 2, "eager", id="tables"),
        pytest.param(DILEMMA.agents, "torchrl", marks=pytest.mark.slow, id="stock TorchRL"),
        pytest.param(
            *([Team(LOLA(settings=LOLASettings(rollout_steps=2, hidden_cells=(4,))), (0, 1))], "eager"),
            marks=pytest.mark.slow,
            id="LOLA",
        ),
    ],
)
def test_learners_of_every_kind_play_it(agents, engine, tmp_path):
    cprl.trust(TAKING)
    experiment = replace(HERDERS, agents=agents, episodes=3, engine=engine)
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    found = cprl.estimates(cprl.evaluate_run(run, cprl.Fresh(episodes=2)), "agent_1/return", by="policy")
    assert -10 <= found["trained", "agent_1/return"].value <= 50


@pytest.mark.slow
def test_independent_tables_end_at_the_equilibrium_and_one_agent_at_the_optimum(tmp_path):
    """One agent takes 36 of 72 tokens; two, where each knows only what it got, 24 each."""
    cprl.trust(TAKING)
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
        played = where(cprl.evaluate_run(run, cprl.Fresh(episodes=1)), policy="trained")
        paid = by_replica(played, "income")["value"].to_numpy().mean() / 50
        rent = paid - agents * sharing.payment
        assert rent == pytest.approx(sharing.surplus(total), rel=0.03)


@pytest.mark.slow
def test_dqn_learns_to_defect_in_the_one_shot_dilemma(tmp_path):
    """Defection is dominant, so five of five pairs end there: -2 each (a theorem, not a published figure)."""
    cprl.trust(MATRIX)
    settings = replace(
        SMALL, learning_rate=1e-2, buffer_size=1000, epsilon_decay_steps=500, epsilon_evaluation=0.0
    )
    agents = [Learning(DQN(settings=settings))] * 2
    experiment = replace(DILEMMA, game=prisoners_dilemma(), agents=agents, replicas=5, episodes=2000)
    run = cprl.load(cprl.run(experiment, tmp_path / "run", watch="off"))
    played = where(cprl.evaluate_run(run, cprl.Fresh(episodes=5)), policy="trained")
    assert set(played["return"].to_pylist()) == {-2.0}
