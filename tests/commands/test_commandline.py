"""The command line: every number of an experiment by its place, recipes by name, any terminal."""

import io
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from boards import module_at
from my_game import Dilemma
from places import ROOT
from rich.table import Table

import cprl
from cprl import Experiment, Quirks2019, RandomEnd, presets
from cprl.algorithms import DQN, PPO, QMIX, DQNSettings, RolloutSettings
from cprl.commands import main as cli
from cprl.commands.recipe_command import RunOptions, parse_command, recipe_main, refuse_mistyped_flags
from cprl.institutions import Boundaries, GraduatedSanctions, Quota
from cprl.networks import MLP
from cprl.objectives.rewards import Exchange
from cprl.population import Learning, Scripted, Team
from cprl.runs.recipe import resume_command, start_run, started_by
from cprl.system import shipped
from cprl.system.output import Output, console, quote_command
from cprl.system.shipped import (
    cprl_command,
    import_from,
    is_shipped,
    recipe_named,
    shipped_recipes,
    typed_command_line,
)
from cprl.values import Custom, custom_targets, trusted, trusting

RECIPES = sorted(
    path.stem for path in (ROOT / "recipes").glob("*.py") if "recipe_main" in path.read_text(encoding="utf-8")
)
RESULTS = ROOT / "docs" / "results"
# Trials of a study have the study's command, which gives no single experiment.
STORED = sorted(set(RESULTS.rglob("recipe.json")) - set((RESULTS / "studies").rglob("recipe.json")))


def experiment(*, variant: presets.Variant = "published", spare: int = 3) -> Experiment:
    """Two agents that learn alike, one that does otherwise, one that does not.

    Args:
        variant: the rules.
        spare: a number of its own.
    """
    dqn = Learning(DQN(settings=DQNSettings(target_every_episodes=spare)))
    return Experiment(
        name="mine",
        game=presets.game("commons", variant=variant),
        agents=[dqn, dqn, Learning(PPO(settings=RolloutSettings())), Scripted("greedy")],
        episodes=10,
        callbacks=[Custom("my_game:Callback")],
    )


def read(line, make=experiment):
    return parse_command(make, ["recipes/mine.py", *shlex.split(line)])


def recipe(name):
    return module_at(ROOT / "recipes" / f"{name}.py")


def test_every_number_is_changed_by_its_place():
    assert read("") == (experiment(), RunOptions())
    given, options = read(
        "--replicas 2 --game.rules.freeze-steps 50 --agents.1.algorithm.settings.gamma 0.9 --variant as_run "
        "--agents.3.policy pacifist --agents.2.algorithm.settings.max-grad-norm None "
        "--loggers tensorboard wandb --game.rules.regrow-prob 0 0.5 --game.rules.beam-length-cells 1 2 3 4 "
        "--game.rules.no-may-fire "
        "--agents.0.algorithm.double --agents.0.reward team --out here --watch serve"
    )
    first, second, third, _ = experiment().agents
    base = experiment(variant="as_run")
    rules = replace(
        base.game.rules,
        freeze_steps=50,
        regrow_prob=(0.0, 0.5),
        beam_length_cells=(1, 2, 3, 4),
        may_fire=False,
    )
    settings = replace(second.algorithm.settings, gamma=0.9)
    assert given == replace(
        base,
        replicas=2,
        game=replace(base.game, rules=rules),
        agents=(
            Learning(replace(first.algorithm, double=True), reward="team"),
            Learning(DQN(settings=settings)),
            Learning(PPO(settings=replace(third.algorithm.settings, max_grad_norm=None))),
            Scripted("pacifist"),
        ),
        loggers=("tensorboard", "wandb"),
    )
    assert options == RunOptions(out=Path("here"), watch="serve")
    given, _ = read("--spare 7 --agents.1.algorithm.settings.target-every-episodes 9")
    periods = [spec.algorithm.settings.target_every_episodes for spec in given.agents[:2]]
    assert periods == [7, 9], "the recipe's own come before the changes to what they make"


