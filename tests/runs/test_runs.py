"""What is kept of a run: never written over, resumed only by the same recipe, exported small and whole."""

import contextlib
import itertools
import json
import os
import shlex
import subprocess
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pyarrow as pa
import pytest
import torch
from corridor import play
from matrix_game import MatrixGame, tit_for_tat
from recordings import column
from rerun.chunk import RrdReader
from tiny_study import TINY
from torchrl.record.loggers import CSVLogger

import cprl
from cprl import Rules, presets
from cprl.algorithms import DQN
from cprl.commands import main as cli
from cprl.evaluation.film import record_episode
from cprl.experiment import Experiment
from cprl.measuring import EpisodeTracker
from cprl.measuring.series import Observer
from cprl.measuring.windows import last_of, mean_of_worlds, running_mean
from cprl.policies.actors import RandomActor
from cprl.population import Frozen, Learning
from cprl.runs import loggers
from cprl.runs.curves import as_curves, curve_worlds
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results
from cprl.runs.length import Length
from cprl.runs.recipe import (
    read_recipe,
    refuse_another_run,
    resume_command,
    runs_in,
    start_run,
    started_by,
)
from cprl.runs.schedule import Schedule
from cprl.studies.factors import with_changes
from cprl.system.shipped import cprl_command
from cprl.training.training import StepCollector, Training
from cprl.values import Custom

AGENT = Learning(DQN(settings=presets.dqn_settings("commons")))
EXPERIMENT = Experiment(
    name="commons",
    game=presets.game("commons"),
    agents=[AGENT] * 3 + [Frozen("runs/earlier", 0)],
    episodes=3,
    replicas=2,
    seed=1,
)

# The directory and its recipe


def begin(run, experiment=EXPERIMENT):
    return start_run(run, experiment.name, experiment.to_recipe)


def resume(run, experiment=EXPERIMENT):
    return refuse_another_run(run, experiment.to_recipe, Experiment)


def edited(run, edit):
    """Changes the recipe of a run by hand."""
    recipe = read_recipe(run)
    edit(recipe)
    (run / "recipe.json").write_text(json.dumps(recipe))


def test_a_stopped_run_is_resumed_by_the_same_recipe(tmp_path):
    run = begin(tmp_path / "run")
    written = (run / "recipe.json").read_text()
    assert resume(run) == Length(3, "episodes")
    assert resume(run, replace(EXPERIMENT, episodes=5)) == Length(3, "episodes"), "it can be extended"
    assert (run / "recipe.json").read_text() == written


def test_the_recipe_of_a_run_is_its_experiment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with started_by(["recipes/commons.py", "--episodes", "3"]):
        run = begin(None)
    recipe = read_recipe(run)
    assert recipe["command"] == "recipes/commons.py --episodes 3"
    assert recipe["experiment"]["agents"][3]["run"] == "../earlier"
    assert Experiment.from_recipe(recipe, directory=run) == EXPERIMENT
    assert read_recipe(run / "recipe.json") == recipe


EVERY_SIGN = os.fsdecode("".join(map(chr, [*range(1, 47), *range(48, 127)])).encode() + b"\xff") + "é"
"""All of ASCII that a name may have, a byte that is no UTF-8, and a letter that is no ASCII."""


@pytest.mark.parametrize("name", ["x.json", "recipe.json", "x.rrd", "x.py", "-x", "~x", "a=b,c", "[0]*"])
def test_the_directory_of_a_run_may_have_any_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = begin(Path(name))
    assert run == Path(name)
    assert Experiment.from_recipe(read_recipe(run), directory=run) == EXPERIMENT
    assert runs_in([run]) == [run]


