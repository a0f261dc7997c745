"""Recipes run, in miniature, and keep what they promise."""

import json
import sys
from collections import Counter
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from boards import module_at
from dqn_parts import dqn_learner
from places import RECIPES
from rerun.chunk import RrdReader

import cprl
from cprl import CommonsEnv, presets
from cprl.algorithms import DQN, PPO
from cprl.commands.recipe_command import parse_command
from cprl.measuring.playing import evaluate
from cprl.population import Learning, Scripted
from cprl.runs.checkpoints import Checkpointer, checkpoints_in, read_checkpoint
from cprl.runs.episodes import EpisodeTable, read_episodes
from cprl.runs.weights import load_weights, save_weights
from cprl.studies import StudyTable
from cprl.studies.study import Condition
from cprl.studies.tables.sources import design_of
from cprl.training import Schedule, train
from cprl.training.agents import Population

pytestmark = pytest.mark.usefixtures("shorter_episodes")


def recipe(name, folder=RECIPES):
    return module_at(folder / f"{name}.py")


@pytest.fixture
def of_learners(monkeypatch):
    """Loads a recipe of the comparison of learners."""
    folder = RECIPES / "study" / "learners"
    monkeypatch.syspath_prepend(str(folder))
    return lambda name: recipe(name, folder)


@pytest.mark.parametrize("board", ["two_complex", "commons"])
def test_every_way_to_learn_has_four_candidates_of_its_own(board, of_learners):
    study = of_learners(f"tuning_{board}").STUDY
    ways = Counter(condition.name.partition(":")[0] for condition in study.all_conditions)
    assert ways == dict.fromkeys(("DQN", "PPO", "IPPO", "VDN", "QMIX", "MAPPO", "MADDPG", "PR2", "LOLA"), 4)
    assert len({condition.checksum for condition in study.all_conditions}) == 36
    assert {condition.experiment.seed for condition in study.all_conditions} == {1000}


def tuned(study, values):
    """The table of a tuning in which each candidate got so much in fresh worlds."""
    row = {"checksum": "", "run": "", "marks": "", "part": "evaluation", "metric": "collective_return"}
    row |= {"episode": 0, "window_episodes": 20, "undefined": 0}
    rows = [
        {"condition": name, "replica": replica, "value": value + replica, **row}
        for name, value in values.items()
        for replica in range(2)
    ]
    table = pa.Table.from_pylist(rows)
    return StudyTable(design=design_of(study), rows=table, window=10, missing_runs=(), provenance={})


def test_the_comparison_of_learners_takes_the_candidates_that_got_most_and_were_trained(of_learners, capsys):
    ways = of_learners("ways")
    study = ways.tuning("two_complex")
    names = [condition.name for condition in study.all_conditions]
    chosen = ways.winners(tuned(study, {name: -place % 5 for place, name in enumerate(names)}))
    # -place % 5 is 0 4 3 2, 1 0 4 3, ..: the second candidate of the first way, the third one of the second
    assert list(chosen) == list(ways.WAYS)
    assert f"DQN: {chosen['DQN']}" == names[1]
    assert f"PPO: {chosen['PPO']}" == names[6]
    compared = ways.comparison("two_complex", chosen, {"": 1200, "LOLA": 1500})
    by_name = {condition.name: condition.experiment for condition in compared.all_conditions}
    assert list(by_name) == [*ways.WAYS, "DQN as run"]
    assert {name for name, experiment in by_name.items() if experiment.episodes != 1200} == {"LOLA"}
    assert by_name["LOLA"].episodes == 1500
    assert {experiment.seed for experiment in by_name.values()} == {0}, "none of the tuning's"
    settings = by_name["PPO"].agents[0].algorithm.settings
    assert f"learning rate {settings.learning_rate}" in chosen["PPO"]
    as_run = by_name["DQN as run"].agents[0].algorithm.settings
    assert as_run == presets.dqn_settings("two_complex", variant="as_run")
    first, *others = names
    assert ways.winners(tuned(study, {first: 3})) == {"DQN": first.removeprefix("DQN: ")}
    said = [f"Not evaluated, and not chosen from: {name}" for name in others]
    assert capsys.readouterr().out.splitlines() == said


