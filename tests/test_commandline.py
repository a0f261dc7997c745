"""A recipe's command line: its own arguments first, every number of its experiment by its place."""

import importlib.util
import json
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from my_game import Dilemma

import cprl
from cprl import Experiment, presets
from cprl.algorithms import DQN, PPO, QMIX, DQNSettings, RolloutSettings
from cprl.commands import main as cli
from cprl.commands.recipe import RunOptions, parse, recipe_main
from cprl.custom import Custom, allowing
from cprl.institutions import Boundaries, GraduatedSanctions, Quota
from cprl.learners.preferences import Exchange
from cprl.networks import MLP
from cprl.population import Learning, Scripted, Team
from cprl.runs.recipe import start_run

ROOT = Path(__file__).parents[1]
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
    return parse(make, ["recipes/mine.py", *shlex.split(line)])


def recipe(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "recipes" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_arguments_the_recipe_is_as_it_stands():
    assert read("") == (experiment(), RunOptions())


def test_every_number_is_changed_by_its_place():
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


def test_a_recipes_own_arguments_come_before_the_changes_to_what_they_make():
    given, _ = read("--spare 7 --agents.1.algorithm.settings.target-every-episodes 9")
    assert [spec.algorithm.settings.target_every_episodes for spec in given.agents[:2]] == [7, 9]


@pytest.mark.integration
@pytest.mark.parametrize(
    "line",
    [
        "--gama 0.9",
        "--agents.0.algorithm.settings.gama 0.9",
        "--agents.4.reward team",
        "--agents.0 Scripted",
        "--replicas two",
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


def test_an_argument_of_a_recipes_own_must_not_hide_one_of_the_experiment():
    def hides(*, seed: int = 0) -> Experiment:
        return replace(experiment(), seed=seed)

    with pytest.raises(ValueError, match="argument 'seed' of its own"):
        read("", hides)


def test_an_argument_runs_of_a_recipes_own_is_refused_since_no_line_that_resumes_keeps_it():
    def hides(*, runs: int = 1) -> Experiment:
        return replace(experiment(), replicas=runs)

    with pytest.raises(ValueError, match=r"argument 'runs' of its own, .*"):
        read("--runs 3", hides)


def help_of(make, capsys, flag="--help"):
    with pytest.raises(SystemExit) as ended:
        read(flag, make)
    assert ended.value.code == 0
    return " ".join(word for word in capsys.readouterr().out.split() if word != "│")


def test_help_lists_what_people_change_after_the_recipes_own_arguments(capsys):
    words = help_of(experiment, capsys)
    assert "Two agents that learn alike, one that does otherwise" in words
    flags = [word for word in words.split() if word.startswith("--")]
    first, second = flags.index("--spare"), flags.index("--episodes")
    assert first < flags.index("--out") < second < flags.index("--game.rules.freeze-steps")
    assert {"--agents", "--game.map", "--game.institutions", "--seed", "--replicas"} <= set(flags)
    assert len(flags) < 24
    assert "--help-all lists all flags" in words
    assert "a number of its own. (default: 3)" in words


def test_all_help_lists_every_number_and_equal_agents_once(capsys):
    words = help_of(experiment, capsys, "--help-all")
    assert "What is not listed cannot be changed on the command line" in words
    assert "--agents.1.reward" not in words
    assert "--agents.2.algorithm.clip-epsilon" in words
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
    assert given.game.map == cprl.maps.named("two_complex")


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


def test_a_game_of_somebodys_own_has_flags_too():
    own = replace(experiment(), game=Gathering(), agents=[Scripted()] * 2)
    given, _ = read("--game.yield-per-step 3 --seed 1", lambda: own)
    assert given == replace(own, game=Gathering(yield_per_step=3.0), seed=1)


@dataclass(frozen=True)
class Gathering(Dilemma):
    """A game of somebody's own.

    Args:
        yield_per_step: apples. Each step.
    """

    yield_per_step: float = 1.0


def test_a_team_has_flags():
    team = Team(QMIX(settings=DQNSettings()), agents=(0, 2))
    three = replace(
        experiment(),
        game=replace(experiment().game, map=cprl.maps.parse(">A>A>")),
        agents=(team, Scripted("greedy")),
    )
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


def test_a_team_of_all_agents_grows_too():
    team = alike((Team(QMIX(settings=DQNSettings()), agents=(0, 1, 2, 3)),))
    given, _ = read("--agents 3", lambda: team)
    assert given.agents == (replace(team.agents[0], agents=(0, 1, 2)),)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--agents 3", "--agents is 3; allowed: where all agents are alike"),
        ("--agents 0", "agents is 0"),
        ("--agents 1000", "agents is 1000; allowed: at most"),
        ("--game.institutions quoter", "--game.institutions is quoter; allowed: .*quota"),
        ("--game.institutions boundaries", "--game.institutions is boundaries"),
    ],
)
def test_a_shape_that_does_not_fit_is_refused(line, message):
    make = experiment if line == "--agents 3" else alike
    with pytest.raises(ValueError, match=message):
        read(line, make)


def test_institutions_are_given_by_their_names_with_flags_of_their_own():
    line = "--game.institutions quota graduated_sanctions --game.institutions.quota.share 0.25"
    given, _ = read(f"{line} --game.institutions.1.recovery-steps 7", alike)
    quota, sanctions = given.game.institutions
    assert quota == Quota(share=0.25)
    assert sanctions == replace(GraduatedSanctions(), recovery_steps=7)
    governed = alike(institutions=(Quota(),))
    assert read("--game.institutions none", lambda: governed)[0].game.institutions == ()
    assert read("--game.institutions.quota.share 1", lambda: governed)[0].game.institutions == (
        Quota(share=1.0),
    )


def test_institutions_are_read_from_a_file(tmp_path):
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
    given, _ = parse(recipe(Path(script).stem).experiment, [script, *given])
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
    assert recipe_main(experiment, line) == Path("a run")
    ((given, out, how),) = runs
    assert given == replace(experiment(), seed=3)
    assert out == Path("here")
    assert how == {
        "resume": True,
        "take_over": False,
        "keep_checkpoint": True,
        "watch": "file",
        "linger": False,
        "callbacks": [],
        "allow": ("a:B", "c:D"),
    }


def test_cprl_run_trains_the_experiment_of_a_recipe_or_resumes_its_run(runs, tmp_path, monkeypatch):
    run = start_run(tmp_path / "run", "mine", experiment().to_recipe, command=["recipes/mine.py"])
    monkeypatch.setattr(sys, "argv", ["cprl", "run", str(run)])
    with pytest.raises(SystemExit, match=r"^cprl: my_game:Callback would be imported.* --allow my_game:Call"):
        cli.main()
    for words in (
        f"{run}/recipe.json --out elsewhere --watch off --allow my_game:Callback",
        f"{run} --allow my_game:Callback",
        f"{run} --allow my_game:Callback --resume",
    ):
        monkeypatch.setattr(sys, "argv", ["cprl", "run", *words.split()])
        with allowing(()):
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
