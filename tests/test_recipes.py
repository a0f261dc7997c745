"""Recipes run, in miniature, and keep what they promise."""

import importlib.util
import json
import re
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
from rerun.chunk import RrdReader

import cprl
from cprl import CommonsEnv, Map, Rules, presets
from cprl.learners.replay import ReplayLearner
from cprl.learners.single import DQNLearner
from cprl.measuring.evaluate import evaluate, mean_return
from cprl.policies.assignment import AgentPolicies
from cprl.policies.single import RandomActor
from cprl.population import Learner, Population
from cprl.runs.checkpoints import Checkpointer, checkpoints_in, read_checkpoint
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.runs.weights import load_weights, restore_weights
from cprl.training import train

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
    run = recipe("first_run").main(episodes=11, evaluation_episodes=3, out=tmp_path / "run", **arguments)
    return run, capsys.readouterr().out


@pytest.mark.parametrize("variant", presets.VARIANTS)
def test_the_first_run_leaves_a_run_directory(variant, tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, variant=variant, seed=3)
    kept = json.loads((run / "recipe.json").read_text())
    assert kept["recipe"] == "first_run"
    assert kept["arguments"]["seed"] == 3
    assert kept["arguments"]["learner"]["learning_rate"] == 3e-4
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


def test_the_first_run_says_that_it_is_short_and_names_the_published_schedule(tmp_path, capsys):
    run, told = run_in_miniature(tmp_path, capsys, watch="serve")
    assert "ViewerCallback live (browser): http://127.0.0.1:" in told
    assert "short schedule, 11 episodes" in " ".join(told.split())
    assert "The published one, with 8 replicas: .venv/bin/python recipes/single_basic.py" in told
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
    run = recipe("first_run").main(out=tmp_path / "run")
    game = presets.game("single_basic")
    learner = DQNLearner(game.observation_shape, 7, settings=presets.learner("single_basic"))
    restore_weights(run / "checkpoints" / "best.pt", {"agent_0": learner.network})
    fresh = CommonsEnv(game, 100, seed=1234)
    greedy, _ = mean_return(evaluate(fresh, AgentPolicies([learner.actor])))
    chance, _ = mean_return(evaluate(fresh, AgentPolicies([RandomActor(7)])))
    assert greedy >= 3 * chance


LANES = {"single_basic": 1, "single_complex": 1, "two_complex": 2, "two_against_random": 2, "commons": 4}


@pytest.mark.parametrize("variant", presets.VARIANTS)
@pytest.mark.parametrize("name", LANES)
def test_recipes_of_replicas_leave_a_run_directory(name, variant, tmp_path, capsys):
    how = {"replicas": 2, "episodes": 3, "evaluation_episodes": 2, "seed": 3, "compile": False}
    run = recipe(name).main(variant=variant, out=tmp_path / "run", **how)
    told = capsys.readouterr().out
    kept = json.loads((run / "recipe.json").read_text())
    assert kept["recipe"] == name
    assert kept["arguments"]["replicas"] == 2
    rows = read_episodes(run).to_pydict()
    agents = LANES[name]
    of_each = [(r, e, a) for r in range(2) for e in range(3) for a in range(agents)]
    assert sorted(zip(rows["replica"], rows["episode"], rows["agent"], strict=True)) == of_each
    weights = load_weights(run / "checkpoints" / "final.pt")
    learning = 1 if name == "two_against_random" else agents
    assert sorted(weights) == [f"replica_{r}/agent_{a}" for r in range(2) for a in range(learning)]
    assert (run / "figures" / "training_curve.png").exists()
    assert "trained, epsilon 0.05" in " ".join(told.split())
    for policy in ("random", "trained"):
        played = pq.read_table(run / "evaluation" / f"{policy}.parquet").to_pydict()
        assert sorted(set(zip(played["replica"], played["episode"], strict=True))) == [
            (r, e) for r in range(2) for e in range(2)
        ]
    assert json.loads((run / "report.json").read_text())["training_s"] > 0
    game, settings = presets.game("commons"), presets.learner("commons", variant=variant)
    if name == "commons":
        network = ReplayLearner(game, agents=[0], replicas=1, settings=settings, compile=False).networks()
        restore_weights_of(network["replica_0/agent_0"], weights["replica_1/agent_2"])


def test_two_agents_without_the_beam_never_fire(tmp_path):
    how = {"replicas": 2, "episodes": 1, "evaluation_episodes": 1, "compile": False, "watch": "off"}
    run = recipe("two_complex").main(beam=False, out=tmp_path / "run", **how)
    assert json.loads((run / "recipe.json").read_text())["recipe"] == "two_complex_no_beam"
    assert set(read_episodes(run).to_pydict()["shots"]) == {0}