@pytest.mark.integration
def test_agents_of_a_study_of_learners_meet_in_a_cross_play(tmp_path, monkeypatch, of_learners):
    ways = of_learners("ways")
    candidates = {name: ways.candidates(name, 1000).values() for name in ("DQN", "MAPPO")}
    algorithms = {name: next(iter(algorithms)) for name, algorithms in candidates.items()}
    options = {"name": "few", "question": "", "expectation": "", "replicas": 2}
    length = {"episodes": 2, "evaluation_episodes": 1}
    study = ways.study("two_complex", algorithms, length, **options)
    eager = replace(study, experiment=replace(study.experiment, engine="eager"))
    cprl.run_study(eager, tmp_path / "few", results=False, progress=False)
    cross_play = of_learners("cross_play")
    cross_play.main(tmp_path / "few", episodes=1)
    rows = pq.read_table(tmp_path / "few" / "cross_play.parquet").to_pydict()
    assert set(rows["focal"]) == {"DQN", "MAPPO"} == set(rows["background"])
    assert (tmp_path / "few" / "cross_play.png").exists()
    monkeypatch.setattr(cprl, "crossplay", None)  # it would be called before anything is written
    with pytest.raises(FileExistsError, match=r"cross_play\.parquet exists and is not overwritten"):
        cross_play.main(tmp_path / "few", episodes=1)


def run_recipe(name, out, *, own=None, watch="file", **changes):
    """Runs the experiment of a recipe, in miniature."""
    changes = {"replicas": 2, "evaluation_episodes": 1, "engine": "eager", **changes}
    return cprl.run(replace(recipe(name).experiment(**(own or {})), **changes), out, watch=watch)


@pytest.mark.parametrize(("kind", "herd"), [("herders", 2), ("appropriation", 8)])
@pytest.mark.parametrize("learner", ["tables", "PPO"])
def test_those_who_share_learn_alone_and_know_nothing_of_each_other(kind, herd, learner):
    own = recipe("sharing", RECIPES / "study" / "theory").experiment(
        kind=kind, herd=herd, learner=learner, wants="team"
    )
    assert own.game.agents == herd
    assert own.game.remembered == 0
    assert {(spec.reward, spec.algorithm.settings.gamma) for spec in own.agents} == {("team", 0.0)}


def test_the_table_of_where_learners_end_follows_from_what_was_measured(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(RECIPES / "study" / "theory"))
    own = recipe("where_learners_end", RECIPES / "study" / "theory")
    measured = pq.read_table(RECIPES.parent / "docs" / "results" / "theory" / "taken.parquet")
    for condition in own.CONDITIONS:
        found = own.curves_of(measured, condition)
        kind, agents, *way = condition.values()
        assert found["total"].shape == (own.WAYS[tuple(way)] // own.BLOCK, 8)
        sharing = own.sharing_of(kind, agents)
        assert found["gain"].max() <= sharing.surplus(sharing.optimum_total) * (1 + 1e-5)
    own.print_table(measured)
    page = (RECIPES.parent / "docs" / "results" / "theory" / "table.md").read_text()
    assert capsys.readouterr().out in page


LANES = {"single_basic": 1, "single_complex": 1, "two_complex": 2, "two_against_random": 2, "commons": 4}


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "variant"),
    [
        pytest.param(name, variant, marks=[pytest.mark.slow] * (variant != "published"))
        for name in LANES
        for variant in presets.VARIANTS
    ],
)
def test_recipes_of_replicas_leave_a_run_directory(name, variant, tmp_path, capsys, curves):
    options = {"episodes": 3, "evaluation_episodes": 2, "seed": 3}
    run = run_recipe(name, tmp_path / "run", own={"variant": variant}, **options)
    told = capsys.readouterr().out
    kept = json.loads((run / "recipe.json").read_text())
    assert kept["recipe"] == name
    assert kept["experiment"]["replicas"] == 2
    rows = read_episodes(run).to_pydict()
    agents = LANES[name]
    of_each = [(r, e, a) for r in range(2) for e in range(3) for a in range(agents)]
    assert sorted(zip(rows["replica"], rows["episode"], rows["agent"], strict=True)) == of_each
    weights = load_weights(run / "checkpoints" / "final.pt")
    learning = 1 if name == "two_against_random" else agents
    assert sorted(weights) == [f"replica_{r}/agent_{a}" for r in range(2) for a in range(learning)]
    assert (run / "figures" / "training_curve.png").exists()
    assert "agents act at random in 5%" in " ".join(told.split())
    assert " 0.05 ┃" in told
    for policy in ("random", "trained"):
        played = pq.read_table(run / "evaluation" / f"{policy}.parquet").to_pydict()
        pairs = sorted(set(zip(played["replica"], played["episode"], strict=True)))
        assert pairs == [(r, e) for r in range(2) for e in range(2)]
    assert json.loads((run / "report.json").read_text())["training_s"] > 0
    if name == "commons":
        game, settings = presets.game("commons"), presets.dqn_settings("commons", variant=variant)
        plain = dqn_learner(game.spaces, agents=[0], replicas=1, settings=settings, engine="eager")
        network = plain.networks()["replica_0/agent_0"]
        before = next(network.parameters()).clone()
        network.load_state_dict(weights["replica_1/agent_2"])  # which fit an ordinary network of one agent
        assert not torch.equal(before, next(network.parameters()))


