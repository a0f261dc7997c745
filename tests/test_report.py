"""Results are kept small and whole, and a report is made of them alone."""

import importlib.util
import json
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import torch
from recordings import column
from rerun.chunk import RrdReader

import cprl
from cprl import presets
from cprl.custom import Custom
from cprl.evaluation.film import film
from cprl.measuring.movement import Trace
from cprl.measuring.published import curve, published_experiment
from cprl.measuring.statistics import estimate
from cprl.population import Frozen, Scripted
from cprl.reporting import report, write_report
from cprl.reporting.claims import undefined_in
from cprl.reporting.measures import ROUNDS, dip_depth, measures, of_play, of_training
from cprl.reporting.pooled import pooled
from cprl.reporting.result import Result, read_result
from cprl.reporting.turning import turning_points_of
from cprl.runs.curves import as_curves, running_mean
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results

RECIPES = Path(__file__).parents[1] / "recipes"


def recipe(name):
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A miniature of experiment 4, with episodes of 40 steps."""
    game = presets.game

    def shorter(board, *, variant="published"):
        whole = game(board, variant=variant)
        return replace(whole, rules=replace(whole.rules, episode_steps=40))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(presets, "game", shorter)
        how = {"replicas": 2, "episodes": 12, "evaluation_episodes": 2, "engine": "eager"}
        experiment = recipe("two_against_random").experiment(variant="as_run")
        return cprl.run(replace(experiment, **how), tmp_path_factory.mktemp("runs") / "four")


@pytest.mark.integration
def test_what_is_kept_says_the_same_as_the_run(run, tmp_path):
    folder = export_results(run, tmp_path / "kept")
    assert export_results(run, folder) == folder, "again over the same"
    kept, whole = read_episodes(folder).to_pydict(), read_episodes(run)
    ordered = whole.sort_by([(name, "ascending") for name in ("replica", "episode", "agent")]).to_pydict()
    assert set(kept) == set(ordered)
    for name, values in ordered.items():
        np.testing.assert_array_equal(np.float32(kept[name]), np.float32(values), err_msg=name)
    mine, theirs = cprl.load(folder), cprl.load(run)
    assert mine.game == theirs.game
    assert sorted(mine.networks) == sorted(theirs.networks)
    assert not list(folder.rglob("training-*"))
    (run / "report.json").rename(tmp_path / "aside")
    with pytest.raises(FileNotFoundError, match=r"report\.json does not exist: has the run ended\?"):
        export_results(run, tmp_path / "other")
    (tmp_path / "aside").rename(run / "report.json")
    assert not (tmp_path / "other").exists()


@pytest.mark.integration
def test_results_without_weights_are_reported_but_never_played(run, tmp_path):
    whole = export_results(run, tmp_path / "two_against_random")
    everything = write_report([whole], tmp_path / "whole").read_text()
    folder = export_results(run, whole, weights=False)
    assert not (folder / "checkpoints" / "final.pt").exists(), "that of the earlier export is gone"
    with pytest.raises(ValueError, match=r"two_against_random keeps no weights: its results were exported"):
        cprl.load(folder)
    with pytest.raises(FileNotFoundError, match=r"final\.pt does not exist"):
        export_results(folder, tmp_path / "with them")
    text = write_report([folder], tmp_path / "less").read_text()
    assert "Exported without weights: nobody could play" in text
    assert "Exported without weights" not in everything
    of_play = ("it tags when near", "its policy circles", "| shots per 1000 steps, all agents |")
    assert all(name in everything and name not in text for name in of_play)
    (kept,) = [line for line in everything.splitlines() if line.startswith("| it prevents depletion |")]
    assert kept in text, "claims on the training stay"
    again = export_results(folder, tmp_path / "copy", weights=False)
    tables = [(own / "episodes.parquet").read_bytes() for own in (again, folder)]
    assert tables[0] == tables[1]
    export_results(run, folder)
    (folder / "checkpoints" / "final.pt").unlink()
    with pytest.raises(ValueError, match=r"checkpoints/final\.pt"):
        write_report([folder], tmp_path / "lost")


@pytest.mark.integration
def test_an_export_never_replaces_a_run(run, tmp_path):
    other = tmp_path / "other"
    copytree(run, other)
    before = {path: path.read_bytes() for path in other.rglob("*") if path.is_file()}
    for folder, why in ((run, "the run itself"), (other, "a run of its own: it has run.rrd")):
        with pytest.raises(ValueError, match=rf"folder is .*, {why}.*; allowed: a new folder, or one with"):
            export_results(run, folder)
    assert {path: path.read_bytes() for path in other.rglob("*") if path.is_file()} == before
    kept = export_results(run, tmp_path / "kept")
    content = json.loads((kept / "recipe.json").read_text())
    content["experiment"]["seed"] += 1
    (kept / "recipe.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"which holds another run: experiment\.seed was 1, is 0"):
        export_results(run, kept)


@pytest.mark.integration
def test_exported_results_find_the_runs_of_frozen_agents(run, tmp_path):
    loaded = cprl.load(run).experiment
    agents = (loaded.agents[0], Frozen(os.path.relpath(run), 0))
    among = cprl.run(replace(loaded, agents=agents, episodes=2), tmp_path / "deep" / "er" / "among")
    folder = export_results(among, tmp_path / "small")
    mine, theirs = (cprl.load(own).agent(1).network.state_dict() for own in (among, folder))
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert export_results(among, folder) == folder, "again over the same"


@pytest.mark.integration
def test_a_report_tells_every_number_from_the_results_alone(run, tmp_path):
    folder = export_results(run, tmp_path / "two_against_random")
    text = write_report([folder], tmp_path).read_text()
    returns = as_curves(read_episodes(run))["collective_return"]
    assert "random play, published" not in text, "the study gives no random score for experiment 4"
    assert f"| two_against_random | 4 | 184.07 | {returns.mean():.4g} [" in text
    assert "epsilon decays in 500,000 steps, 2 replicas of 12 episodes" in text
    for metric in ("collective_return", "return_0", "return_1"):
        figure = tmp_path / "figures" / f"two_against_random_{metric}.png"
        assert figure.stat().st_size > 10_000
        assert f"(figures/{figure.name})" in (tmp_path / "figures.md").read_text()
    assert "| two_against_random | return_1 | too few episodes |" in text
    assert "| shots per 1000 steps, all agents | " in text
    assert "| 4 | return_1 | 50 | 27.9 | 137 |" in text, "windows of the published curves"
    assert "| it prevents depletion | share of the last 500 episodes" in text
    assert "| cannot be told with 2 runs |" in text
    assert "published curves | 400" not in text, "phases are of experiment 5 alone"
    assert "nan" not in text
    assert write_report([folder], tmp_path / "again").read_text() == text, "the same from the same"


@pytest.mark.integration
def test_a_report_of_runs_of_one_name_is_refused_and_other_names_are_links(run, tmp_path):
    one, two = (export_results(run, tmp_path / folder / "a run | of mine") for folder in ("one", "two"))
    with pytest.raises(ValueError, match=r"both named 'a run \| of mine'; allowed: runs whose"):
        write_report([one, two], tmp_path / "report")
    assert not (tmp_path / "report").exists()
    text = write_report([one], tmp_path / "report").read_text()
    figures = (tmp_path / "report" / "figures.md").read_text()
    assert "](figures/a%20run%20%7C%20of%20mine_collective_return.png)" in figures
    assert (tmp_path / "report" / "figures" / "a run | of mine_collective_return.png").exists()
    assert "| a run \\| of mine | two_against_random" in text


@pytest.fixture(scope="module")
def other(run):
    """The same experiment with another seed and number of replicas."""
    experiment = cprl.load(run).experiment
    return cprl.run(replace(experiment, seed=1000, replicas=3), run.with_name("other"), watch="off")


@pytest.mark.integration
def test_runs_of_one_experiment_are_pooled_where_it_is_asked_for(run, other, tmp_path):
    longer = export_results(run, tmp_path / "longer")
    with_field(longer, "experiment", lambda experiment: {**experiment, "seed": 2000, "update_every": 2})
    text = write_report([run, longer, other], tmp_path / "pooled", pool=True).read_text()
    mine, theirs = (as_curves(read_episodes(own))["collective_return"].mean(1) for own in (run, other))
    assert len(mine) == 2
    assert len(theirs) == 3
    assert f"| four+other | 4 | 184.07 | {estimate(np.concatenate([mine, theirs]))} |" in text
    assert f"| longer | 4 | 184.07 | {estimate(mine)} |" in text, "of another experiment"
    assert "as runs of one experiment: four and other as four+other.\n" in text
    before, after = text.split("## Share of the possible")
    assert "| four | two_against_random" in before, "each run has its training and its command"
    assert "| four |" not in after
    assert (tmp_path / "pooled" / "figures" / "four+other_return_1.png").exists()
    apart = write_report([run, other], tmp_path / "apart").read_text()
    assert f"| four | 4 | 184.07 | {estimate(mine)} |" in apart, "nothing is pooled unless it is asked for"
    none = write_report([run, longer], tmp_path / "none", pool=True).read_text()
    assert "Nothing is pooled: no two runs have experiments equal but for name, seed" in none


@pytest.mark.integration
def test_a_pool_has_what_its_runs_have_replica_by_replica(run, other):
    parts = [read_result(run), read_result(other)]
    (both,) = pooled(parts)
    assert "5 replicas of 12 episodes" in both.title
    for of in (
        lambda result: result.curves["survival_steps"],
        lambda result: result.of_agents("return"),
        lambda result: result.evaluated("trained")["collective_return"],
        lambda result: result.measures.training["mean collective return over training"],
    ):
        np.testing.assert_array_equal(of(both), np.concatenate([of(part) for part in parts]))
    assert both.of_agents("no such column") is None
    trained, random = both.measures.trained, both.measures.random
    assert {len(values) for values in (*trained.values(), *random.values())} == {5}
    name = ROUNDS.format(agent=0)
    np.testing.assert_array_equal(trained[name][:2], parts[0].measures.trained[name])
    assert not np.array_equal(random[name][:2], random[name][2:4]), "each run plays in worlds of its own"


@pytest.mark.integration
def test_a_pool_of_which_a_run_has_no_weights_is_of_trainings_alone(run, other, tmp_path):
    light = export_results(other, tmp_path / "light", weights=False)
    text = write_report([run, light], tmp_path / "report", pool=True).read_text()
    assert "Exported without weights, some of the runs: nobody could play" in text
    assert "shots per 1000 steps" not in text


@pytest.mark.integration
def test_a_pool_is_named_so_that_its_figures_can_be_written(run, other, tmp_path):
    one, two = export_results(run, tmp_path / ("a" * 100)), export_results(other, tmp_path / ("b" * 100))
    (both,) = pooled([read_result(one), read_result(two)])
    assert both.name == "a" * 100 + "+1 more"
    four = export_results(run, tmp_path / "four+other")
    with_field(four, "experiment", lambda experiment: {**experiment, "update_every": 2})
    with pytest.raises(ValueError, match=r"both named 'four\+other'"):
        write_report([run, other, four], tmp_path / "report", pool=True)
    assert not (tmp_path / "report").exists()


@pytest.mark.integration
def test_runs_of_the_same_replicas_are_not_pooled(run, tmp_path):
    again = export_results(run, tmp_path / "again")
    with pytest.raises(ValueError, match=r"both of seed 0, which have the same replicas; allowed in a pool"):
        write_report([run, again], tmp_path / "report", pool=True)
    assert not (tmp_path / "report").exists()
    with_field(again, "recipe", lambda name: "mine")
    assert len(pooled([read_result(run), read_result(again)])) == 2, "one repeats experiment 4, by its name"


def with_field(run, name, changed):
    """Changes an entry of a run's recipe."""
    recipe = json.loads((run / "recipe.json").read_text())
    (run / "recipe.json").write_text(json.dumps({**recipe, name: changed(recipe[name])}))