@pytest.mark.parametrize("loss", ["dqn", "double_dqn", "cql", "sac", "iql", "ppo"])
def test_swapping_the_loss_is_one_argument_and_each_leaves_a_run_that_plays_again(loss, tmp_path, capsys):
    how = {"replicas": 2, "evaluation_episodes": 1, "compile": False, "watch": "off"}
    episodes = 5 if loss == "ppo" else 1  # a rollout is longer than an episode is here
    run = recipe("swap_the_loss").main(loss=loss, episodes=episodes, out=tmp_path / "run", **how)
    loaded, algorithm = cprl.load(run), recipe("swap_the_loss").LOSSES[loss]
    assert loaded.algorithms == {0: algorithm, 1: algorithm}
    explores = "trained, epsilon 0.05" in " ".join(capsys.readouterr().out.split())
    assert explores == (loss not in ("sac", "iql", "ppo")), "who draws from a policy has no epsilon"
    members = [Learner(algorithm)] * 2
    for lane, network in Population(loaded.game, members, replicas=2, compile=False).networks().items():
        trained = loaded.networks[lane].state_dict()
        assert not any(torch.equal(value, trained[name]) for name, value in network.state_dict().items())
    assert len(evaluate(loaded.env(1), loaded.policy(1), explore=True)) == 1


def test_unlike_neighbours_train_in_one_loop_are_recorded_and_evaluated(tmp_path, capsys):
    how = {"replicas": 2, "episodes": 5, "evaluation_episodes": 1, "compile": False}
    run = recipe("mixed").main(neighbour="greedy", out=tmp_path / "run", **how)
    kinds = [member.get("algorithm", member.get("manner")) for member in cprl.load(run).members]
    assert kinds == ["DQN", "DQN", "PPO", "greedy"]
    rows = pq.read_table(run / "evaluation" / "trained.parquet").to_pydict()
    assert sorted(set(rows["agent"])) == [0, 1, 2, 3]
    shots = dict.fromkeys(range(4), 0)
    for agent, of_agent in zip(rows["agent"], rows["shots"], strict=True):
        shots[agent] += of_agent
    assert shots[3] == 0, "the greedy never fire"
    assert max(shots.values()) > 0
    told = {chunk.entity_path for chunk in RrdReader(run / "run.rrd").stream()}
    assert {f"/agent_{agent}/return" for agent in range(4)} <= told
    assert {f"/agent_{agent}/loss" for agent in range(3)} <= told


def restore_weights_of(network, state):
    """Kept weights fit an ordinary network of one agent."""
    before = next(network.parameters()).clone()
    network.load_state_dict(state)
    assert not torch.equal(before, next(network.parameters()))


@pytest.mark.slow
def test_fifty_episodes_of_commons_in_eight_replicas_are_those_of_each_alone(tmp_path):
    how = {"episodes": 50, "evaluation_episodes": 1, "seed": 5}
    run = recipe("commons").main(replicas=8, out=tmp_path / "all", **how)
    rows = read_episodes(run).to_pydict()
    returns = {}
    for replica, agent, episode, value in zip(
        rows["replica"], rows["agent"], rows["episode"], rows["return"], strict=True
    ):
        returns.setdefault((replica, agent), {})[episode] = value
    courses = {lane: tuple(course[episode] for episode in range(50)) for lane, course in returns.items()}
    assert len(courses) == 32
    assert len(set(courses.values())) == 32, "all lanes differ"
    weights = load_weights(run / "checkpoints" / "final.pt")
    game, settings = presets.game("commons"), presets.learner("commons")
    for replica in (0, 5):
        alone = ReplayLearner(
            game, agents=range(4), replicas=1, first_replica=replica, settings=settings, seed=5
        )
        env = CommonsEnv(game, 1, seed=5, first_world=replica)
        (tmp_path / f"alone_{replica}").mkdir()
        with EpisodeTable(tmp_path / f"alone_{replica}" / "episodes.parquet") as table:
            train(env, {(0, 1, 2, 3): alone}, episodes=50, callbacks=[table])
        told = read_episodes(tmp_path / f"alone_{replica}").to_pydict()
        for agent in range(4):
            mine = [v for a, v in zip(told["agent"], told["return"], strict=True) if a == agent]
            assert tuple(mine) == courses[replica, agent]
            state = alone.networks()[f"replica_{replica}/agent_{agent}"].state_dict()
            for name, value in weights[f"replica_{replica}/agent_{agent}"].items():
                torch.testing.assert_close(state[name], value, rtol=1e-4, atol=1e-6)