@pytest.mark.integration
def test_a_version_of_the_program_on_the_command_line_is_a_condition_of_the_studies(monkeypatch):
    monkeypatch.syspath_prepend(str(RECIPES / "study"))
    study = recipe("experiment_5", RECIPES / "study").STUDY
    sys.modules.pop("base")
    line = "commons.py --variant as_run --gamma 0.997 --episodes 2600 --target-every-episodes 10"
    words = f"{line} --optimizer keras_rmsprop --loss-function log_cosh".split()
    experiment, _ = parse_command(recipe("commons").experiment, words)
    assert experiment == cprl.Experiment.from_recipe(experiment.to_recipe("run"), directory="run")
    assert Condition(experiment).checksum == study.all_conditions[-1].checksum
    plain, _ = parse_command(recipe("commons").experiment, words[:-4])
    assert Condition(plain).checksum == study.all_conditions[1].checksum


@pytest.mark.integration
def test_two_agents_without_the_beam_never_fire(tmp_path):
    run = run_recipe("two_complex", tmp_path / "run", own={"beam": False}, episodes=1, watch="off")
    assert json.loads((run / "recipe.json").read_text())["recipe"] == "two_complex_no_beam"
    assert set(read_episodes(run).to_pydict()["shots"]) == {0}


@pytest.mark.integration
@pytest.mark.parametrize(
    "loss",
    [
        "ppo",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("dqn", "double_dqn", "cql", "sac", "iql")),
    ],
)
def test_swapping_the_loss_is_one_argument_and_each_leaves_a_run_that_plays_again(loss, tmp_path, capsys):
    if loss in ("cql", "iql"):  # examples of an algorithm of one's own
        cprl.trust(f"{loss}:{loss.upper()}")
    episodes = 5 if loss == "ppo" else 1  # a rollout is longer than an episode is here
    run = run_recipe("swap_the_loss", tmp_path / "run", own={"loss": loss}, episodes=episodes, watch="off")
    loaded, algorithm = cprl.load(run), recipe("swap_the_loss").LOSSES[loss]
    assert loaded.experiment.agents == (Learning(algorithm),) * 2
    explores = "agents act at random in" in " ".join(capsys.readouterr().out.split())
    # Nor is it said of an algorithm of one's own, which CQL is.
    assert explores == (loss not in ("sac", "iql", "ppo", "cql")), "who draws from a policy has no epsilon"
    members = [Learning(algorithm)] * 2
    for lane, network in Population(loaded.env(2), members, engine="eager").networks().items():
        trained = loaded.networks[lane].state_dict()
        assert not any(torch.equal(value, trained[name]) for name, value in network.state_dict().items())
    assert len(evaluate(loaded.env(1), loaded.policy(1), explore=True)) == 1


