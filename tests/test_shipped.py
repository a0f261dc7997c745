"""Recipes that come with cprl: listed, printed, and run by their names."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import cprl
from cprl.commands import main as cli
from cprl.commands.recipe import refuse_mistyped_flags
from cprl.runs.recipe import resume_command, start_run
from cprl.system import shipped
from cprl.system.shipped import (
    command_of,
    cprl_here,
    import_from,
    is_shipped,
    recipe_named,
    run_shipped,
    shipped_recipes,
)

ROOT = Path(__file__).parents[1]
SHORT = (
    "--engine eager --episodes 1 --replicas 1 --evaluation-episodes 1 --watch off "
    "--game.rules.episode-steps 5"
)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder of somebody's own; modules that recipes share are forgotten at the end."""
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if not name.startswith("cprl"):
            sys.modules.pop(name)


def call(monkeypatch, line):
    monkeypatch.setattr(sys, "argv", ["cprl", *line.split()])
    cli.main()


def test_every_file_of_recipes_is_shipped_under_its_name():
    files = {path.relative_to(ROOT / "recipes") for path in (ROOT / "recipes").rglob("*.py")}
    assert {Path(f"{name}.py") for name in shipped_recipes()} == files
    shared = {name for name, own in shipped_recipes().items() if not own.runs}
    assert shared >= {"study/base", "study/learners/ways", "study/perolat/perolat_base", "study/verdicts"}
    assert all(own.about.endswith((".", "?")) for own in shipped_recipes().values())


def test_the_recipes_are_listed_with_a_line_each(monkeypatch, capsys):
    call(monkeypatch, "recipe")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == sum(own.runs for own in shipped_recipes().values())
    (line,) = [line for line in lines if line.startswith("study/time_out ")]
    assert line.endswith(
        "How long should a tagged agent stay out? The time-out, from one turn to most of an episode."
    )


def test_a_recipe_is_printed_as_it_is(monkeypatch, capsys):
    call(monkeypatch, "recipe commons")
    assert capsys.readouterr().out == (ROOT / "recipes" / "commons.py").read_text()


@pytest.mark.integration
@pytest.mark.parametrize(
    "name", [name for name, shared in shipped_recipes().items() if "import_from" in shared.text()]
)
def test_a_printed_recipe_that_imports_others_finds_them_anywhere(name, elsewhere, monkeypatch):
    monkeypatch.setattr(sys, "path", ["before", str(elsewhere), *sys.path])
    script = ModuleType("__main__")
    script.__file__ = str(elsewhere / "mine.py")
    monkeypatch.setitem(sys.modules, "__main__", script)
    code = compile(recipe_named(name).text(), "mine.py", "exec")
    exec(code, {"__name__": "mine"})
    folder = str(ROOT / "recipes" / recipe_named(name).folder)
    assert sys.path.index(folder) == 2, "behind the folder of the script, whose own modules come first"


