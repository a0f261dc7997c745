"""What matrix games and games of taking share: clock, memory, specs, and that experiments play them."""

import json
from dataclasses import replace
from itertools import product
from operator import attrgetter

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from report import write_report
from restorable import assert_restorable
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

import cprl
from cprl import Custom, Experiment, Study
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.commands.recipe import parse
from cprl.envs import make_env, spaces_of
from cprl.envs.matrix import MatrixEnv, MatrixGame, chicken, prisoners_dilemma, stag_hunt
from cprl.envs.taking import TakingEnv, TakingGame
from cprl.evaluation.evaluate import differences
from cprl.experiment import changes
from cprl.population import Learning, Scripted
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights
from cprl.studies.trials import trials_of
from cprl.system.compat import LeanStepEnv
from cprl.theory import CallableWorth, PowerWorth, SharingGame, appropriation, herders

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


@pytest.mark.parametrize(
    ("kind", "game"),
    [
        (MatrixEnv, prisoners_dilemma(turns=4, continue_prob=0.6)),
        (TakingEnv, replace(PAIR, turns=4, continue_prob=0.6)),
        (TakingEnv, CHANCY),
    ],
)
def test_the_lean_step_equals_torchrls_own(kind, game):
    class Stock(kind):
        _step_and_maybe_reset = EnvBase._step_and_maybe_reset

    assert kind._step_and_maybe_reset is LeanStepEnv._step_and_maybe_reset
    lean, stock = (made(game, 4, seed=3) for made in (kind, Stock))
    torch.manual_seed(0)
    actions = [lean.action_spec["agents", "action"].rand() for _ in range(30)]
    steps, copies = rolled(lean, actions)
    others, _ = rolled(stock, actions)
    for step, copy, other in zip(steps, copies, others, strict=True):
        assert_equal(step, other)
        assert_equal(step, copy)  # what was returned never changes


def assert_equal(one, other):
    entries, others = (dict(moment.items(True, True)) for moment in (one, other))
    assert entries.keys() == others.keys()
    for name in entries:
        assert torch.equal(entries[name], others[name]), name


@EITHER_GAME
@settings(max_examples=15, deadline=None)
@given(worlds=st.integers(2, 5), world=st.integers(0, 4), seed=st.integers(0, 2**32 - 1))
def test_a_world_does_not_notice_its_neighbours(game, worlds, world, seed):
    world %= worlds
    game = replace(game, turns=5, continue_prob=0.7, memory=2)
    actions = torch.randint(2, (8, worlds, 2), generator=torch.Generator().manual_seed(seed))
    many, _ = rolled(make_env(game, worlds=worlds, seed=seed), actions)
    alone, _ = rolled(make_env(game, seed=seed, first_world=world), actions[:, world : world + 1])
    for moment, lone in zip(many, alone, strict=True):
        assert_equal(moment[world : world + 1], lone)


def rolled(env, actions):
    """What each step returned, and was then; the last entry is what would be carried on."""
    moment, steps, copies = env.reset(), [], []
    for joint in actions:
        step, moment = env.step_and_maybe_reset(moment.set(("agents", "action"), joint))
        steps.append(step)
        copies.append(step.clone())
    last = moment.exclude(("agents", "action"))  # which is overwritten
    return [*steps, last], [*copies, last.clone()]


@EITHER_GAME
def test_a_chance_to_continue_needs_several_turns(game):
    with pytest.raises(ValueError, match=rf"{type(game).__name__}.continue_prob is 0.5"):
        replace(game, turns=1, continue_prob=0.5)


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


SHARING = {
    "kind": "SharingGame",
    "agents": 2,
    "worth": {"kind": "PowerWorth", "top": 10, "factor": 1, "power": 2},
    "cost": 1,
    "most_each": None,
    "payment": 0,
}


