"""Results are exported small and whole, play again, and are watched."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pyarrow as pa
import pytest
import torch
from recordings import column
from rerun.chunk import RrdReader

import cprl
from cprl.evaluation.film import film
from cprl.population import Frozen
from cprl.runs.curves import as_curves, running_mean
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results


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
    content = json.loads((exported / "recipe.json").read_text())
    content["experiment"]["seed"] += 1
    (exported / "recipe.json").write_text(json.dumps(content))
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


def views_of(path):
    """The names of the views that a recording opens with."""
    reader, component = RrdReader(path), "ViewBlueprint:display_name"
    (layout,) = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=layout)]
    return [batch.column(component)[0].as_py()[0] for batch in batches if component in batch.schema.names]


def test_a_stored_policy_plays_again_and_every_step_is_recorded(run, tmp_path, capsys, monkeypatch):
    from cprl.commands import main as cli

    path, played = film(run, tmp_path / "a.rrd", replica=1, episode=3)
    steps, boards = column(path, "/world/board", "SegmentationImage:buffer", "step")
    assert steps == list(range(1, played.steps)), "after the last turn the board is a new one already"
    assert len(boards[0][0]) == (24 + 2) * (7 + 2)
    _, harvested = column(path, "/agent_0/harvested", "Scalars:scalars", "step")
    assert 0 <= played.harvest[0] - harvested[-1][0] <= 1, "told turn by turn, all but the last turn"
    views = ["Apples on the board", "Board", "Events", "Harvest so far, apples", "Recipe"]
    assert sorted(views_of(path))[:5] == views, "no empty plots of a training"
    assert len(views_of(path)) == 7, "and what the agents see, and what their policies say"
    _, again = film(run, tmp_path / "b.rrd", replica=1, episode=3)
    assert again.harvest.tolist() == played.harvest.tolist()
    assert again.shots.tolist() == played.shots.tolist()
    with pytest.raises(FileExistsError):
        film(run, tmp_path / "a.rrd")
    with pytest.raises(ValueError, match="episode is -1"):
        film(run, episode=-1)
    monkeypatch.setattr("sys.argv", ["cprl", "film", str(run), "--out", str(tmp_path / "c.rrd")])
    cli.main()
    watch = f"Watch: {Path(sys.executable).with_name('rerun')} {tmp_path / 'c.rrd'}"
    assert watch in capsys.readouterr().out


def test_watch_opens_all_recordings_of_a_run_as_one(tmp_path, monkeypatch, capsys):
    from cprl.commands import main as cli

    opened = []
    monkeypatch.setenv("DISPLAY", ":9")  # without one it is served until Ctrl-C
    monkeypatch.setattr(cli.os, "execvp", lambda program, command: opened.append(command))
    monkeypatch.setattr("sys.argv", ["cprl", "watch", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"cprl: .* holds no recording"):
        cli.main()
    for name in ("run.rrd", "run-2.rrd"):
        (tmp_path / name).touch()
    cli.main()
    assert opened[0][1:] == [str(tmp_path / "run-2.rrd"), str(tmp_path / "run.rrd")]


def test_watch_waits_for_the_viewer_on_windows_where_no_program_replaces_another(tmp_path, monkeypatch):
    from cprl.commands import main as cli

    def call(command):
        opened.append(command)
        return 3

    opened = []
    (tmp_path / "run.rrd").touch()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(cli.subprocess, "call", call)
    monkeypatch.setattr("cprl.viewer.page.viewer", lambda: "rerun")
    with pytest.raises(SystemExit) as ended:
        cli.watch(tmp_path)
    assert ended.value.code == 3
    assert opened == [["rerun", str(tmp_path / "run.rrd")]]


def test_watch_opens_the_viewer_of_the_package_where_no_command_is_at_hand(tmp_path, monkeypatch):
    from cprl.commands import main as cli

    opened = []
    (tmp_path / "run.rrd").touch()
    monkeypatch.setenv("DISPLAY", ":9")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(cli.os, "execvp", lambda program, command: opened.append(command))
    cli.watch(tmp_path)
    assert [Path(word).is_file() for word in opened[0]] == [True, True]


def test_watch_refuses_a_file_that_is_no_recording(tmp_path):
    from cprl.commands import main as cli

    (tmp_path / "recipe.json").touch()
    with pytest.raises(ValueError, match=r"recipe\.json is no recording; allowed: .* that ends in \.rrd"):
        cli.watch(tmp_path / "recipe.json")


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


def test_running_means_stand_at_their_first_episode_and_leave_out_what_is_undefined():
    assert running_mean(np.array([1.0, 2.0, 6.0, 4.0]), 2).tolist() == [1.5, 4.0, 5.0]
    assert running_mean(np.array([[1.0, np.nan, 3.0]]), 2).tolist() == [[1.0, 3.0]]
    assert running_mean(np.array([1.0, 2.0]), 5).tolist() == [1.5]