@pytest.mark.integration
def test_runs_that_are_not_the_studys_have_no_columns_for_what_was_published(run, tmp_path):
    own = export_results(run, tmp_path / "fishery")
    content = json.loads((own / "recipe.json").read_text())
    (own / "recipe.json").write_text(json.dumps({**content, "recipe": "fishery"}))
    text = write_report([own], tmp_path).read_text()
    before, after = text.split("## Runs")[0], text.split("## Collective return")[1]
    assert "published" not in before + after, "in between stands the command, which may say anything"
    assert "| fishery | " in after
    assert "| shots per 1000 steps, all agents | " in text
    assert "(figures/fishery_collective_return.png)" in (tmp_path / "figures.md").read_text()
    both = write_report([own, export_results(run, tmp_path / "two_against_random")], tmp_path).read_text()
    assert "| fishery |" not in both.split("## Appendix A")[1].split("## Collective return")[0]


@pytest.mark.integration
def test_agents_of_which_none_learns_are_not_called_trained(run, tmp_path):
    game = cprl.Game(map=cprl.maps.parse(">.A.\n.A.<"), rules=cprl.Rules(episode_steps=20))
    agents = [Scripted("random")] * 2
    alone = cprl.Experiment(name="scripted", game=game, agents=agents, episodes=12, engine="eager")
    scripted = cprl.run(alone, tmp_path / "scripted")
    measures = write_report([scripted], tmp_path).read_text().split("## Measures")[1]
    assert "| measure | agents | random policy |" in measures
    assert "last 500" not in measures, "there were 12 episodes"
    returns = write_report([scripted], tmp_path).read_text().split("## Collective return")[1]
    assert "| run | random play | whole training | evaluation |" in returns
    assert "trained |" not in measures
    assert "| measure | trained | random policy |" in write_report([run], tmp_path).read_text()