@pytest.mark.integration
@pytest.mark.parametrize("name", [EVERY_SIGN, "-x"], ids=["every sign", "-x"])
def test_a_run_in_a_directory_of_any_name_is_trained_resumed_by_its_line_exported_and_filmed(
    name, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    started = cprl.run(TINY, Path(name))
    (started / "report.json").unlink()
    line = resume_command(started)
    subprocess.run(f"{line} --watch off", shell=True, check=True, capture_output=True, timeout=120)
    assert (started / "report.json").exists()
    exported = export_results(started, Path(f"{name} exported"))
    among = replace(TINY, agents=(TINY.agents[0], Frozen(os.fspath(exported), 0)))
    loaded = cprl.load(cprl.run(among, Path(f"{name} among"), watch="off"))
    assert loaded.agent(1).network is not None
    assert len(cprl.evaluate_run(exported, cprl.Fresh(episodes=1)))
    assert record_episode(started, Path("film.rrd"), replica=0, episode=0)[0].exists()


OTHER_RULES = Rules(
    beam_length_cells=2, beam_width_cells=1, hits_to_tag=3, freeze_steps=4, signals=1, cooldown_steps=2
)
"""Eight rules differ from those of `EXPERIMENT`: these, and the two of its window."""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, r"was started with another recipe: experiment\.seed was 1, is 2$"),
        ({"episodes": 2}, "has 3 episodes"),
        ({"name": "two_complex"}, r"experiment\.name was .commons., is .two_complex.$"),
        (
            {"game": presets.game("commons", variant="as_run")},
            r"game\.rules\.hits_to_tag was 1, is 2; .*game\.rules\.quirks was None, is \{.*\}$",
        ),
        ({"game": replace(EXPERIMENT.game, rules=OTHER_RULES)}, r"hits_to_tag was 1, is 3; .* 3 more$"),
    ],
)
def test_another_recipe_is_refused_by_what_differs(change, message, tmp_path):
    run = begin(tmp_path / "run")
    with pytest.raises(ValueError, match=message):
        resume(run, replace(EXPERIMENT, **change))


def test_fields_that_a_later_version_has_are_no_difference_while_they_have_their_default(tmp_path):
    """A version that did not know a field did what its default says."""
    defaults = {field.name: field.default for field in fields(Experiment) if field.default is not MISSING}
    assert {"update_every", "seed", "on_nan"} <= defaults.keys()
    default = replace(EXPERIMENT, **{**defaults, "episodes": EXPERIMENT.episodes})
    run = begin(tmp_path / "run", default)

    def without_later_fields(recipe):
        for name in defaults.keys() - {"episodes"}:
            recipe["experiment"].pop(name, None)
        for agent in recipe["experiment"]["agents"][:2]:
            del agent["algorithm"]["settings"]["steps_per_update"]
        del recipe["experiment"]["game"]["rules"]["shuffle_starts"]

    edited(run, without_later_fields)
    assert resume(run, default) == EXPERIMENT.length
    with pytest.raises(ValueError, match=r"experiment\.update_every was not there, is 7"):
        resume(run, replace(default, update_every=7))
    with pytest.raises(ValueError, match=r"settings\.steps_per_update was not there, is 4$"):
        resume(run, with_changes(default, {"agents.0.algorithm.settings.steps_per_update": 4}))
    edited(run, lambda recipe: recipe["experiment"]["agents"][0]["algorithm"].pop("settings"))
    with pytest.raises(ValueError, match=r"algorithm\.settings was not there, is "):
        resume(run, default)


def test_where_nothing_can_be_resumed_that_is_said(tmp_path):
    run = begin(tmp_path / "run")
    edited(run, lambda recipe: recipe.update(format=1))
    for directory, message in (
        (run, "format"),
        (None, "resume requires the directory of the run as out"),
        (tmp_path / "nothing", "nothing is not the directory of a run: there is no such directory"),
    ):
        with pytest.raises(ValueError, match=message):
            resume(directory)
    texts = ["{", "[]", "[" * 100_000, '{"arguments": 3}', '{"experiment": []}', '{"experiment": {}}\0']
    for text in (*texts, '{"experiment": ' + "9" * 5000 + "}"):
        (tmp_path / "recipe.json").write_text(text)
        with pytest.raises(ValueError, match=r"recipe\.json is not the recipe of a run: "):
            read_recipe(tmp_path)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ("", ""),
        ("--seed 3", " --seed 3"),
        ("--out elsewhere --seed 3", " --seed 3"),
        ("--seed 3 --out=elsewhere --resume", " --seed 3"),
        ("--name 'an orchard'", " --name 'an orchard'"),
    ],
)
def test_the_line_that_resumes_is_the_one_that_began_with_the_runs_directory(given, line, tmp_path):
    command = ["recipes/commons.py", *shlex.split(given)]
    with started_by(command):
        resumes = resume_command(tmp_path)
    assert resumes == f"{sys.executable} recipes/commons.py{line} --out {tmp_path} --resume"


def test_a_run_that_python_began_is_resumed_by_the_command_cprl(tmp_path):
    experiment = replace(EXPERIMENT, callbacks=(Custom("my:Callback"), Custom("my:Other")))
    run = begin(tmp_path / "run", experiment)
    typed = shlex.join(cprl_command())
    assert resume_command(run) == f"{typed} run {run} --resume --allow my:Callback --allow my:Other"
    assert resume_command(tmp_path) == f"{typed} run {tmp_path} --resume"


