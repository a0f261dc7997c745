"""A run's directory: never written over, gone on with only by the same recipe."""

import sys

import pytest

from cprl import presets
from cprl.runs.directory import read_recipe, resume_command, start_run

RECIPE = {"replicas": 2, "seed": 1, "learner": presets.learner("commons")}


def test_a_stopped_run_is_gone_on_with_by_the_same_recipe(tmp_path):
    run = start_run(tmp_path / "run", "commons", RECIPE)
    written = (run / "recipe.json").read_text()
    (run / "episodes.arrows").touch()
    assert start_run(run, "commons", RECIPE, resume=True) == run
    assert (run / "recipe.json").read_text() == written
    with pytest.raises(FileExistsError, match="is not empty"):
        start_run(run, "commons", RECIPE)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("commons", {"seed": 2}, "was begun with other arguments: seed 1 then, 2 now"),
        ("commons", {"device": "cpu"}, "device None then, cpu now"),
        ("two_complex", {}, "is a run of 'commons'; this is 'two_complex'"),
    ],
)
def test_another_recipe_is_refused(name, change, message, tmp_path):
    run = start_run(tmp_path / "run", "commons", RECIPE)
    with pytest.raises(ValueError, match=message):
        start_run(run, name, {**RECIPE, **change}, resume=True)


def test_where_nothing_can_be_gone_on_with_that_is_said(tmp_path):
    with pytest.raises(ValueError, match="go_on wants the directory of the run as out"):
        start_run(None, "commons", RECIPE, resume=True)
    with pytest.raises(ValueError, match=r"recipe\.json is no recipe of a run: FileNotFoundError"):
        start_run(tmp_path / "nothing", "commons", RECIPE, resume=True)
    for text in ("{", "[]", '{"arguments": 3}'):
        (tmp_path / "recipe.json").write_text(text)
        with pytest.raises(ValueError, match=r"recipe\.json is no recipe of a run: "):
            read_recipe(tmp_path)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ([], ""),
        (["--seed", "3"], " --seed 3"),
        (["--out", "elsewhere", "--seed", "3"], " --seed 3"),
        (["--seed", "3", "--out=elsewhere", "--go-on"], " --seed 3"),
    ],
)
def test_the_line_that_goes_on_is_the_one_that_began_with_the_runs_directory(
    given, line, monkeypatch, tmp_path
):
    monkeypatch.setattr(sys, "argv", ["recipes/commons.py", *given])
    assert resume_command(tmp_path) == f"{sys.executable} recipes/commons.py{line} --out {tmp_path} --go-on"