@pytest.mark.integration
def test_the_command_writes_a_report(run, tmp_path, capsys, monkeypatch):
    from cprl.commands import main as cli

    monkeypatch.setattr("sys.argv", ["cprl", "export", str(run), str(tmp_path / "kept")])
    cli.main()
    command = ["cprl", "report", str(tmp_path / "kept"), "--out", str(tmp_path / "r"), "--pool"]
    monkeypatch.setattr("sys.argv", command)
    cli.main()
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "r" / "tables.md")
    monkeypatch.setattr("sys.argv", ["cprl", "report"])
    with pytest.raises(SystemExit, match="cprl: cprl report wants at least one run"):
        cli.main()


@pytest.mark.integration
def test_a_report_imports_code_of_ones_own_where_it_is_allowed(tmp_path, capsys, monkeypatch):
    from cprl.commands import main as cli

    game = cprl.Game(map=cprl.maps.parse(">.A.\n.A.<"), rules=cprl.Rules(episode_steps=5))
    target = "torchrl.envs:StepCounter"
    own = cprl.Experiment(
        name="counted",
        game=game,
        agents=[Scripted("random")] * 2,
        episodes=4,
        evaluation_episodes=2,
        engine="eager",
        transforms=(Custom(target, {}),),
    )
    run = cprl.run(own, tmp_path / "counted", watch="off", allow=[target])
    with pytest.raises(ValueError, match=target):
        write_report([run], tmp_path / "report")
    assert "| counted |" in write_report([run], tmp_path / "report", allow=[target]).read_text()
    line = ["cprl", "report", str(run), "--allow", target, "--out", str(tmp_path / "again")]
    monkeypatch.setattr("sys.argv", line)
    cli.main()
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "again" / "tables.md")