@pytest.mark.integration
@pytest.mark.parametrize(
    "line",
    [
        "--gama 0.9",
        "--agents.0.algorithm.settings.gama 0.9",
        "--agents.4.reward team",
        "--agents.0 Scripted",
        "--replicas two",
        "--seed 1.9",
        "--variant pirated",
        "--callbacks my_game:Callback",
        "--engine quick",
        "stray",
    ],
)
def test_an_argument_that_is_unknown_or_does_not_fit_is_refused(line, capsys):
    with pytest.raises(SystemExit) as refused:
        read(line)
    assert refused.value.code == 2
    assert line.split()[0].lstrip("-") in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--replicas 0", r"^mine\.py: experiment\.replicas is 0"),
        ("--game.map single_basic", r"^mine\.py: experiment\.agents: 4 agents are specified for a game of 1"),
        ("--game.rules.hits-to-tag 0", r"^mine\.py: Rules\.hits_to_tag is 0"),
        ("--agents.0.algorithm.settings.gamma nan", r"gamma is nan"),
        ("--update-every 3", r"update_every is 3"),
    ],
)
def test_what_the_experiment_refuses_is_said_in_a_line(line, message):
    with pytest.raises(SystemExit, match=message):
        recipe_main(experiment, ["recipes/mine.py", *line.split()])


def test_to_take_over_a_run_that_is_not_resumed_is_refused(tmp_path):
    said = "--take-over is for runs that are there; allowed: with --resume"
    with pytest.raises(SystemExit, match=said):
        recipe_main(experiment, ["recipes/mine.py", "--take-over", "--out", str(tmp_path / "new")])
    with pytest.raises(ValueError, match=said):
        cli.run(tmp_path, options=RunOptions(take_over=True))
    assert list(tmp_path.iterdir()) == []


def test_an_argument_of_a_recipes_own_hides_none_of_the_experiment_and_of_lines_that_resume():
    def hides_seed(*, seed: int = 0) -> Experiment: ...

    def hides_runs(*, runs: int = 1) -> Experiment: ...

    for hides, name in ((hides_seed, "seed"), (hides_runs, "runs")):
        with pytest.raises(ValueError, match=f"argument '{name}' of its own"):
            read("", hides)


def help_of(make, capsys, flag="--help"):
    with pytest.raises(SystemExit) as ended:
        read(flag, make)
    assert ended.value.code == 0
    return " ".join(word for word in capsys.readouterr().out.split() if word != "│")


def test_help_lists_what_people_change_and_all_help_every_number_and_equal_agents_once(capsys):
    words = help_of(experiment, capsys)
    assert "Two agents that learn alike, one that does otherwise" in words
    flags = [word for word in words.split() if word.startswith("--")]
    first, second = flags.index("--spare"), flags.index("--episodes")
    assert first < flags.index("--out") < second < flags.index("--game.rules.freeze-steps")
    assert {"--agents", "--game.map", "--game.institutions", "--seed", "--replicas"} <= set(flags)
    assert len(flags) < 27
    assert "--help-all lists all flags" in words
    assert "a number of its own. (default: 3)" in words
    words = help_of(experiment, capsys, "--help-all")
    assert "What is not listed cannot be changed on the command line" in words
    assert "--agents.2.algorithm.clip-epsilon" in words
    assert "--agents.1.reward" not in words
    assert "--callbacks" not in words
    assert "The number of turns after which an episode is truncated [W]. (default: 1000)" in words