def test_curves_are_those_of_each_replica_and_agent():
    columns = {
        "replica": [1, 1, 0, 0, 0, 0],
        "episode": [0, 0, 0, 0, 1, 1],
        "agent": [0, 1, 0, 1, 0, 1],
        "return": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "equality": [0.5, 0.5, float("nan"), float("nan"), 0.7, 0.7],
    }
    curves = as_curves(pa.table(columns))
    assert curves["return_1"].tolist() == [[4.0], [2.0]], "the episodes that all replicas have ended"
    np.testing.assert_array_equal(curves["equality"], [[np.nan], [0.5]])
    assert as_curves(pa.table(columns), last=1)["return_1"].tolist() == [[6.0], [2.0]], "the latest"
    assert as_curves(pa.table(columns).slice(0, 0)) == {}


def ended(lengths, harvests, *, turns):
    """The table of a replica whose worlds begin together, and play episodes of these lengths, [W, K]."""
    worlds = len(lengths)
    ends = np.cumsum(lengths, 1)
    order = np.lexsort([np.repeat(np.arange(worlds), ends.shape[1]), ends.ravel()])
    order = order[ends.ravel()[order] <= turns]
    zeros = np.zeros(len(order), np.int64)
    columns = {"replica": zeros, "world": order // ends.shape[1], "episode": np.arange(len(order))}
    returns = np.asarray(harvests, float).ravel()[order]
    return pa.table({**columns, "agent": zeros, "return": returns, "collective_return": returns})


def test_the_last_episodes_of_many_worlds_are_the_last_of_each_world():
    lengths = np.repeat([[10], [10], [100], [100]], 90, 1)
    table = ended(lengths, np.where(lengths == 10, 2.0, 8.0), turns=900)
    assert as_curves(table)["return_0"][0, -6:].mean() < 5, "of the last that ended most are of short worlds"
    last = as_curves(table, last=6)["collective_return"]
    assert sorted(last[0]) == [2.0] * 4 + [8.0] * 4, "2 of each of 4 worlds"
    assert as_curves(table, last=1000)["return_0"].shape == (1, 36), "as many of each as all have ended"
    assert curve_worlds(last_of(table, 6)).tolist()[0].count(3) == 2


def test_the_last_episodes_are_neither_the_longest_nor_the_shortest_ones():
    rng, truth, by_end, by_world = np.random.default_rng(0), 503.0, [], []
    for _ in range(40):
        lengths = rng.integers(500, 1000, (64, 12))
        harvests = truth + (lengths - 749.5)  # long episodes yield more
        table = ended(lengths, harvests, turns=1500)
        by_end.append(as_curves(table)["collective_return"][0, -30:].mean())
        by_world.append(as_curves(table, last=30)["collective_return"].mean())
    assert abs(np.mean(by_end) - truth) > 0.1 * truth
    assert abs(np.mean(by_world) - truth) < 0.01 * truth


def test_a_running_mean_of_many_worlds_counts_each_world_alike():
    values, worlds = np.array([1.0, 5.0, 3.0, 9.0, 2.0]), np.array([0, 1, 0, 0, 1])
    nan = np.nan
    np.testing.assert_array_equal(mean_of_worlds(values, worlds, 1), [nan, 3.0, 4.0, 7.0, 5.5])
    np.testing.assert_array_equal(mean_of_worlds(values, worlds, 3), [nan, nan, nan, nan, (6 + 3.5) / 2])
    one = np.zeros(5, np.int64)
    np.testing.assert_array_equal(mean_of_worlds(values, one, 2)[1:], running_mean(values, 2))


def test_running_means_stand_at_their_first_episode_and_leave_out_what_is_undefined():
    assert running_mean(np.array([1.0, 2.0, 6.0, 4.0]), 2).tolist() == [1.5, 4.0, 5.0]
    assert running_mean(np.array([[1.0, np.nan, 3.0]]), 2).tolist() == [[1.0, 3.0]]
    assert running_mean(np.array([1.0, 2.0]), 5).tolist() == [1.5]


# Exports


@pytest.mark.integration
def test_an_export_says_the_same_as_the_run(run, tmp_path):
    folder = export_results(run, tmp_path / "exported")
    assert export_results(run, folder) == folder, "again over the same"
    exported, whole = read_episodes(folder).to_pydict(), read_episodes(run)
    ordered = whole.sort_by([(name, "ascending") for name in ("replica", "episode", "agent")]).to_pydict()
    assert set(exported) == set(ordered)
    for name, values in ordered.items():
        np.testing.assert_array_equal(np.float32(exported[name]), np.float32(values), err_msg=name)
    copy, original = cprl.load(folder), cprl.load(run)
    assert copy.game == original.game
    assert sorted(copy.networks) == sorted(original.networks)
    assert not list(folder.rglob("training-*"))
    (run / "report.json").rename(tmp_path / "aside")
    with pytest.raises(FileNotFoundError, match=r"report\.json does not exist: has the run ended\?"):
        export_results(run, tmp_path / "other")
    (tmp_path / "aside").rename(run / "report.json")
    assert not (tmp_path / "other").exists()


@pytest.mark.integration
def test_an_export_never_replaces_a_run(run, tmp_path):
    other = copytree(run, tmp_path / "other")
    before = {path: path.read_bytes() for path in other.rglob("*") if path.is_file()}
    for folder, why in ((run, "the run itself"), (other, "a run of its own: it has run.rrd")):
        with pytest.raises(ValueError, match=rf"folder is .*, {why}.*; allowed: a new folder, or one with"):
            export_results(run, folder)
    assert {path: path.read_bytes() for path in other.rglob("*") if path.is_file()} == before
    exported = export_results(run, tmp_path / "exported")
    edited(exported, lambda recipe: recipe["experiment"].update(seed=1))
    with pytest.raises(ValueError, match=r"which holds another run: experiment\.seed was 1, is 0"):
        export_results(run, exported)


@pytest.mark.integration
def test_exported_results_find_the_runs_of_frozen_agents(run, tmp_path):
    loaded = cprl.load(run).experiment
    agents = (loaded.agents[0], Frozen(os.path.relpath(run), 0))
    among = cprl.run(replace(loaded, agents=agents, episodes=2), tmp_path / "deep" / "er" / "among")
    folder = export_results(among, tmp_path / "small")
    before, after = (cprl.load(path).agent(1).network.state_dict() for path in (among, folder))
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert export_results(among, folder) == folder, "again over the same"


# Recordings


def views_of(path):
    """The names of the views that a recording opens with."""
    reader, component = RrdReader(path), "ViewBlueprint:display_name"
    (layout,) = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=layout)]
    return [batch.column(component)[0].as_py()[0] for batch in batches if component in batch.schema.names]