@pytest.mark.parametrize(
    ("stored", "listed"),
    [
        ("cprl run commons --seed 3", "cprl run commons --seed 3"),
        (".venv/bin/cprl run commons --seed 3 --resume", "cprl run commons --seed 3"),
        (r"'.venv\Scripts\cprl' run commons", "cprl run commons"),
        ("cprl/recipes/commons.py --resume", "python recipes/commons.py"),
        ("cprl.py", "python cprl.py"),
    ],
)
def test_a_report_lists_a_run_by_the_command_or_the_recipe_that_made_it(stored, listed):
    assert report._command(stored) == listed


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
    told = capsys.readouterr().out
    assert f"Watch: {Path(sys.executable).with_name('rerun')} {tmp_path / 'c.rrd'}" in told


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


@pytest.mark.integration
def test_reproduce_runs_what_is_missing_and_reports(tmp_path, monkeypatch, capsys):
    reproduce = recipe("reproduce")
    asked = []

    def in_miniature(command, **how):
        asked.append(command)
        name = Path(command[1]).stem
        at = Path(command[command.index("--out") + 1])
        small = {"replicas": 2, "episodes": 5, "evaluation_episodes": 1, "engine": "eager"}
        if "--resume" not in command and len(asked) == 1:
            at.mkdir()
            (at / "recipe.json").write_text("{}")  # it was stopped
            return type("Done", (), {"returncode": 0})
        if not (at / "report.json").exists():
            (at / "recipe.json").unlink(missing_ok=True)
            cprl.run(replace(recipe(name).experiment(variant="as_run"), **small), at)
        return type("Done", (), {"returncode": 0})

    game = presets.game
    monkeypatch.setattr(
        presets,
        "game",
        lambda board, *, variant="published": replace(
            game(board, variant=variant), rules=replace(game(board, variant=variant).rules, episode_steps=20)
        ),
    )
    monkeypatch.setattr(reproduce, "subprocess", SimpleNamespace(run=in_miniature, STDOUT=None))
    how = {
        "runs": tmp_path / "runs",
        "results": tmp_path / "results",
        "only": ("single_basic",),
        "processes": 1,
    }
    with pytest.raises(ChildProcessError, match=r"single_basic ended with 0 and is not finished; see .*log"):
        reproduce.main(**how)
    report = reproduce.main(**how)
    assert "--resume" in asked[1]
    assert "| single_basic | 1 | 32.47 | " in report.read_text()
    assert "(figures/single_basic_collective_return.png)" in report.with_name("figures.md").read_text()
    reproduce.main(**how)
    assert "--resume" in asked[2], "its recipe says whether what is finished is this experiment"
    with pytest.raises(ValueError, match="there is no experiment 'fishery'; allowed: commons, single_basic"):
        reproduce.main(runs=tmp_path, only=("fishery",))