@pytest.mark.integration
def test_a_value_of_several_kinds_has_the_fields_of_the_kind_that_it_is_and_no_subcommands(capsys):
    first = Learning(DQN(settings=DQNSettings(), network=MLP(hidden_cells=(8,))), reward=Exchange(0.5))
    mixed = replace(experiment(), agents=[first, *experiment().agents[1:]])
    given, _ = read(
        "--agents.0.reward.share 0.1 --agents.0.algorithm.network.hidden-cells 4 4", lambda: mixed
    )
    changed = Learning(DQN(settings=DQNSettings(), network=MLP(hidden_cells=(4, 4))), reward=Exchange(0.1))
    assert given.agents == (changed, *mixed.agents[1:])
    with pytest.raises(SystemExit):
        read("--help-all", lambda: mixed)
    said = capsys.readouterr().out
    assert "subcommands" not in said
    assert "--agents.1.reward {individual,team}" in said
    with pytest.raises(SystemExit) as refused:
        read("--agents.0.reward team", lambda: mixed)
    assert refused.value.code == 2


def test_a_board_is_given_by_its_name_and_a_drawing_stays():
    drawn = cprl.maps.parse("A>.\n.vA")
    alone = replace(experiment(), game=replace(experiment().game, map=drawn), agents=[Scripted()] * 2)
    assert read("", lambda: alone)[0] == alone
    given, _ = read("--game.map two_complex", lambda: alone)
    assert given.game.map == cprl.maps.published("two_complex")


@pytest.mark.integration
def test_what_a_command_line_cannot_say_stays_as_it_is():
    base = experiment()
    sanctions = GraduatedSanctions(freeze_steps=((1, 2),) * 4, on="tags")
    kept = replace(
        base,
        game=replace(base.game, institutions=(sanctions, Quota())),
        loggers=(Custom("my:Logger"),),
        agents=(Learning(Custom("my:algorithm")), *base.agents[1:]),
    )
    given, _ = read("--agents.0.reward team --seed 4", lambda: kept)
    assert given == replace(
        kept, seed=4, agents=(Learning(Custom("my:algorithm"), reward="team"), *base.agents[1:])
    )
    assert read("--game.institutions.1.share 0.5", lambda: kept)[0].game.institutions[1] == Quota(share=0.5)
    changed = read("--game.institutions.0.freeze-steps 3 9", lambda: kept)[0].game.institutions[0]
    assert changed == replace(sanctions, freeze_steps=(3, 9)), "a row of numbers can be said, a table cannot"
    for line in ("--game.institutions.2.share 1", "--loggers wandb"):
        with pytest.raises(SystemExit):
            read(line, lambda: kept)


@dataclass(frozen=True)
class Gathering(Dilemma):
    """A game of somebody's own.

    Args:
        yield_per_step: apples. Each step.
    """

    yield_per_step: float = 1.0


def test_a_game_of_somebodys_own_and_a_team_have_flags():
    own = replace(experiment(), game=Gathering(), agents=[Scripted()] * 2)
    given, _ = read("--game.yield-per-step 3 --seed 1", lambda: own)
    assert given == replace(own, game=Gathering(yield_per_step=3.0), seed=1)
    team, game = Team(QMIX(settings=DQNSettings()), agents=(0, 2)), experiment().game
    three = replace(own, game=replace(game, map=cprl.maps.parse(">A>A>")), agents=(team, Scripted("greedy")))
    given, _ = read("--agents.0.agents 1 2", lambda: three)
    assert given.agents == (replace(team, agents=(1, 2)), Scripted("greedy"))


GREEDY = (Scripted("greedy"),) * 4


def alike(specs=GREEDY, institutions=()):
    game = presets.game("commons")
    return Experiment(name="alike", game=replace(game, institutions=institutions), agents=specs, episodes=1)


@pytest.mark.parametrize("agents", [2, 4, 7])
def test_agents_who_are_alike_can_be_any_number(agents):
    given, _ = read(f"--agents {agents} --agents.1.policy random", alike)
    assert given.agents == (Scripted("greedy"), Scripted("random"), *[Scripted("greedy")] * (agents - 2))
    assert given.game.agents == agents
    starts = presets.game("commons").map.starts
    assert given.game.map.starts[:4] == starts[:agents]
    assert not {(row, col) for row, col, _ in given.game.map.starts[4:]} & set(given.game.map.sites)


