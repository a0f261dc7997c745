"""A run's directory: never written over, gone on with only by the same recipe."""

import json
import os
import shlex
import subprocess
import sys
from dataclasses import MISSING, fields, replace
from pathlib import Path

import pytest
from tiny_study import TINY

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.custom import Custom
from cprl.evaluation.film import film
from cprl.experiment import Experiment
from cprl.population import Frozen, Learning
from cprl.runs.export import export_results
from cprl.runs.recipe import read_recipe, refuse_another_run, resume_command, runs_in, start_run
from cprl.studies.factors import changed
from cprl.system.shipped import cprl_here

AGENT = Learning(DQN(settings=presets.dqn_settings("commons")))
EXPERIMENT = Experiment(
    name="commons",
    game=presets.game("commons"),
    agents=[AGENT] * 3 + [Frozen("runs/earlier", 0)],
    episodes=3,
    replicas=2,
    seed=1,
)


def begin(run, experiment=EXPERIMENT, **options):
    return start_run(run, experiment.name, experiment.to_recipe, **options)


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
    assert resume(run) == 3
    assert resume(run, replace(EXPERIMENT, episodes=5)) == 3, "it can be extended"
    assert (run / "recipe.json").read_text() == written
    with pytest.raises(FileExistsError, match="is not empty"):
        begin(run)


def test_the_recipe_of_a_run_is_its_experiment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = begin(None, command=["recipes/commons.py", "--episodes", "3"])
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
    loaded = cprl.load(cprl.run(among, Path(f"{name} among"), watch="off", figures=False))
    assert loaded.agent(1).network is not None
    assert cprl.evaluate_run(exported, episodes=1).measures("trained")
    assert film(started, Path("film.rrd"), replica=0, episode=0)[0].exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, r"was started with another recipe: experiment\.seed was 1, is 2$"),
        ({"episodes": 2}, "has 3 episodes"),
        ({"name": "two_complex"}, r"experiment\.name was .commons., is .two_complex.$"),
        (
            {"game": presets.game("commons", variant="as_run")},
            r"experiment\.game\.rules\.hits_to_tag was 1, is 2; .*; and 4 more$",
        ),
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
        del recipe["experiment"]["game"]["rules"]["walls_block_sight"]

    edited(run, without_later_fields)
    assert resume(run, default) == EXPERIMENT.episodes
    with pytest.raises(ValueError, match=r"experiment\.update_every was not there, is 7"):
        resume(run, replace(default, update_every=7))
    with pytest.raises(ValueError, match=r"settings\.steps_per_update was not there, is 4$"):
        resume(run, changed(default, {"agents.0.algorithm.settings.steps_per_update": 4}))
    edited(run, lambda recipe: recipe["experiment"]["agents"][0]["algorithm"].pop("settings"))
    with pytest.raises(ValueError, match=r"algorithm\.settings was not there, is "):
        resume(run, default)


def test_a_run_of_another_format_is_not_resumed(tmp_path):
    run = begin(tmp_path / "run")
    edited(run, lambda recipe: recipe.update(format=1))
    with pytest.raises(ValueError, match="format"):
        resume(run)


def test_where_nothing_can_be_resumed_that_is_said(tmp_path):
    with pytest.raises(ValueError, match="resume requires the directory of the run as out"):
        resume(None)
    with pytest.raises(ValueError, match=r"recipe\.json is not the recipe of a run: FileNotFoundError"):
        resume(tmp_path / "nothing")
    for text in ("{", "[]", '{"arguments": 3}', '{"experiment": []}'):
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
    resumes = resume_command(tmp_path, command)
    assert resumes == f"{sys.executable} recipes/commons.py{line} --out {tmp_path} --resume"


def test_a_run_that_python_began_is_resumed_by_the_command_cprl(tmp_path):
    experiment = replace(EXPERIMENT, callbacks=(Custom("my:Callback"), Custom("my:Other")))
    run = begin(tmp_path / "run", experiment)
    cprl = shlex.join(cprl_here())
    assert resume_command(run) == f"{cprl} run {run} --resume --allow my:Callback --allow my:Other"
    assert resume_command(tmp_path) == f"{cprl} run {tmp_path} --resume"