@pytest.mark.integration
def test_unlike_neighbours_train_in_one_loop_are_recorded_and_evaluated(tmp_path, capsys):
    run = run_recipe("mixed", tmp_path / "run", own={"neighbour": "greedy"}, episodes=5)
    first, second, third, last = cprl.load(run).experiment.agents
    assert first == second
    assert (type(first.algorithm), type(third.algorithm), last) == (DQN, PPO, Scripted("greedy"))
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


@pytest.mark.slow
def test_fifty_episodes_of_commons_in_eight_replicas_are_those_of_each_alone(tmp_path):
    run = run_recipe("commons", tmp_path / "all", replicas=8, engine="compiled", episodes=50, seed=5)
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
    game, settings = presets.game("commons"), presets.dqn_settings("commons")
    for replica in (0, 5):
        alone = dqn_learner(
            game.spaces, agents=range(4), replicas=1, first_replica=replica, settings=settings, seed=5
        )
        env = CommonsEnv(game, 1, seed=5, first_world=replica)
        (tmp_path / f"alone_{replica}").mkdir()
        with EpisodeTable(tmp_path / f"alone_{replica}" / "episodes.parquet") as table:
            train(env, {(0, 1, 2, 3): alone}, Schedule(episodes=50), callbacks=[table])
        told = read_episodes(tmp_path / f"alone_{replica}").to_pydict()
        for agent in range(4):
            mine = [v for a, v in zip(told["agent"], told["return"], strict=True) if a == agent]
            assert tuple(mine) == courses[replica, agent]
            state = alone.networks()[f"replica_{replica}/agent_{agent}"].state_dict()
            for name, value in weights[f"replica_{replica}/agent_{agent}"].items():
                torch.testing.assert_close(state[name], value, rtol=1e-4, atol=1e-6)


@pytest.mark.integration
def test_a_run_is_loaded_from_its_directory_alone(tmp_path):
    run = run_recipe("two_against_random", tmp_path / "run", own={"variant": "as_run"}, episodes=2)
    loaded = cprl.load(run)
    assert loaded.game == presets.game("two_complex", variant="as_run")
    settings = presets.dqn_settings("two_complex", variant="as_run")
    assert loaded.experiment.agents == (Learning(DQN(settings=settings)), Scripted("random"))
    assert loaded.replicas == [0, 1]
    assert loaded.episodes().num_rows == 2 * 2 * 2
    kept = load_weights(run / "checkpoints" / "final.pt")
    for lane, network in loaded.networks.items():
        for name, value in network.state_dict().items():
            assert torch.equal(value, kept[lane][name])
    assert loaded.weights_from == run / "checkpoints" / "final.pt"
    assert len(evaluate(loaded.env(3), loaded.policy(1, worlds=3), explore=True)) == 3
    with pytest.raises(ValueError, match=r"keeps no network of replica_7/agent_0; kept are"):
        loaded.policy(7)


@pytest.mark.integration
def test_a_run_that_was_stopped_is_loaded_from_its_newest_checkpoint(tmp_path, monkeypatch):
    class StopError(Exception):
        pass

    def after_step(checkpoints, training):
        if training.steps in (20, 40):
            checkpoints.save(training)
        if training.steps == 50:
            raise StopError

    monkeypatch.setattr(Checkpointer, "after_step", after_step)
    with pytest.raises(StopError):
        run_recipe("two_against_random", tmp_path / "run", episodes=3)
    loaded = cprl.load(tmp_path / "run")
    older, newest = checkpoints_in(tmp_path / "run" / "checkpoints")
    assert loaded.weights_from == newest
    assert sorted(loaded.networks) == ["replica_0/agent_0", "replica_1/agent_0"]
    (of_learner,) = read_checkpoint(newest)["learners"]
    kept = of_learner["lane_networks"]["params"]["value_network_params:module.0.module.weights.0"]
    for replica in (0, 1):
        first = next(loaded.networks[f"replica_{replica}/agent_0"].parameters())
        assert torch.equal(first, kept[replica].T)
    assert len(evaluate(loaded.env(2), loaded.policy(1, worlds=2), explore=True)) == 2
    newest.write_bytes(newest.read_bytes()[:-100])
    assert cprl.load(tmp_path / "run").weights_from == older
    older.unlink()
    with pytest.raises(ValueError, match=r"nor a readable checkpoint: .*damaged or was changed"):
        cprl.load(tmp_path / "run")