def test_a_shape_that_does_not_fit_is_refused_and_a_team_of_all_agents_grows():
    team = alike((Team(QMIX(settings=DQNSettings()), agents=(0, 1, 2, 3)),))
    given, _ = read("--agents 3", lambda: team)
    assert given.agents == (replace(team.agents[0], agents=(0, 1, 2)),)
    for make, line, message in (
        (experiment, "--agents 3", "--agents is 3; allowed: where all agents are alike"),
        (alike, "--agents 0", "agents is 0"),
        (alike, "--agents 1000", "agents is 1000; allowed: at most"),
        (alike, "--game.institutions quoter", "--game.institutions is quoter; allowed: .*quota"),
        (alike, "--game.institutions boundaries", "--game.institutions is boundaries"),
    ):
        with pytest.raises(ValueError, match=message):
            read(line, make)


def test_a_flag_of_a_group_of_rules_makes_the_group_or_changes_it():
    given, _ = read("--game.rules.random-end.prob 0.15 --game.rules.random_end.from-step=9")
    assert given.game.rules.random_end == RandomEnd(prob=0.15, from_step=9)
    given, _ = read("--game.rules.quirks.no-paint-over")
    assert given.game.rules == replace(presets.game("commons").rules, quirks=Quirks2019(paint_over=False))
    given, _ = read("--variant as_run --game.rules.quirks.no-paint-over")
    assert given.game.rules.quirks == Quirks2019(paint_over=False)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--game.rules.random-end.from-step 9", r"--game\.rules\.random-end lacks prob"),
        (
            "--game.rules.random-end.prb 0.2",
            r"--game\.rules\.random-end\.prb is unknown; allowed: prob, from-s",
        ),
        ("--game.rules.random-end.prob 2", r"RandomEnd\.prob is 2"),
        ("--game.rules.river.may-clean", r"Map\.river has 0 cells and Rules\.river is River"),
    ],
)
def test_a_group_of_rules_that_cannot_be_made_is_refused(line, message):
    with pytest.raises(ValueError, match=message):
        read(line)


def test_institutions_are_given_by_their_names_or_a_file_with_flags_of_their_own(tmp_path):
    line = "--game.institutions quota graduated_sanctions --game.institutions.quota.share 0.25"
    given, _ = read(f"{line} --game.institutions.1.recovery-steps 7", alike)
    quota, sanctions = given.game.institutions
    assert quota == Quota(share=0.25)
    assert sanctions == replace(GraduatedSanctions(), recovery_steps=7)
    governed = alike(institutions=(Quota(),))
    assert read("--game.institutions none", lambda: governed)[0].game.institutions == ()
    changed, _ = read("--game.institutions.quota.share 1", lambda: governed)
    assert changed.game.institutions == (Quota(share=1.0),)
    institutions = (Boundaries.strips(height=12, width=24, agents=4), Quota(share=0.5))
    table = alike(institutions=institutions).to_config()["game"]["institutions"]
    (tmp_path / "rules.json").write_text(json.dumps(table))
    given, _ = read(f"--game.institutions {tmp_path}/rules.json --game.institutions.1.fine 2", alike)
    assert given.game.institutions == (institutions[0], replace(institutions[1], fine=2.0))


@pytest.mark.integration
@pytest.mark.parametrize("path", STORED, ids=lambda path: path.parent.name)
def test_the_command_of_every_stored_result_still_gives_its_experiment(path):
    stored = json.loads(path.read_text())
    script, *given = shlex.split(stored["command"])
    if Path(script).stem == "no_beam":  # a script of before two_complex.py had --no-beam
        script, given = "recipes/two_complex.py", ["--no-beam", "--variant", "as_run", "--episodes", *given]
    given, _ = parse_command(recipe(Path(script).stem).experiment, [script, *given])
    cprl.trust(*custom_targets(stored["experiment"]))
    assert given == Experiment.from_recipe(stored)