def test_reproduce_refuses_a_finished_run_of_another_recipe_with_the_words_of_its_recipe(
    tmp_path, monkeypatch
):
    reproduce = recipe("reproduce")
    finished = tmp_path / "single_basic"
    finished.mkdir()
    for name in ("recipe.json", "report.json"):
        (finished / name).write_text("{}")

    def refuse(command, *, stdout, **how):
        assert command[-1] == "--resume"
        stdout.write("single_basic.py: it was started with another recipe: episodes 9 and 5\n")
        return SimpleNamespace(returncode=1)

    monkeypatch.setattr(reproduce, "subprocess", SimpleNamespace(run=refuse, STDOUT=None))
    with pytest.raises(ChildProcessError, match=r"single_basic ended with 1 .*: episodes 9 and 5$"):
        reproduce.run("single_basic", [], runs=tmp_path, results=tmp_path / "results")


def test_reproduce_begins_nothing_more_once_an_experiment_has_failed(tmp_path, monkeypatch):
    reproduce, begun = recipe("reproduce"), []

    def fail(name, common, **where):
        begun.append(name)
        raise ChildProcessError(name)

    monkeypatch.setattr(reproduce, "run", fail)
    where = {"runs": tmp_path, "results": tmp_path}
    with pytest.raises(ChildProcessError, match="commons"):
        reproduce.run_all(["commons", "single_basic", "two_complex"], [], processes=1, **where)
    assert begun == ["commons"]


def test_reproduce_begins_nothing_more_after_ctrl_c(tmp_path, monkeypatch):
    reproduce, begun = recipe("reproduce"), []

    def interrupted(name, common, **where):
        begun.append(name)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(0.2)  # as a training that saves its state

    monkeypatch.setattr(reproduce, "run", interrupted)
    where = {"runs": tmp_path, "results": tmp_path}
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            reproduce.run_all(["commons", "single_basic", "two_complex"], [], processes=1, **where)
    finally:
        signal.signal(signal.SIGINT, before)
    assert begun == ["commons"]


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


def test_a_report_counts_the_episodes_in_which_a_metric_is_undefined():
    equality = np.array([[0.5, np.nan, 1.0], [np.nan, np.nan, 1.0]])
    assert undefined_in(equality) == ", undefined in 3 of 6 episodes"
    assert undefined_in(equality[:, 2:]) == ""


