"""The package: its public names, what an import takes, its layers, its oldest requirements."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import pytest
from dqn_parts import dqn_learner
from matrix_games import stag_hunt
from oldest import PYPROJECT, oldest
from packaging.requirements import Requirement
from places import ROOT
from tiny_study import FREEZE, SETTINGS, TINY
from torchrl.envs import StepCounter, TransformedEnv

import cprl
from cprl import presets
from cprl.commands import main as cli
from cprl.commons.rules import GROUP_ARRAYS
from cprl.envs import CommonsGymnasiumEnv, parallel_env
from cprl.envs.make_env import make_env
from cprl.system import waiting_room

PACKAGES = (
    *("algorithms", "commons", "envs", "evaluation", "experimental", "institutions", "keys"),
    *("learners", "measuring", "networks", "objectives", "policies", "population"),
    *("studies", "training", "viewer"),
)
"""What users import."""
TAKES_SECONDS = ("torch", "numba", "pyarrow", "scipy", "matplotlib", "rerun")
"""Packages whose import takes the longest."""
NEED_NOTHING = (
    *(["--version"], ["recipe"], ["evalute"], ["run", "comons"], ["evaluate", "none", "--episods", "3"]),
    *(["evaluate", "none"], ["--help"], ["run", "commons", "--epsiodes", "3"], ["film", "--help"]),
)
"""Command lines of which every answer is known before any run is read."""
ALL_THAT_NEED_NOTHING = (
    *([name, "--help"] for name in cli.COMMANDS),
    *([name, "none", "--episods", "3"] for name in cli.COMMANDS if name not in ("sweep", "search")),
    *([name, "runs/none"] for name in cli.COMMANDS if name != "export"),
    *(["export", "runs/none", "copy"], ["table", "runs/none", "--by", "seed"]),
    *(["recipe", "commons"], ["sweep", "comons", "--vary", "seed=1,2"]),
)
PATH = re.compile(rb"(?<![\w.])/(?:tmp|work|home|root)/[\w.]")
TESTS = "tests/"
"""Strings of tests may be such paths."""


def run_alone(code):
    """Runs code in a process of its own, which has imported nothing yet."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_dir_shows_all_and_only_the_public_names_and_others_are_attribute_errors():
    assert dir(cprl) == sorted(cprl.__all__)
    assert len(set(cprl.__all__)) == len(cprl.__all__)
    assert set(PACKAGES) <= set(dir(cprl))
    for name in cprl.__all__:
        assert getattr(cprl, name) is not None, name
    assert cprl.viewer.RerunLogger.__module__ == "cprl.viewer.logger"
    for module, name in ((cprl, "lode"), (cprl.viewer, "RerunLoger"), (cprl.experiment, "Experimen")):
        with pytest.raises(AttributeError, match=f"module '{module.__name__}' has no attribute '{name}'"):
            getattr(module, name)


@pytest.mark.integration
def test_packages_are_attributes_after_import_cprl_alone():
    lines = [f"assert cprl.{name}.__name__ == 'cprl.{name}'" for name in reversed(PACKAGES)]
    run_alone("\n".join(["import cprl", *lines]))


def is_short(value, *facts):
    text = repr(value)
    return len(text) <= 300 and " object at " not in text and all(fact in text for fact in facts)


def test_what_is_printed_says_in_a_line_what_one_asks_first():
    game, alone = presets.game("commons"), presets.game("single_basic")
    env = cprl.CommonsEnv(game, worlds=3)
    for printed in (env, TransformedEnv(env, StepCounter())):
        assert is_short(printed, "12 x 24", "4 agents", "worlds=3", "cpu"), printed
    assert is_short(make_env(stag_hunt(), worlds=3), "2 agents", "worlds=3")
    for adapter in (parallel_env(game), CommonsGymnasiumEnv(alone)):
        assert is_short(adapter, "Game("), adapter
    assert is_short(game.map, "12 x 24", "89 sites", "4 agents")
    assert is_short(TINY, "'tiny'", "2 episodes", "1 replicas")
    assert is_short(cprl.Study(TINY, {FREEZE: [5, 25]}, name="both"), "'both'", "2 conditions")
    for rules in (cprl.Rules(), cprl.Rules(freeze_steps=5, may_fire=False)):  # by what they change
        assert eval(repr(rules), {"Rules": cprl.Rules}) == rules
        assert len(repr(rules)) < 60
    learner = dqn_learner(game.spaces, agents=(0, 1), replicas=2, settings=SETTINGS, seed=0, engine="eager")
    assert is_short(learner, "agents=(0, 1)", "replicas=2")