@pytest.fixture
def runs(monkeypatch):
    """What `cprl.training.running.run` was asked for, which trains nothing."""
    asked = []

    def run(experiment, out=None, **how):
        asked.append((experiment, out, how))
        return Path("a run")

    monkeypatch.setitem(sys.modules, "cprl.training.running", SimpleNamespace(run=run))
    return asked


def test_a_recipe_runs_its_experiment(runs):
    line = ["recipes/mine.py", "--seed", "3", "--out", "here", "--resume", "--allow", "a:B", "--allow", "c:D"]
    with trusting(()):
        assert recipe_main(experiment, line) == Path("a run")
        assert {"a:B", "c:D"} <= set(trusted())
    ((given, out, how),) = runs
    assert given == replace(experiment(), seed=3)
    assert out == Path("here")
    assert how == {
        "resume": True,
        "take_over": False,
        "threads": 1,
        "keep_checkpoint": False,
        "watch": "file",
        "linger": False,
        "callbacks": [],
    }


def test_cprl_run_trains_the_experiment_of_a_recipe_or_resumes_its_run(runs, tmp_path, monkeypatch):
    with started_by(["recipes/mine.py"]):
        run = start_run(tmp_path / "run", "mine", experiment().to_recipe)
    monkeypatch.setattr(sys, "argv", ["cprl", "run", str(run)])
    with pytest.raises(SystemExit, match=r"^cprl: my_game:Callback would be imported.* --allow my_game:Call"):
        cli.main()
    for words in (
        f"{run}/recipe.json --out elsewhere --watch off --allow my_game:Callback",
        f"{run} --allow my_game:Callback",
        f"{run} --allow my_game:Callback --resume",
    ):
        monkeypatch.setattr(sys, "argv", ["cprl", "run", *words.split()])
        with trusting(()):
            cli.main()
    assert all(given == experiment() for given, _, _ in runs)
    assert [(out, how["resume"], how["watch"]) for _, out, how in runs] == [
        (Path("elsewhere"), False, "off"),
        (None, False, "file"),
        (run, True, "file"),
    ]


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_has_help(name, capsys):
    with pytest.raises(SystemExit) as ended:
        recipe_main(recipe(name).experiment, [f"recipes/{name}.py", "--help"])
    assert ended.value.code == 0
    assert f"usage: {name}.py [-h] [OPTIONS]" in capsys.readouterr().out


# Recipes that come with cprl


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
        if str(getattr(sys.modules[name], "__file__", "")).startswith((str(ROOT / "recipes"), str(tmp_path))):
            sys.modules.pop(name)


def call(monkeypatch, line):
    monkeypatch.setattr(sys, "argv", ["cprl", *line.split()])
    cli.main()


def test_every_file_of_recipes_is_shipped_under_its_name():
    files = {path.relative_to(ROOT / "recipes") for path in (ROOT / "recipes").rglob("*.py")}
    assert {Path(f"{name}.py") for name in shipped_recipes()} == files
    shared = {name for name, recipe in shipped_recipes().items() if not recipe.is_runnable}
    assert shared >= {"study/base", "study/learners/ways", "study/perolat/perolat_base", "study/verdicts"}
    assert all(recipe.summary.endswith((".", "?")) for recipe in shipped_recipes().values())


def test_the_recipes_are_listed_with_a_line_each_and_printed_as_they_are(monkeypatch, capsys):
    call(monkeypatch, "recipe")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == sum(recipe.is_runnable for recipe in shipped_recipes().values())
    (line,) = [line for line in lines if line.startswith("study/exploration ")]
    assert line.endswith(
        "Is the tragedy an artefact of the end of exploration? The steps over which epsilon decays."
    )
    call(monkeypatch, "recipe commons")
    assert capsys.readouterr().out == (ROOT / "recipes" / "commons.py").read_text()


