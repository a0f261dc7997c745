"""Recipes run, in miniature, and keep what they promise."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import pytest

from cprl import CommonsEnv, Map, Rules, presets
from cprl.acting import RandomActor, Seats
from cprl.learning import DQNLearner
from cprl.measuring.evaluate import evaluate, mean_return
from cprl.recording import load_weights, read_episodes, restore_weights

RECIPES = Path(__file__).parents[1] / "recipes"


def recipe(name):
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def shorter_episodes(monkeypatch, request):
    """Episodes of 60 steps, but for slow tests."""
    if "slow" in request.keywords:
        return
    game = presets.game

    def shorter(board, *, variant="published"):
        whole = game(board, variant=variant)
        return replace(whole, rules=replace(whole.rules, episode_steps=60))

    monkeypatch.setattr(presets, "game", shorter)


def run_in_miniature(tmp_path, capsys, **arguments):
    run = recipe("single_basic").main(episodes=11, evaluation_episodes=3, out=tmp_path / "run", **arguments)
    return run, capsys.readouterr().out


@pytest.mark.parametrize("variant", presets.VARIANTS)
def test_single_basic_leaves_a_run_directory(variant, tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, variant=variant, seed=3)
    kept = json.loads((run / "recipe.json").read_text())
    assert kept["recipe"] == "single_basic"
    assert kept["arguments"]["seed"] == 3
    assert kept["arguments"]["learner"]["learning_rate"] == 1e-5
    again = Rules(**kept["arguments"]["game"]["rules"]), Map(**kept["arguments"]["game"]["map"])
    assert again == (presets.game("single_basic", variant=variant).rules, presets.game("single_basic").map)
    assert read_episodes(run)["episode"].to_pylist() == list(range(11))
    assert (run / "episodes.parquet").exists()
    assert (run / "run.rrd").stat().st_size > 10_000
    assert (run / "figures" / "training_curve.png").stat().st_size > 10_000
    assert set(load_weights(run / "checkpoints" / "best.pt")) == {"agent_0"}
    assert set(load_weights(run / "checkpoints" / "final.pt")) == {"agent_0"}
    assert "random" in told
    assert "greedy" in told
    assert "shortened" not in told


def test_the_short_schedule_says_so_and_names_the_published_one(tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, schedule="short", watch="serve")
    assert "Watch live (browser): http://127.0.0.1:" in told
    assert "short schedule, 11 episodes" in " ".join(told.split())
    assert "The published one: .venv/bin/python recipes/single_basic.py --watch serve" in told
    assert (
        json.loads((run / "recipe.json").read_text())["arguments"]["learner"]["epsilon_decay_steps"] == 30_000
    )


def test_a_directory_with_a_run_in_it_is_not_written_over(tmp_path, capsys):
    run, _ = run_in_miniature(tmp_path, capsys)
    with pytest.raises(FileExistsError):
        run_in_miniature(tmp_path, capsys)
    assert read_episodes(run).num_rows == 11


@pytest.mark.slow
def test_the_short_schedule_earns_three_times_what_chance_does(tmp_path):
    run = recipe("single_basic").main(schedule="short", out=tmp_path / "run")
    game = presets.game("single_basic")
    learner = DQNLearner(game.observation_shape, 7, settings=presets.learner("single_basic"))
    restore_weights(run / "checkpoints" / "best.pt", {"agent_0": learner.network})
    fresh = CommonsEnv(game, 100, seed=1234)
    greedy, _ = mean_return(evaluate(fresh, Seats([learner.actor])))
    chance, _ = mean_return(evaluate(fresh, Seats([RandomActor(7)])))
    assert greedy >= 3 * chance