def test_a_stored_policy_plays_again_and_every_step_is_recorded(run, tmp_path, capsys, monkeypatch):
    path, played = record_episode(run, tmp_path / "a.rrd", replica=1, episode=3)
    steps, boards = column(path, "/world/board", "SegmentationImage:buffer", "step")
    assert steps == list(range(1, played.steps)), "after the last turn the board is a new one already"
    assert len(boards[0][0]) == (24 + 2) * (7 + 2)
    _, harvested = column(path, "/agent_0/harvested", "Scalars:scalars", "step")
    assert 0 <= played.harvest[0] - harvested[-1][0] <= 1, "told turn by turn, all but the last turn"
    views = ["Apples on the board", "Board", "Events", "Harvest so far, apples", "Recipe"]
    assert sorted(views_of(path))[:5] == views, "no empty plots of a training"
    assert len(views_of(path)) == 7, "and what the agents see, and what their policies say"
    _, again = record_episode(run, tmp_path / "b.rrd", replica=1, episode=3)
    assert again.harvest.tolist() == played.harvest.tolist()
    assert again.shots.tolist() == played.shots.tolist()
    with pytest.raises(FileExistsError):
        record_episode(run, tmp_path / "a.rrd")
    with pytest.raises(ValueError, match="episode is -1"):
        record_episode(run, episode=-1)
    monkeypatch.setattr("sys.argv", ["cprl", "film", str(run), "--out", str(tmp_path / "c.rrd")])
    cli.main()
    watch = f"Watch: {Path(sys.executable).with_name('rerun')} {tmp_path / 'c.rrd'}"
    assert watch in capsys.readouterr().out


@pytest.fixture
def opened(tmp_path, monkeypatch):
    """The commands that this process is replaced by, with a display; there is a recording `run.rrd`."""
    commands = []
    monkeypatch.setenv("DISPLAY", ":9")  # without one it is served until Ctrl-C
    monkeypatch.setattr(cli.os, "execvp", lambda program, command: commands.append(command))
    (tmp_path / "run.rrd").touch()
    return commands


