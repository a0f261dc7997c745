"""A loop of one's own in miniature: it leaves a run's directory like any other."""

import json
import shlex

import pytest
import torch
from boards import module_at
from places import RECIPES
from torch import nn

from cprl import CommonsEnv, Experiment, Game, Rules, maps, presets
from cprl.algorithms.base import q_actor
from cprl.measuring.playing import evaluate, mean_return
from cprl.networks.mlp import MLPNetwork
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import read_recipe
from cprl.runs.weights import load_weights
from cprl.system.shipped import cprl_command

LOOP = module_at(RECIPES / "own_loop.py")

pytestmark = pytest.mark.usefixtures("shorter_episodes")


def run_in_miniature(tmp_path, capsys, **arguments):
    run = LOOP.main(episodes=11, evaluation_episodes=3, out=tmp_path / "run", **arguments)
    return run, capsys.readouterr().out


@pytest.mark.integration
def test_the_loop_leaves_a_run_directory_and_does_not_write_over_one(tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, seed=3)
    kept = json.loads((run / "recipe.json").read_text())
    assert kept["recipe"] == "own_loop"
    experiment = Experiment.from_recipe(kept)
    assert (experiment.seed, experiment.game) == (3, presets.game("single_basic"))
    assert experiment.agents[0].algorithm.settings.learning_rate == 3e-4
    assert read_episodes(run)["episode"].to_pylist() == list(range(11))
    assert (run / "episodes.parquet").exists()
    assert (run / "run.rrd").stat().st_size > 10_000
    assert (run / "figures" / "training_curve.png").stat().st_size > 10_000
    best = run / "checkpoints" / "best.pt"
    assert best.exists() == ("greedy, best" in told), "there is none while the policy harvests nothing"
    assert set(load_weights(run / "checkpoints" / "final.pt")) == {"agent_0"}
    assert "random" in told
    assert "greedy" in told
    with pytest.raises(FileExistsError):
        run_in_miniature(tmp_path, capsys)
    assert read_episodes(run).num_rows == 11


@pytest.mark.integration
def test_the_loop_says_that_it_is_short_and_names_the_published_schedule(tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, watch="serve")
    assert "Watch live (browser): http://127.0.0.1:" in told
    assert "short schedule, 11 episodes" in " ".join(told.split())
    assert f"The published one, with 8 replicas: {shlex.join(cprl_command())} run single_basic\n" in told
    (agent,) = Experiment.from_recipe(read_recipe(run)).agents
    assert agent.algorithm.settings.epsilon_decay_steps == 30_000


@pytest.mark.slow
def test_the_short_schedule_earns_three_times_what_chance_does(tmp_path):
    run = LOOP.main(out=tmp_path / "run")
    game = presets.game("single_basic")
    network = MLPNetwork(game.observation_shape, 7, highest=game.observation.highest)
    network.load_state_dict(load_weights(run / "checkpoints" / "best.pt")["agent_0"])
    fresh = CommonsEnv(game, 100, seed=1234)
    greedy, _ = mean_return(evaluate(fresh, JointPolicy([q_actor(network)])))
    chance, _ = mean_return(evaluate(fresh, JointPolicy([RandomActor(7)])))
    assert greedy >= 3 * chance


def test_weights_that_harvest_nothing_are_never_the_best(tmp_path):
    env = CommonsEnv(Game(map=maps.parse("..>AA..\n......."), rules=Rules(episode_steps=3)), 2, seed=1)
    stay, forward = 7, 0

    def always(action):
        return lambda batch: batch.set(("agents", "action"), torch.full((2, 1), action))

    def networks():
        return {"agent_0": nn.Linear(1, 1)}

    best = LOOP.BestWeights(tmp_path, networks, policy=always(stay), env=env, every=1)
    best.on_episode(None, {})
    assert (best.path, best.best_episode) == (None, -1)
    best.policy = always(forward)
    best.on_episode(None, {})
    assert best.best_episode == 2
    assert best.path.exists()