@pytest.mark.parametrize(
    ("experiment", "table", "other", "change"),
    [
        (
            DILEMMA,
            {"kind": "MatrixGame", "payoffs": [[[-1, -1], [-3, 0]], [[0, -3], [-2, -2]]]},
            replace(DILEMMA, game=prisoners_dilemma(turns=6)),
            "experiment.game.turns was 5, is 6",
        ),
        (
            HERDERS,
            {"kind": "TakingGame", "sharing": SHARING, "levels": 5, "most": 2},
            DEARER,
            "experiment.game.sharing.cost was 1.0, is 2.0",
        ),
    ],
    ids=["matrix", "taking"],
)
def test_its_recipe_holds_it_and_gives_it_back_without_importing_anything(experiment, table, other, change):
    recipe = json.loads(json.dumps(experiment.to_recipe()))
    assert recipe["experiment"]["game"] == {**table, "turns": 5, "memory": None, "continue_prob": 1}
    back = Experiment.from_recipe(recipe)
    assert back == experiment
    assert (back.game, hash(back.game)) == (experiment.game, hash(experiment.game))
    assert changes(experiment, other) == [change]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("experiment", "third", "least", "most", "differing"),
    [
        (DILEMMA, replace(DILEMMA, game=chicken(turns=5)), -15, 0, "MatrixGame.payoffs"),  # turns of -3 to 0
        # Two animals bring 10 alone, and -2 where the other has two too.
        (HERDERS, DEARER, -10, 50, "TakingGame.sharing"),
    ],
    ids=["matrix", "taking"],
)
def test_a_population_trains_stops_resumes_loads_and_meets_another(
    experiment, third, least, most, differing, tmp_path, monkeypatch, capsys
):
    stopping = replace(experiment, callbacks=[Custom("one_road_parts:Stopping")])
    whole = cprl.run(stopping, tmp_path / "whole", watch="off")
    assert "left out" in capsys.readouterr().out
    monkeypatch.setenv("STOP_AT_STEP", "23")
    with pytest.raises(SystemExit):
        cprl.run(stopping, tmp_path / "parts", watch="off")
    monkeypatch.delenv("STOP_AT_STEP")
    parts = cprl.run(stopping, tmp_path / "parts", watch="off", resume=True)
    assert read_episodes(parts).equals(read_episodes(whole))
    one, other = (load_weights(run / "checkpoints" / "final.pt") for run in (parts, whole))
    assert repr(one) == repr(other)
    loaded = cprl.load(whole, allow=["one_road_parts:Stopping"])
    assert loaded.game == experiment.game
    value = cprl.evaluate_run(loaded, episodes=4).measures()["agent_0/return"].estimate.value
    assert least <= value <= most
    second = cprl.load(cprl.run(replace(experiment, seed=9), tmp_path / "second", watch="off"))
    played = cprl.crossplay([loaded, second], episodes=2)
    assert played.cell("whole", "second").measures()["focal/return"].estimate is not None
    with pytest.raises(ValueError, match=r"plays a game that reports no harvest; allowed in a report"):
        write_report([whole], tmp_path / "report")
    other_game = cprl.load(cprl.run(third, tmp_path / "third", watch="off"))
    with pytest.raises(ValueError, match=rf"have different games: {differing}"):
        cprl.crossplay([loaded, other_game], episodes=2)


@EITHER_GAME
def test_two_games_differ_in_the_fields_that_differ(game):
    assert differences(game, replace(game, turns=4)) == [f"{type(game).__name__}.turns 3 and 4"]


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
    experiment, _ = parse(lambda: DILEMMA, words)
    assert experiment.game == replace(DILEMMA.game, turns=7, memory=2, continue_prob=0.5)
    words = ["mine", "--game.turns", "7", "--game.sharing.cost", "2", "--game.sharing.worth.top", "9"]
    experiment, _ = parse(lambda: HERDERS, words)
    sharing = SharingGame(agents=2, worth=PowerWorth(top=9.0), cost=2.0)
    assert experiment.game == replace(HERDERS.game, turns=7, sharing=sharing)


@pytest.mark.parametrize("experiment", [DILEMMA, HERDERS], ids=["matrix", "taking"])
def test_scripted_policies_that_read_a_window_are_refused(experiment):
    with pytest.raises(ValueError, match=r"Scripted\('greedy'\) reads the window of a cprl.Game"):
        cprl.run(replace(experiment, agents=[Scripted("greedy"), Scripted()]), "never")