def test_a_dip_is_measured_from_the_peak_before_it():
    assert dip_depth(np.array([[10.0, 20.0, 5.0, 30.0], [1.0, 2.0, 3.0, 4.0]])).tolist() == [0.75, 0.0]
    published = np.interp(np.arange(600), *curve("exp1/return"))[None]
    assert dip_depth(published)[0] == pytest.approx(1 - 104 / 146, abs=0.02)


def test_measures_of_training_know_rich_and_poor():
    flat = np.ones((3, 700))
    curves = {
        "collective_return": 4 * flat,
        "return_0": 3 * flat,
        "return_1": flat,
        "survival_steps": 900 * flat,
    }
    found = of_training(curves)
    assert (
        found["return of the poorest agent over that of the richest, last 500 episodes"].tolist()
        == [1 / 3] * 3
    )
    assert found["mean collective return over training"].tolist() == [4.0] * 3
    dip, peak = "depth of the deepest dip before episode 600", "episode of the highest collective return"
    assert all(any(name.startswith(own) for name in found) for own in (dip, peak))
    short = of_training({name: values[:, :20] for name, values in curves.items()})
    assert list(short) == [
        "mean collective return over training",
        "return of the poorest agent over that of the richest, whole training",
    ]


def test_every_published_experiment_is_reproduced():
    named = {arguments[0] for arguments in recipe("reproduce").EXPERIMENTS.values()}
    assert {published_experiment(name).number for name in named} == {1, 2, 3, 4, 5}


def test_agents_at_play_are_measured_replica_by_replica():
    shape = 2, 4, 2  # two steps, two worlds for each of two replicas, two agents
    columns = np.array([[0, 4], [0, 4], [3, 3], [3, 3]])  # four steps apart; in one place
    fired = np.zeros(shape, bool)
    fired[0, 0, 0] = True
    played = Trace(
        row=np.zeros(shape, int),
        col=np.broadcast_to(columns, shape),
        in_play=np.ones(shape, bool),
        fired=fired,
        played=np.ones(shape[:2], bool),
        board=(3, 9),
    )
    found = of_play(played, replicas=2)
    assert found["shots per 1000 steps, all agents"].tolist() == [250.0, 0.0]
    assert found["overlap of the cells that two agents visit"].tolist() == [0.0, 1.0]
    nearness = found["steps to the nearest other when firing, over that in all steps"]
    np.testing.assert_array_equal(nearness, [1.0, np.nan], "in replica 1 nobody fired")


def test_the_random_walker_beside_a_learner_moves_as_the_random_policy_does(run):
    """Chance of its own in every replica and world, whatever plays beside it."""
    found, name = measures(run), ROUNDS.format(agent=1)
    assert found.trained[name].mean() == pytest.approx(found.random[name].mean(), rel=0.2)


def test_turning_points_are_those_of_the_mean_of_replicas(tmp_path):
    """300 episodes, with a peak at 160 and a survival that gives way at 200."""
    episodes = np.arange(300)
    returns = np.where(episodes < 160, episodes * 1.0, 320.0 - episodes)
    survival = np.where(episodes < 200, 1000.0, 600.0)
    result = Result(
        path=tmp_path / "five",
        recipe={},
        experiment=None,
        report={},
        curves={
            "collective_return": np.stack([returns, returns]),
            "survival_steps": np.stack([survival, survival]),
        },
        study=published_experiment("commons"),
    )
    published, ours = turning_points_of([result])[-3:-1]
    assert published == "| published curves | 572 | 364 | 339 | 1395 | 564 | 612 |  |"
    smoothed = running_mean(returns, 30)
    top = int(smoothed.argmax())
    first = int((running_mean(survival, 30) < 990).argmax())
    assert ours == (
        f"| five | {smoothed[top]:.0f} | {top} | {smoothed[-1]:.0f} | 270 | {first} | 600 | 600 to 600 |"
    )
    assert first == 171, "the first mean of which one of thirty episodes is short"
    assert turning_points_of([]) == []