@pytest.mark.integration
@pytest.mark.parametrize(
    "name", [name for name, shared in shipped_recipes().items() if "import_from" in shared.portable_source()]
)
def test_a_printed_recipe_that_imports_others_finds_them_anywhere(name, elsewhere, monkeypatch):
    monkeypatch.setattr(sys, "path", ["before", str(elsewhere), *sys.path])
    script = ModuleType("__main__")
    script.__file__ = str(elsewhere / "mine.py")
    monkeypatch.setitem(sys.modules, "__main__", script)
    code = compile(recipe_named(name).portable_source(), "mine.py", "exec")
    exec(code, {"__name__": "mine"})
    folder = str(ROOT / "recipes" / recipe_named(name).folder)
    assert sys.path.index(folder) == 2, "behind the folder of the script, whose own modules come first"


@pytest.mark.integration
def test_a_module_of_ones_own_comes_before_that_of_the_recipes(elsewhere):
    (elsewhere / "mine.py").write_text(recipe_named("study/exploration").portable_source())
    (elsewhere / "base.py").write_text("raise SystemExit('my own base')")
    done = subprocess.run([sys.executable, "mine.py", "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stderr.strip()) == (1, "my own base")


@pytest.mark.integration
def test_a_recipe_is_run_by_its_name_with_its_own_flags(elsewhere, monkeypatch, capsys, curves):
    call(monkeypatch, f"run two_complex --variant as_run --no-beam {SHORT} --out run")
    experiment = cprl.load("run").experiment
    assert experiment.name == "two_complex_no_beam"
    assert experiment.game.rules.episode_steps == 5
    assert "Training curve" in capsys.readouterr().out
    kept = cprl.load("run").recipe
    assert kept["command"].startswith("cprl run two_complex --variant as_run --no-beam --engine eager")
    assert sys.argv == ["cprl", *f"run two_complex --variant as_run --no-beam {SHORT} --out run".split()]


def test_the_line_that_resumes_a_recipe_run_by_its_name_is_that_command(tmp_path):
    words = [f"{shipped.PROGRAM}study/exploration", "--seed", "3", "--out", "there"]
    typed = f"{shlex.join(cprl_command())} run study/exploration"
    with started_by(words):
        assert resume_command(tmp_path) == f"{typed} --seed 3 --out {tmp_path} --resume"
        recipe = start_run(tmp_path / "run", "x", lambda directory: {"experiment": {}})
    assert '"command": "cprl run study/exploration --seed 3"' in (recipe / "recipe.json").read_text()


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
    assert cprl_command() == [str(python), "-m", "cprl"]
    script = install(python)
    assert cprl_command() == [str(script)]
    monkeypatch.chdir(tmp_path)
    assert cprl_command() == ["environment/bin/cprl"]
    monkeypatch.chdir(python.parent)
    assert cprl_command() == [str(script)], "a shell does not look in the working directory"
    monkeypatch.setenv("PATH", str(python.parent))
    assert cprl_command() == ["cprl"]


@pytest.mark.parametrize(
    "program", ["cprl", ".venv/bin/cprl", "/elsewhere/bin/cprl", r"C:\venv\Scripts\cprl.exe", "cprl run mrun"]
)
def test_a_line_to_type_calls_the_command_however_it_was_called(program, python):
    words = [program, *([] if program.endswith("mrun") else ["run", "mrun"]), "--seed", "3"]
    assert typed_command_line(words) == [str(python), "-m", "cprl", "run", "mrun", "--seed", "3"]
    script = install(python)
    assert typed_command_line(words) == [str(script), "run", "mrun", "--seed", "3"]
    assert typed_command_line(["cprl/mine.py", "--seed", "3"]) == [str(python), "cprl/mine.py", "--seed", "3"]
    script.unlink()
    typed = f"{python} -m cprl run runs/a"
    assert resume_command(Path("runs/a")) == f"{typed} --resume"
    with started_by(["cprl", "run", "runs/a"]):
        assert resume_command(Path("runs/a")) == f"{typed} --out runs/a --resume"


def test_a_study_is_run_and_a_recipe_swept_by_its_name(elsewhere, monkeypatch, capsys):
    call(monkeypatch, "run study/exploration --dry-run --replicas 1")
    assert "0 of 4 trials finished" in capsys.readouterr().out
    call(monkeypatch, "sweep two_complex --vary game.rules.freeze-steps=2,5 --dry-run")
    assert "2 conditions (game.rules.freeze_steps)" in capsys.readouterr().out


def test_a_file_or_a_run_of_that_name_comes_first_but_not_the_folder_of_a_study(elsewhere):
    assert is_shipped("commons")
    (elsewhere / "studies" / "exploration").mkdir(parents=True)
    assert is_shipped("study/exploration"), "where the study itself writes"
    (elsewhere / "commons").mkdir()
    (elsewhere / "commons" / "recipe.json").write_text("{}")
    assert not is_shipped("commons")
    (elsewhere / "mixed").write_text("{}")
    assert not is_shipped("mixed")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("run comons --replicas 2", "'comons' is no file, .* .did you mean 'commons'.*cprl recipe lists"),
        ("run --episodes 2 commons", r"stands first, its flags behind it: cprl run commons \[FLAGS\]"),
        ("run study/base", "study/base runs nothing: other recipes import it; cprl recipe study/base"),
        ("run mine.py", r"mine\.py is a recipe of your own"),
        ("recipe comons", "there is no recipe 'comons'"),
        ("recipe zebra", "there is no recipe 'zebra'; cprl recipe lists them$"),
        ("recipe matrix_games", r"no recipe 'matrix_games' .did you mean 'study/theory/matrix_games'\?.$"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_sentence(line, message, elsewhere, monkeypatch):
    (elsewhere / "mine.py").write_text("")
    with pytest.raises(SystemExit, match=message):
        call(monkeypatch, line)
    assert {path.name for path in elsewhere.iterdir()} == {"mine.py"}


@pytest.mark.parametrize("line", ["--epsiodes 3", "--epsiodes=3", "--no-bean", "--callback a:B", "--gmae 3"])
def test_a_mistyped_flag_is_refused_before_the_recipe_is_imported(line, monkeypatch, capsys):
    monkeypatch.setattr(cli, "run_shipped", None)
    with pytest.raises(SystemExit) as refused:
        call(monkeypatch, f"run two_complex {line}")
    assert refused.value.code == 2
    said = capsys.readouterr().err
    assert f"there is no flag {line.partition('=')[0].split()[0]}" in said
    assert "'--game'" not in said, "which is no flag"


@pytest.mark.integration
@pytest.mark.parametrize("name", ["commons", "mixed", "two_complex", "study/theory/sharing"])
def test_no_flag_that_a_recipe_has_is_taken_for_a_mistake(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        call(monkeypatch, f"run {name} --help-all")
    flags = {word.strip(",") for word in capsys.readouterr().out.split() if re.match("--[a-z]", word)}
    assert {"--episodes", "--out", "--resume", "--no-resume"} < flags
    refuse_mistyped_flags(recipe_named(name), sorted(flags))


def test_a_package_without_recipes_says_so(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="folder is 'x'"):
        import_from("x")
    monkeypatch.setattr(shipped, "_PACKAGE", tmp_path / "src" / "cprl")
    with pytest.raises(FileNotFoundError, match="the recipes of cprl are neither in"):
        shipped.recipes_folder()
    (tmp_path / "src" / "cprl" / "recipes").mkdir(parents=True)
    assert shipped.recipes_folder() == tmp_path / "src" / "cprl" / "recipes", "as in a wheel"


# Terminals and shells: another encoding and a tiny terminal end no training


TRAINS = """
import sys
from pathlib import Path
from dataclasses import replace
from tiny_study import TINY
import cprl
print(cprl.run(replace(TINY, episodes=3), Path(sys.argv[1]), watch=sys.argv[2]))
"""


def test_what_an_output_cannot_show_is_written_plainly_and_one_that_is_none_takes_everything():
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", newline="")
    console(Output(lambda: stream)).print("12.0 ± 0.5 \u00d7 3 …  日")
    stream.flush()
    assert stream.buffer.getvalue().decode("ascii") == "12.0 +- 0.5 x 3 ...  ?\n"
    nothing = console(Output(lambda: None))
    nothing.print("text")
    assert not nothing.is_terminal


def test_square_brackets_and_colons_in_names_and_paths_are_shown_as_they_are():
    stream = io.StringIO()
    table = Table(title="a [b]", caption="c [d]")
    table.add_column("column [e]")
    table.add_row("row [/f] :apple:")
    shown = console(Output(lambda: stream), width=120)
    shown.print(table)
    shown.print("To resume: --out runs/[g]", soft_wrap=True)
    for name in ("a [b]", "c [d]", "column [e]", "row [/f] :apple:", "--out runs/[g]"):
        assert name in stream.getvalue()


def training(folder, *, watch="off", env=None):
    """A small training in a process of its own; its exit code, standard output and standard error."""
    script = folder / "train.py"
    script.write_text(TRAINS, encoding="utf-8")
    given = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))}
    command = f'"{sys.executable}" "{script}" "{folder / "run"}" {watch}'
    ended = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, env={**given, **(env or {})}, check=False
    )
    assert (folder / "run" / "report.json").exists(), ended.stderr
    for error in ("Traceback", "BrokenPipeError", "UnicodeEncodeError", "Exception ignored", "Logging error"):
        assert error not in ended.stderr + ended.stdout
    return ended.returncode, ended.stdout, ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "env",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"COLUMNS": "1", "LINES": "1"},
        {"TERM": "dumb"},
        {"FORCE_COLOR": "1", "COLUMNS": "7", "PYTHONIOENCODING": "ascii"},
    ],
)
def test_a_training_runs_in_any_terminal(env, tmp_path):
    code, out, _ = training(tmp_path, watch="serve", env=env)
    assert code == 0
    assert "run" in out