def test_a_run_is_loaded_from_its_directory_alone(tmp_path):
    how = {"replicas": 2, "episodes": 2, "evaluation_episodes": 1, "compile": False}
    run = recipe("two_against_random").main(variant="as_run", out=tmp_path / "run", **how)
    loaded = cprl.load(run)
    assert loaded.game == presets.game("two_complex", variant="as_run")
    assert loaded.algorithms[0].settings == presets.learner("two_complex", variant="as_run")
    assert loaded.replicas == [0, 1]
    assert loaded.episodes().num_rows == 2 * 2 * 2
    kept = load_weights(run / "checkpoints" / "final.pt")
    for lane, network in loaded.networks.items():
        for name, value in network.state_dict().items():
            assert torch.equal(value, kept[lane][name])
    assert loaded.weights_from == run / "checkpoints" / "final.pt"
    assert len(evaluate(loaded.env(3), loaded.policy(1), explore=True)) == 3
    assert len(evaluate(loaded.env(3), loaded.policy(1, others={1: RandomActor(8)}), explore=True)) == 3
    with pytest.raises(ValueError, match=r"agents \[0\] of replica 7 have no network in .*; kept are"):
        loaded.policy(7)


def test_a_run_that_was_stopped_is_loaded_from_its_newest_checkpoint(tmp_path, monkeypatch):
    how = {"replicas": 2, "episodes": 3, "evaluation_episodes": 1, "compile": False}

    class StopError(Exception):
        pass

    def after_step(checkpoints, training):
        if training.steps in (20, 40):
            checkpoints.save(training)
        if training.steps == 50:
            raise StopError

    monkeypatch.setattr(Checkpointer, "after_step", after_step)
    with pytest.raises(StopError):
        recipe("two_against_random").main(out=tmp_path / "run", **how)
    loaded = cprl.load(tmp_path / "run")
    older, newest = checkpoints_in(tmp_path / "run" / "checkpoints")
    assert loaded.weights_from == newest
    assert sorted(loaded.networks) == ["replica_0/agent_0", "replica_1/agent_0"]
    (of_learner,) = read_checkpoint(newest)["learners"]
    kept = of_learner["update"]["own"]["value_network_params:module.0.module.weights.0"]
    for replica in (0, 1):
        first = next(loaded.networks[f"replica_{replica}/agent_0"].parameters())
        assert torch.equal(first, kept[replica].T)
    assert len(evaluate(loaded.env(2), loaded.policy(1), explore=True)) == 2
    newest.write_bytes(newest.read_bytes()[:-100])
    assert cprl.load(tmp_path / "run").weights_from == older
    older.unlink()
    with pytest.raises(ValueError, match=r"nor a readable checkpoint: .*truncated or was changed"):
        cprl.load(tmp_path / "run")


def test_the_run_of_a_plain_agent_is_loaded_too(tmp_path, capsys):
    run, _ = run_in_miniature(tmp_path, capsys)
    for weights in ("final", "best"):
        loaded = cprl.load(run, weights=weights)
        assert list(loaded.networks) == ["replica_0/agent_0"]
        assert len(evaluate(loaded.env(2), loaded.policy())) == 2


def test_a_run_that_cannot_be_loaded_says_which_file_and_why(tmp_path, capsys):
    run, _ = run_in_miniature(tmp_path, capsys)
    weights = run / "checkpoints" / "final.pt"
    content = weights.read_bytes()
    for spoilt in (content[:-300], b"something else", b""):
        weights.write_bytes(spoilt)
        with pytest.raises(ValueError, match=r"final\.pt holds no weights of this run: "):
            cprl.load(run)
    weights.unlink()
    with pytest.raises(
        ValueError, match=r"final\.pt is not there, nor a readable checkpoint: has .* been tr"
    ):
        cprl.load(run)
    (run / "checkpoints" / "best.pt").unlink()
    with pytest.raises(ValueError, match=r"best\.pt holds no weights of this run: .*No such file"):
        cprl.load(run, weights="best")
    told = json.loads((run / "recipe.json").read_text())
    told["arguments"]["game"]["rules"]["hits_to_tag"] = 0
    (run / "recipe.json").write_text(json.dumps(told))
    with pytest.raises(ValueError, match=r"recipe\.json holds no game and learner .*hits_to_tag is 0"):
        cprl.load(run)
    with pytest.raises(ValueError, match=r"recipe\.json is no recipe of a run"):
        cprl.load(tmp_path)


@pytest.mark.parametrize("watch", ["telepathy", "connect", "connect nobody", "connect rerun+http://:x/proxy"])
@pytest.mark.parametrize(
    "name", sorted(path.stem for path in RECIPES.glob("*.py") if path.stem != "reproduce")
)
def test_a_way_to_watch_that_is_none_is_refused_before_there_is_a_run(name, watch, tmp_path):
    with pytest.raises(ValueError, match=re.escape(f"watch is {watch!r}") + '; wanted: "file",.* or "con'):
        recipe(name).main(watch=watch, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