def test_watch_opens_all_recordings_of_a_run_as_one(tmp_path, opened, monkeypatch):
    (tmp_path / "none").mkdir()
    monkeypatch.setattr("sys.argv", ["cprl", "watch", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match=r"cprl: .* holds no recording"):
        cli.main()
    (tmp_path / "recipe.json").touch()
    with pytest.raises(ValueError, match=r"recipe\.json is no recording"):
        cli.watch(tmp_path / "recipe.json")
    for name in ("run-2.rrd", "run-4.rrd", "film-0-0.rrd"):
        (tmp_path / name).touch()
    cli.watch(tmp_path)
    assert opened[0][1:] == [str(tmp_path / "run.rrd"), str(tmp_path / "run-2.rrd")], "and no film"
    cli.watch(tmp_path / "film-0-0.rrd")
    assert opened[1][1:] == [str(tmp_path / "film-0-0.rrd")]


def test_watch_waits_for_the_viewer_on_windows_where_no_program_replaces_another(
    tmp_path, opened, monkeypatch
):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(cli.subprocess, "call", lambda command: opened.append(command) or 3)
    monkeypatch.setattr("cprl.viewer.page.viewer", lambda: "rerun")
    with pytest.raises(SystemExit) as ended:
        cli.watch(tmp_path)
    assert ended.value.code == 3
    assert opened == [["rerun", str(tmp_path / "run.rrd")]]


def test_watch_opens_the_viewer_of_the_package_where_no_command_is_at_hand(tmp_path, opened, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    cli.watch(tmp_path)
    assert [Path(word).is_file() for word in opened[0]] == [True, True]


# Loggers


def csv_of(folder):
    return CSVLogger("csv", str(folder / "logs"))


def files(folder):
    """What stands in each file of scalars, but for the speed."""
    scalars = folder / "logs" / "csv" / "scalars"
    paths = {path.relative_to(scalars).with_suffix("").as_posix(): path for path in scalars.rglob("*.csv")}
    return {name: path.read_text() for name, path in paths.items() if name != "time/env_steps_per_s"}


def test_each_episode_is_written_as_the_mean_of_the_replicas_and_of_each(tmp_path):
    named = MatrixGame(2)
    named.group_map = {"agents": ["row", "column"]}
    with loggers.LoggerCallback(csv_of(tmp_path)) as callback:
        play(named, tit_for_tat, 12, callbacks=[callback])
    # Worlds play 5 and 6 turns: the first two episodes of both have ended after turns 6 and 12.
    assert files(tmp_path) == {
        "social/survival_steps": "0,5.5\n1,5.5\n",
        "replica_0/social/survival_steps": "0,5.0\n1,5.0\n",
        "replica_1/social/survival_steps": "0,6.0\n1,6.0\n",
        "row/return": "0,4.5\n1,4.5\n",
        "replica_0/row/return": "0,4.0\n1,4.0\n",
        "replica_1/row/return": "0,5.0\n1,5.0\n",
        "column/return": "0,9.0\n1,9.0\n",
        "replica_0/column/return": "0,8.5\n1,8.5\n",
        "replica_1/column/return": "0,9.5\n1,9.5\n",
        "row/loss": "0,0.5\n1,0.5\n",
        "time/env_steps": "0,6.0\n1,12.0\n",
    }
    rates = (tmp_path / "logs/csv/scalars/time/env_steps_per_s.csv").read_text().split()
    assert all(float(rate.split(",")[1]) > 0 for rate in rates)


def course(run, batches, *, first=0, state=None, resumes=False):
    """Logs batches; returns the states of tracker and callback after each."""
    tracker = EpisodeTracker(2, 2)
    callback = loggers.LoggerCallback(csv_of(run), resumes=resumes)
    observer = Observer([callback], MatrixGame(2))
    for each, before in zip((tracker, callback, observer), state or (), strict=False):
        each.load_state_dict(before)
    states = []
    for batch in batches[first:]:
        observer.on_step(batch)
        for episode in tracker.add(batch):
            observer.on_episode(episode, {"agent_0/loss": float(episode.steps)})
        states.append((tracker.state_dict(), callback.state_dict(), observer.state_dict()))
    return states


def test_a_resumed_run_has_every_episode_once(tmp_path):
    batches = [batch for batch, _ in zip(StepCollector(MatrixGame(2), tit_for_tat), range(40), strict=False)]
    states = course(tmp_path / "whole", batches)
    for checkpoint, killed in itertools.product((0, 4, 10, 11, 22, 35), (1, 9)):
        run = tmp_path / f"run {checkpoint} {killed}"
        course(run, batches[: checkpoint + killed])
        course(run, batches, first=checkpoint + 1, state=states[checkpoint])
        assert files(run) == files(tmp_path / "whole")
    assert files(tmp_path / "whole")["social/survival_steps"].count("\n") == 6


def test_a_run_that_was_killed_before_its_first_checkpoint_has_every_episode_once(tmp_path):
    batches = [batch for batch, _ in zip(StepCollector(MatrixGame(2), tit_for_tat), range(40), strict=False)]
    course(tmp_path / "whole", batches)
    course(tmp_path / "run", batches[:20])
    course(tmp_path / "run", batches, resumes=True)
    assert files(tmp_path / "run") == files(tmp_path / "whole")


def test_another_training_into_the_same_folder_is_written_behind_the_first(tmp_path):
    for _ in range(2):
        with loggers.LoggerCallback(csv_of(tmp_path)) as callback:
            play(MatrixGame(1), tit_for_tat, 12, callbacks=[callback])
    assert files(tmp_path)["agent_0/return"].count("\n") == 4


def test_a_training_hands_out_numbers_of_its_replicas_and_worlds():
    class Keeps:
        def on_numbers(self, episode, numbers):
            kept.append((episode, numbers))

    kept = []
    agents = {agent: RandomActor(2, seed=agent) for agent in (0, 1)}
    training = Training(MatrixGame(6), {}, Schedule(episodes=6, worlds=3), others=agents, callbacks=[Keeps()])
    training.run()
    assert [episode for episode, _ in kept] == [2, 5]
    for _, numbers in kept:
        assert {name: len(values) for name, values in numbers.items()} == {
            "social/survival_steps": 2,
            "agent_0/return": 2,
            "agent_1/return": 2,
            "time/env_steps": 1,
            "time/env_steps_per_s": 1,
        }
    assert kept[-1][1]["time/env_steps"] == training.steps


def test_an_episode_of_a_replica_that_an_observer_does_not_expect_is_refused_by_name():
    tracker = EpisodeTracker(2, 2)
    turns = list(itertools.islice(StepCollector(MatrixGame(2), tit_for_tat), 7))
    episodes = [episode for turn in turns for episode in tracker.add(turn)]
    (of_another, *_) = (episode for episode in episodes if episode.replica == 1)
    with pytest.raises(ValueError, match=r"replica 1; allowed: of replicas 0 to 0, those of the environment"):
        Observer([], MatrixGame(1)).on_episode(of_another, {})


def test_numbers_that_are_undefined_are_not_written(tmp_path):
    class Undefined:
        def on_episode(self, episode, learning):
            learning |= {"agent_0/loss": float("nan"), "agent_0/epsilon": 0.25}

    with loggers.LoggerCallback(csv_of(tmp_path)) as callback:
        play(MatrixGame(1), tit_for_tat, 5, callbacks=[callback, Undefined()])
    assert "agent_0/loss" not in files(tmp_path)
    assert files(tmp_path)["agent_0/epsilon"] == "0,0.25\n"


@pytest.mark.parametrize("error", [None, RuntimeError("stop")])
def test_a_logger_of_the_users_is_taken_as_it_is_and_closed_at_the_end_and_by_an_error(error, tmp_path):
    class Noting(CSVLogger):
        is_closed = False

        def shutdown(self):
            self.is_closed = True

    logger = Noting("noting", str(tmp_path))
    loggers.check_logger(logger)
    assert loggers.make_logger(logger, tmp_path) is logger
    with contextlib.suppress(RuntimeError), loggers.LoggerCallback(logger) as callback:
        play(MatrixGame(1), tit_for_tat, 5, callbacks=[callback])
        assert not logger.is_closed
        if error:
            raise error
    assert logger.is_closed


def test_a_logger_that_cannot_be_made_is_refused_by_name_before_anything_is_written(tmp_path, monkeypatch):
    for name in ("mlflow", "csv"):
        with pytest.raises(ValueError, match="logger"):
            loggers.check_logger(name)
    with pytest.raises(TypeError, match="logger is a dict without log_metrics"):
        loggers.LoggerCallback({})
    monkeypatch.setattr(loggers, "find_spec", lambda name: None)
    for name in ("tensorboard", "wandb"):
        with pytest.raises(ModuleNotFoundError, match=f"needs the package {name}: pip install {name}"):
            loggers.make_logger(name, tmp_path / "run")
    assert not Path(tmp_path / "run").exists()