@pytest.mark.parametrize(
    "lines", [NEED_NOTHING, pytest.param(ALL_THAT_NEED_NOTHING, marks=pytest.mark.integration)]
)
def test_help_and_mistakes_are_answered_before_what_takes_seconds_is_imported(lines):
    run_alone(
        "import sys\n"
        "from cprl.commands import main as cli\n"
        f"for words in {lines}:\n"
        "    sys.argv = ['cprl', *words]\n"
        "    try:\n"
        "        cli.main()\n"
        "    except SystemExit:\n"
        "        pass\n"
        f"    loaded = [name for name in {TAKES_SECONDS} if name in sys.modules]\n"
        "    assert not loaded, (words, loaded)\n"
    )


@pytest.mark.parametrize(
    "imports",
    [
        "import cprl, gymnasium",
        "import gymnasium, cprl",
        "import cprl; from importlib.util import find_spec; find_spec('gymnasium'); import gymnasium",
        "import cprl, importlib; importlib.reload(cprl); import gymnasium",
    ],
)
def test_importing_cprl_is_enough_for_gymnasium_to_know_its_boards(imports):
    run_alone(f"{imports}, sys\ngymnasium.spec('cprl/SingleBasic-v0')\nassert 'torch' not in sys.modules")


@pytest.mark.integration
def test_the_command_works_by_the_name_of_the_package_and_says_the_installed_version():
    for words, said in ((["--help"], "usage: cprl [-h]"), (["--version"], f"cprl {version('cprl')}\n")):
        command = [sys.executable, "-m", "cprl", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
        assert done.stdout.startswith(said)
    assert cprl.__version__ == version("cprl")
    assert files("cprl").joinpath("py.typed").is_file(), "type checkers find the types"


def committed():
    """The files of the checkout that git knows."""
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this is no git checkout")
    return [name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.integration
def test_no_committed_file_holds_a_path_of_a_machine():
    assert all(map(PATH.search, (b'"command": "/tmp/exp/run.py"', b"see /home/ada/cprl", b"--out /work/run")))
    assert not any(map(PATH.search, (b"~/.cache/cprl", b"#!/usr/bin/env python", b"work/runs")))
    # Recordings, weights and tables too, as far as they are not compressed.
    found = [
        f"{name}: {line.strip()[:100]!r}"
        for name in committed()
        if not name.startswith(TESTS)
        for line in (ROOT / name).read_bytes().splitlines()
        if PATH.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("page", ["README.md", "CHANGELOG.md", "CONTRIBUTING.md"])
def test_what_a_page_links_to_is_in_the_source_distribution_too(page):
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    sdist = settings["tool"]["hatch"]["build"]["targets"]["sdist"]
    always = ["/README.md", "/pyproject.toml"]
    links = {f"/{link}" for link in re.findall(r"\]\(([^)#:]+)[)#]", (ROOT / page).read_text())}

    def lies_in(link, places):
        return any(f"{link}/".startswith(f"{place}/") for place in places)

    assert links
    assert [own for own in links if not lies_in(own, sdist["include"] + always)] == []
    assert [own for own in links if lies_in(own, sdist["exclude"])] == []


# A package imports only from packages above it, in the order that the docstring of cprl lists.


SOURCE = Path(cprl.__file__).parent
LAYERS = [line.split()[0] for line in (cprl.__doc__ or "").splitlines() if line.startswith("    ")]


def modules_imported(text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module == "cprl":
            yield from (f"cprl.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def imports_from_below(package, text):
    names = [name.split(".") for name in modules_imported(text)]
    imported = {name[1] for name in names if name[0] == "cprl" and len(name) > 1}
    return sorted(other for other in imported if LAYERS.index(other) > LAYERS.index(package))


@pytest.mark.parametrize("package", LAYERS)
def test_a_package_imports_only_from_packages_above_it(package):
    files = [*(SOURCE / package).rglob("*.py"), *SOURCE.glob(f"{package}.py")]
    assert files
    assert {
        file.name: below for file in files if (below := imports_from_below(package, file.read_text()))
    } == {}


def test_every_package_is_in_the_list_and_an_import_from_below_is_noticed():
    for line in ("from cprl.training import train", "import cprl.viewer.x", "from cprl import population"):
        assert imports_from_below("commons", line)
    assert imports_from_below("evaluation", "from cprl.experimental.territory import territory_of")
    entries = {
        path.stem for path in SOURCE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert entries - {"__init__", "__main__"} == set(LAYERS)


def test_nothing_outside_imports_what_is_experimental_and_every_part_of_it_has_a_place():
    outside = [file for file in SOURCE.rglob("*.py") if "experimental" not in file.relative_to(SOURCE).parts]
    assert len(outside) > 100
    for file in outside:
        imported = [
            name for name in modules_imported(file.read_text()) if name.startswith("cprl.experimental")
        ]
        assert imported == ([] if file != SOURCE / "__init__.py" else ["cprl.experimental"]), file
    text = "\n".join(file.read_text() for file in outside)
    places = set(re.findall(r'experimental\("([^"]+)"\)', text))
    assert len(places) > 15
    for place in places:
        assert waiting_room.experimental(place), place
    with pytest.raises(AttributeError):
        waiting_room.experimental("schelling.no_such_function")


def test_a_package_says_which_modules_it_has():
    for path in SOURCE.rglob("__init__.py"):
        words = set(re.findall(r"\w+", ast.get_docstring(ast.parse(path.read_text())) or ""))
        modules = {module.stem for module in path.parent.glob("[a-z]*.py")}
        groups = {kind.__module__.rpartition(".")[2] for kind in GROUP_ARRAYS.values()}
        assert modules - words - groups == set(), path.parent.name


def test_tests_lie_in_the_room_of_their_package_and_import_no_other_test():
    for path in (ROOT / "tests").rglob("test_*.py"):
        assert path.parent.name in {*LAYERS, "golden", "house"}, path.name
        assert not [name for name in modules_imported(path.read_text()) if name.startswith("test_")], (
            path.name
        )


def test_the_game_knows_nothing_of_torch():
    for path in (SOURCE / "commons").rglob("*.py"):
        roots = {name.split(".")[0] for name in modules_imported(path.read_text())}
        assert not {"torch", "tensordict", "torchrl"} & roots, path.name


# `make test-oldest` installs the lowest version of everything that pyproject.toml asks for.


PROJECT = {
    "name": "cprl",
    "dependencies": ["torch>=2.13,<2.14", "Pillow>=11"],
    "optional-dependencies": {
        "film": ["imageio-ffmpeg>=0.6,<0.9; python_version < '3.14'"],
        "all": ["cprl[film]", "ray~=2.60"],
        "dev": ["cprl[all,film]", "pytest==8.1"],
    },
}


def test_each_requirement_is_pinned_to_its_lower_bound_with_those_of_extras_of_extras():
    lines = {line.partition("=")[0]: line for line in oldest(PROJECT, ["dev"])}
    assert lines == {
        "torch": "torch==2.13",
        "Pillow": "Pillow==11",
        "pytest": "pytest==8.1",
        "ray": "ray==2.60",
        "imageio-ffmpeg": 'imageio-ffmpeg==0.6; python_version < "3.14"',
    }
    assert list(oldest(PROJECT, [])) == ["torch==2.13", "Pillow==11"]
    with pytest.raises(ValueError, match="'torch<3' has no lower bound"):
        list(oldest({**PROJECT, "dependencies": ["torch<3"]}, []))


def test_everything_that_the_package_asks_for_has_a_lower_bound():
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    pinned = {Requirement(line).name for line in oldest(project, list(extras))}
    asked = {Requirement(line).name for own in (project["dependencies"], *extras.values()) for line in own}
    assert pinned == asked - {"cprl"}