@pytest.mark.integration
def test_the_run_of_a_plain_agent_is_loaded_too_or_says_which_file_cannot_be_read_and_why(tmp_path):
    run = recipe("own_loop").main(episodes=11, evaluation_episodes=3, out=tmp_path / "run")
    network = cprl.load(run).networks["replica_0/agent_0"]
    save_weights(run, {"agent_0": network}, name="other")
    for weights in ("final", "other"):
        loaded = cprl.load(run, weights=weights)
        assert list(loaded.networks) == ["replica_0/agent_0"]
        assert len(evaluate(loaded.env(2), loaded.policy(worlds=2))) == 2
    weights = run / "checkpoints" / "final.pt"
    content = weights.read_bytes()
    for spoilt in (content[:-300], b"something else", b""):
        weights.write_bytes(spoilt)
        with pytest.raises(ValueError, match=r"final\.pt is damaged or was changed: its checksum is"):
            cprl.load(run)
        manifest = (run / "manifest.json").rename(run / "elsewhere")
        with pytest.raises(ValueError, match=r"final\.pt holds no weights: "):
            cprl.load(run)
        manifest.rename(run / "manifest.json")
    weights.unlink()
    with pytest.raises(ValueError, match=r"checkpoints/final\.pt"):
        cprl.load(run)
    weights.write_bytes(content)
    with pytest.raises(ValueError, match=r"none\.pt holds no weights: .*No such file"):
        cprl.load(run, weights="none")
    best = (run / "checkpoints" / "best.pt").rename(run / "elsewhere")
    with pytest.raises(ValueError, match=r"lacks checkpoints/best\.pt, which its manifest\.json lists"):
        cprl.load(run, weights="best")
    best.rename(run / "checkpoints" / "best.pt")
    content = json.loads((run / "recipe.json").read_text())
    content["experiment"]["game"]["rules"]["hits_to_tag"] = 0
    (run / "recipe.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"recipe\.json: experiment\.game\.rules\.hits_to_tag is 0"):
        cprl.load(run)
    with pytest.raises(ValueError, match=r"is not the directory of a run: it holds no recipe\.json"):
        cprl.load(tmp_path)


@pytest.mark.integration
def test_the_tragedy_ends_with_what_happened_and_what_to_try_next(tmp_path, capsys, curves):
    own = recipe("tragedy")
    words = ["recipes/tragedy.py", "--out", str(tmp_path / "run"), "--engine", "eager", "--watch", "off"]
    words += ["--episodes", "12", "--replicas", "2", "--evaluation-episodes", "2"]
    run = cprl.recipe_main(own.experiment, words, at_end=own.print_next)
    told = capsys.readouterr().out
    before, after = told[: told.index("survival, steps")], told[told.index("Training curve:") :]
    assert "The agents began at" in before
    assert "of each of" in " ".join(before.split()), "the last episodes of many worlds"
    assert "In fresh worlds, where nobody learns" in " ".join(before.split())
    assert "This was a short schedule. The published one" in after
    assert after.count(str(run)) >= 3, "in the figure's path and in lines to be copied"


@pytest.mark.integration
@pytest.mark.parametrize(
    "name", sorted(path.stem for path in RECIPES.glob("*.py") if path.stem != "own_loop")
)
def test_a_way_to_watch_that_is_none_is_refused_before_there_is_a_run(name, tmp_path):
    for watch in ("telepathy", "connect rerun+http://127.0.0.1:9876/proxy"):
        with pytest.raises(ValueError, match="watch"):
            run_recipe(name, out=tmp_path / "run", watch=watch)
    assert not (tmp_path / "run").exists()