@pytest.mark.parametrize(
    ("platform", "line"),
    [
        ("linux", r"""'C:\my runs\cprl' film 'it'"'"'s' a.gif"""),
        ("win32", r""""C:\my runs\cprl" film it's a.gif"""),
    ],
)
def test_a_command_to_be_copied_is_quoted_for_the_shell_of_the_platform(platform, line, monkeypatch):
    monkeypatch.setattr(sys, "platform", platform)
    assert quote_command([r"C:\my runs\cprl", "film", "it's", "a.gif"]) == line


def help_at_80_columns(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, f"{command} --help".strip())
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.integration
@pytest.mark.parametrize("command", ["", *(name for name in cli.COMMANDS if name not in ("sweep", "search"))])
def test_help_fits_80_columns_and_shows_no_default_that_says_nothing(command, monkeypatch, capsys):
    said = help_at_80_columns(command, monkeypatch, capsys)
    assert max(map(len, said.splitlines())) <= 80
    assert "\n\n\n" not in said
    for noise in ("{None}", "(default: None)", "(default: )"):
        assert noise not in said


def test_help_lists_every_command_once_in_its_group(monkeypatch, capsys):
    lines = help_at_80_columns("", monkeypatch, capsys).splitlines()
    listed = [re.match(r"  (\w+)  ", line) for line in lines]
    waiting = re.search(r"Experimental, and may change: (.*?)\.", " ".join(lines))[1].split(", ")
    assert [*(name[1] for name in listed if name), *waiting] == list(cli.COMMANDS)
    groups = [line.removesuffix(":") for line in lines if re.fullmatch(r"\w+:", line)]
    assert groups == ["Train", "Look", "Measure", "Compare"]


@pytest.mark.parametrize("line", ["run tragdy", "evaluate tragdy"])
def test_what_is_no_run_and_no_recipe_is_said_in_a_short_sentence(line, monkeypatch):
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, line)
    assert len(ended.value.code) < 200, ended.value.code
