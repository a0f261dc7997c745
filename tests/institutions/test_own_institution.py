"""Institutions of a user's own, in the examples: what they take, and how they are resumed."""

import importlib
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from places import ROOT
from same_runs import assert_same_training

import cprl
from cprl import Custom, Experiment, Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.envs import make_env
from cprl.institutions import Tax
from cprl.population import Learning
from cprl.runs.checkpoints import checkpoints_in
from cprl.runs.episodes import read_episodes
from cprl.runs.weights import load_weights

ALLOW = ("licence:Licence", "own_parts:Stopping")
BOARD = maps.parse("A>..<.A\n.......\nA.....A")


@pytest.fixture(params=["licence"])
def licence(request, tmp_path, monkeypatch):
    """An example as a module where a user would have it."""
    shutil.copy(ROOT / "examples" / f"{request.param}.py", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield importlib.import_module(request.param)
    del sys.modules[request.param]


def game(**rules):
    return Game(
        map=BOARD,
        rules=Rules(**{"regrow_prob": (0.0, 0.2), "episode_steps": 20, "freeze_steps": 1, **rules}),
        institutions=(Tax(rate=0.5, redistribution="none"),),
    )


@pytest.mark.parametrize("institutions", [game().institutions, ()], ids=["governed", "ungoverned"])
def test_the_first_shot_of_each_episode_is_charged_and_the_price_rises_with_every_licence(
    licence, institutions
):
    of_three_turns = replace(game(episode_steps=3), institutions=institutions)
    env = make_env(of_three_turns, worlds=2, transforms=[licence.Licence(fee=1.0, rise=0.25)])
    beam, stay = 6, 7
    plan = [[beam, stay], [beam, stay], [stay, beam]] * 2
    now, steps = env.reset(), []
    for mine in plan:
        now["agents", "action"] = torch.tensor([mine, [stay, stay]])
        step, now = env.step_and_maybe_reset(now)
        steps.append(step["next", "agents"])
    steps = torch.stack(steps, 1)
    # Nobody harvests. Agent 0 of world 0 buys the first licence at 1; in its second shot it has one. It tags
    # agent 1, which misses turn 2 and buys the second in turn 3, at 1 + 1 x 0.25. The next episode begins
    # without licences: the third costs 1 + 2 x 0.25, the fourth 1 + 3 x 0.25.
    fines = [[1.0, 0.0], [0.0, 0.0], [0.0, 1.25], [1.5, 0.0], [0.0, 0.0], [0.0, 1.75]]
    assert steps["fines"][0].tolist() == fines
    assert steps["fines"][1].tolist() == [[0.0, 0.0]] * 6, "world 1 is peaceful"
    assert torch.equal(steps["reward"][..., 0], steps["harvest"] - steps["fines"] + steps["transfers"])


def experiment(**changes):
    settings = DQNSettings(
        buffer_size=300, batch_size=4, hidden_cells=(8,), epsilon_hold_steps=10, epsilon_decay_steps=200
    )
    licensed = Experiment(
        name="licensed",
        game=game(),
        agents=[Learning(DQN(settings=settings))] * 2,
        replicas=2,
        episodes=6,
        seed=3,
        evaluation_episodes=2,
        transforms=[Custom("licence:Licence", arguments={"fee": 1.0, "rise": 0.25})],
        callbacks=[Custom("own_parts:Stopping")],
        engine="eager",
    )
    return replace(licensed, **changes)


@pytest.mark.integration
def test_a_run_that_is_stopped_and_resumed_equals_the_undisturbed_one_bit_for_bit(
    licence, tmp_path, stopped, capsys
):
    whole = cprl.run(experiment(), tmp_path / "whole", watch="off")
    stopped(51, experiment(), tmp_path / "parts")  # between two turns of the third episode
    (checkpoint,) = checkpoints_in(tmp_path / "parts" / "checkpoints")
    kept = load_weights(checkpoint)
    assert kept["carried"]["agents"]["licensed"].any(), "licences of the episode that was stopped"
    assert kept["env"]["transforms"]["transforms.0.sold"] > 0, "and all that were sold before"
    parts = cprl.run(experiment(), tmp_path / "parts", watch="off", resume=True)
    assert_same_training(parts, whole, ("final", "transforms"))
    cprl.trust(*ALLOW)
    one, two = (cprl.evaluate_run(run, cprl.Fresh(episodes=2)) for run in (parts, whole))
    assert repr(one.to_pydict()) == repr(two.to_pydict())
    assert cprl.load(parts).experiment == experiment()


@pytest.mark.integration
def test_what_an_own_rule_takes_is_measured_in_a_game_without_institutions(licence, tmp_path, capsys):
    alone = experiment(game=replace(game(), institutions=()), callbacks=())
    run = cprl.run(alone, tmp_path / "run", watch="off")
    assert "licence:Licence (fee 1.0, rise 0.25)" in " ".join(capsys.readouterr().out.split())
    table = read_episodes(run)
    assert sum(table["fines"].to_pylist()) > 0
    income = np.array(table["harvest"]) - np.array(table["fines"]) + np.array(table["transfers"])
    np.testing.assert_allclose(np.array(table["return"]), income, atol=1e-5)
    cprl.trust(*ALLOW)
    measured = cprl.estimates(cprl.evaluate_run(run, cprl.Fresh(episodes=2)), by="policy")
    assert measured["random", "institutions/fines"].value > 0
    assert ("random", "income_equality") in measured


@pytest.mark.integration
@pytest.mark.parametrize("licence", ["stop_bites"], indirect=True)
@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_a_transform_stops_bites_in_a_training_by_putting_apples_back(licence, engine, tmp_path):
    reserved = experiment(
        game=replace(game(regrow_prob=(0.0,), episode_steps=40, may_fire=False), institutions=()),
        transforms=[Custom("stop_bites:Reserve", arguments={"least": 3})],
        callbacks=(),
        engine=engine,
    )
    cprl.trust("stop_bites:Reserve")
    run = cprl.run(reserved, tmp_path / "run", watch="off")
    table = read_episodes(run)
    assert table["return"].to_pylist() == table["harvest"].to_pylist()
    assert min(table["stock_left"].to_pylist()) == 3, "some episode came down to what is kept, none below"
    assert set(table["steps"].to_pylist()) == {40}, "with apples left, only the clock ends an episode"
    together = [sum(pair) for pair in zip(*[iter(table["harvest"].to_pylist())] * 2, strict=True)]
    left = table["stock_left"].to_pylist()[::2]
    assert together == [len(BOARD.sites) - stock for stock in left]