@pytest.mark.integration
def test_a_module_of_ones_own_comes_before_that_of_the_recipes(elsewhere):
    (elsewhere / "mine.py").write_text(recipe_named("study/time_out").text())
    (elsewhere / "base.py").write_text("raise SystemExit('my own base')")
    done = subprocess.run([sys.executable, "mine.py", "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (1, "my own base")


@pytest.mark.integration
def test_a_recipe_is_run_by_its_name_with_its_own_flags(elsewhere, monkeypatch, capsys):
    call(monkeypatch, f"run two_complex --variant as_run --no-beam {SHORT} --out run")
    experiment = cprl.load("run").experiment
    assert experiment.name == "two_complex_no_beam"
    assert experiment.game.rules.episode_steps == 5
    assert "Training curve" in capsys.readouterr().out
    kept = cprl.load("run").recipe
    assert kept["command"].startswith("cprl run two_complex --variant as_run --no-beam --engine eager")
    assert sys.argv == ["cprl", *f"run two_complex --variant as_run --no-beam {SHORT} --out run".split()]


def test_the_line_that_resumes_a_recipe_run_by_its_name_is_that_command(tmp_path):
    words = [f"{shipped.PROGRAM}study/time_out", "--seed", "3", "--out", "there"]
    typed = f"{shlex.join(cprl_here())} run study/time_out"
    assert resume_command(tmp_path, words) == f"{typed} --seed 3 --out {tmp_path} --resume"
    recipe = start_run(tmp_path / "run", "x", lambda directory: {"experiment": {}}, command=words)
    assert '"command": "cprl run study/time_out --seed 3"' in (recipe / "recipe.json").read_text()


@pytest.fixture
def python(tmp_path, monkeypatch):
    """A Python in a folder `bin` of an environment, without the script `cprl`, and off the path."""
    folder = tmp_path / "environment" / "bin"
    folder.mkdir(parents=True)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", os.defpath)
    return folder / "python"


def install(python):
    """The script `cprl` beside a Python."""
    script = python.with_name("cprl")
    script.write_text("#!/bin/sh")
    script.chmod(0o755)
    return script


def test_the_command_is_called_by_name_on_the_path_else_by_path_else_by_its_module(
    python, tmp_path, monkeypatch
):
    assert cprl_here() == [str(python), "-m", "cprl"]
    script = install(python)
    assert cprl_here() == [str(script)]
    monkeypatch.chdir(tmp_path)
    assert cprl_here() == ["environment/bin/cprl"]
    monkeypatch.chdir(python.parent)
    assert cprl_here() == [str(script)], "a shell does not look in the working directory"
    monkeypatch.setenv("PATH", str(python.parent))
    assert cprl_here() == ["cprl"]


@pytest.mark.parametrize(
    "program", ["cprl", ".venv/bin/cprl", "/elsewhere/bin/cprl", r"C:\venv\Scripts\cprl.exe", "cprl run mrun"]
)
def test_a_line_to_type_calls_the_command_however_it_was_called(program, python):
    words = [program, *([] if program.endswith("mrun") else ["run", "mrun"]), "--seed", "3"]
    assert command_of(words) == [str(python), "-m", "cprl", "run", "mrun", "--seed", "3"]
    script = install(python)
    assert command_of(words) == [str(script), "run", "mrun", "--seed", "3"]
    assert command_of(["cprl/mine.py", "--seed", "3"]) == [str(python), "cprl/mine.py", "--seed", "3"]


def test_the_line_that_resumes_a_run_from_its_directory_can_be_typed_where_no_script_is(python, tmp_path):
    typed = f"{python} -m cprl run {tmp_path}"
    assert resume_command(tmp_path) == f"{typed} --resume"
    words = ["cprl", "run", str(tmp_path), "--resume"]
    assert resume_command(tmp_path, words) == f"{typed} --out {tmp_path} --resume"


def test_a_study_is_run_by_its_name(elsewhere, monkeypatch, capsys):
    call(monkeypatch, "run study/time_out --dry-run --replicas 1")
    assert "0 of 5 trials finished" in capsys.readouterr().out


def test_a_recipe_is_swept_by_its_name(elsewhere, monkeypatch, capsys):
    call(monkeypatch, "sweep two_complex --vary game.rules.freeze-steps=2,5 --dry-run")
    assert "2 conditions (game.rules.freeze_steps)" in capsys.readouterr().out


def test_a_file_or_a_run_of_that_name_comes_first_but_not_the_folder_of_a_study(elsewhere):
    assert is_shipped("commons")
    (elsewhere / "studies" / "time_out").mkdir(parents=True)
    assert is_shipped("study/time_out"), "where the study itself writes"
    (elsewhere / "commons").mkdir()
    (elsewhere / "commons" / "recipe.json").write_text("{}")
    assert not is_shipped("commons")
    (elsewhere / "mixed").write_text("{}")
    assert not is_shipped("mixed")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "run comons --replicas 2",
            "'comons' is no file, .* .did you mean 'commons'.*allowed: .* mixed, ",
        ),
        ("run --episodes 2 commons", r"stands first, its flags behind it: cprl run commons \[FLAGS\]"),
        ("run study/base", "study/base runs nothing: other recipes import it; cprl recipe study/base"),
        ("run mine.py", r"mine\.py is a recipe of your own"),
        ("recipe comons", "there is no recipe 'comons'"),
        ("run commons --watch telepathy", "watch is 'telepathy'"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_sentence(line, message, elsewhere, monkeypatch):
    (elsewhere / "mine.py").write_text("")
    with pytest.raises(SystemExit, match=message):
        call(monkeypatch, line)
    assert {path.name for path in elsewhere.iterdir()} == {"mine.py"}


@pytest.mark.parametrize("line", ["--epsiodes 3", "--epsiodes=3", "--no-bean", "--callback a:B"])
def test_a_mistyped_flag_is_refused_before_the_recipe_is_imported(line, monkeypatch, capsys):
    monkeypatch.setattr(cli, "run_shipped", None)
    with pytest.raises(SystemExit) as refused:
        call(monkeypatch, f"run two_complex {line}")
    assert refused.value.code == 2
    assert f"there is no flag {line.partition('=')[0].split()[0]}" in capsys.readouterr().err


@pytest.mark.integration
@pytest.mark.parametrize("name", ["commons", "mixed", "two_complex", "study/theory/sharing"])
def test_no_flag_that_a_recipe_has_is_taken_for_a_mistake(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        call(monkeypatch, f"run {name} --help-all")
    flags = {word.strip(",") for word in capsys.readouterr().out.split() if re.match("--[a-z]", word)}
    assert {"--episodes", "--out", "--resume", "--no-resume"} < flags
    refuse_mistyped_flags(recipe_named(name), sorted(flags))


def test_what_shipped_recipes_are_asked_for_in_python_is_checked():
    with pytest.raises(ValueError, match="there is no recipe 'x'"):
        run_shipped("x", [])
    with pytest.raises(ValueError, match="folder is 'x'"):
        import_from("x")


def test_a_package_without_recipes_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "_PACKAGE", tmp_path / "src" / "cprl")
    with pytest.raises(FileNotFoundError, match="the recipes of cprl are neither in"):
        shipped.recipes_folder()
    (tmp_path / "src" / "cprl" / "recipes").mkdir(parents=True)
    assert shipped.recipes_folder() == tmp_path / "src" / "cprl" / "recipes", "as in a wheel"
