"""The wheel works outside the checkout, where pip installs it into a bare environment.

`make test-wheel`; it needs the network, some minutes and about 2.5 GB of disk
for a while.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlopen

import pytest
from places import ROOT

pytestmark = pytest.mark.network

SHORT = (
    "--engine eager --episodes 2 --evaluation-episodes 1 --game.rules.episode-steps 20 "
    "--agents.0.algorithm.settings.buffer-size 200 --agents.1.algorithm.settings.buffer-size 200"
)
TRAINED = f"run two_complex {SHORT} --replicas 2 --watch file --keep-checkpoint"
OF_A_USER = """
from dataclasses import dataclass, replace

import cprl
from cprl import CommonsEnv, Game, Rules, maps, presets
from cprl.algorithms import DQN
from cprl.envs import make_env
from cprl.envs.make_env import PlayableGame
from cprl.population import Learning


def experiment(*, freeze_steps: int = 5) -> cprl.Experiment:
    game: Game = presets.game("two_complex")
    rules: Rules = replace(game.rules, freeze_steps=freeze_steps)
    agent = Learning(DQN(settings=presets.dqn_settings("two_complex")))
    return cprl.Experiment(name="mine", game=replace(game, rules=rules), agents=(agent,) * 2, episodes=2)


@dataclass(frozen=True)
class Chicken:
    agents: int = 2

    def to_config(self) -> dict[str, int]:
        return {"agents": self.agents}

    def make(self, worlds: int, seed: int, device: object) -> CommonsEnv:
        raise NotImplementedError


env = CommonsEnv(Game(map=maps.parse("A.>"), rules=Rules(freeze_steps=3)), worlds=2)
worlds = make_env(experiment().game, worlds=2)
study = cprl.Study(experiment(), {"game.rules.freeze_steps": [5, 25]}, replicas=2)
chicken: PlayableGame = Chicken()
names: list[str] = [field for field in experiment().to_config()]
"""
"""What a user might write; it holds no type but those of cprl."""


class Bare:
    """An environment with the wheel, and a folder outside the checkout in which commands are run."""

    def __init__(self, folder, commit):
        self.commit = commit
        self.folder, self.bin = folder / "work", folder / "env" / ("Scripts" if os.name == "nt" else "bin")
        self.folder.mkdir()
        left_out = ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
        self.env = {name: value for name, value in os.environ.items() if name not in left_out}
        self.env |= {"CPRL_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"}

    def python(self, *words, **how):
        return self.call([self.bin / "python", *words], **how)

    def cprl(self, line, **how):
        return self.call([self.bin / "cprl", *line.split()], **how)

    def call(self, words, *, code=0, **how):
        """What a program printed; it ended with the code that is expected."""
        how = {"cwd": self.folder, "env": self.env, "capture_output": True, "text": True, **how}
        done = subprocess.run([str(word) for word in words], timeout=1800, **how)
        assert done.returncode == code, f"{words}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
        return done.stdout + (done.stderr if code else "")


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bare")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    began, head = time.monotonic(), ["git", "-C", ROOT, "rev-parse", "HEAD"]
    commit = subprocess.run(head, capture_output=True, text=True).stdout.strip()  # "" without git
    subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, ROOT], check=True)
    (wheel,) = folder.glob("cprl-*.whl")
    built = time.monotonic()
    subprocess.run([sys.executable, "-m", "venv", folder / "env"], check=True)
    own = Bare(folder, commit)
    own.python("-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel, "mypy")
    installed = time.monotonic()
    size = sum(path.stat().st_size for path in (folder / "env").rglob("*") if path.is_file())
    print(
        f"wheel: {wheel.stat().st_size / 1e6:.1f} MB, built in {built - began:.0f} s; installed in "
        f"{installed - built:.0f} s, {size / 1e6:,.0f} MB with all that it needs and mypy"
    )
    return own


@pytest.fixture(scope="module")
def run(bare):
    """A run, trained by the name of a recipe in a folder that is somebody else's git folder."""
    me = ["-c", "user.name=me", "-c", "user.email=me@example.org"]
    for words in (["init", "-q"], [*me, "commit", "-q", "--allow-empty", "-m", "mine"]):
        bare.call(["git", *words])
    began = time.monotonic()
    assert "Training curve:" in bare.cprl(f"{TRAINED} --out one")
    print(f"first run, with compiling: {time.monotonic() - began:.0f} s")
    bare.cprl(f"{TRAINED} --out two --seed 1")
    return "one"


COMMANDS = {
    "run": ("run {run} --resume --episodes 3", "Training curve:"),
    "recipe": ("recipe", "study/exploration"),
    "film": ("film {run} --out film.gif", "film.gif"),
    "export": ("export {run} exported", "exported"),
    "evaluate": ("evaluate {run} --episodes 1", "collective_return"),
    "visits": ("visits {run} --episodes 1 --figure visits.png", "visits.png"),
    "crossplay": ("crossplay one two --episodes 1", "one"),
    "schelling": ("schelling two_complex --episodes 1 --replicas 1", "fear"),
    "scenarios": ("scenarios {run} --episodes 1", "scenario"),
    "exploit": ("exploit {run} --algorithms own --seeds 1 --training-episodes 1 --episodes 1", "Episodes:"),
    "sweep": (f"sweep two_complex --vary game.rules.freeze-steps=2,5 {SHORT} --replicas 1", "two_complex"),
    "table": ("table one two --by engine", "engine"),
}
"""A miniature of each command, and a word of what it prints; the others have tests of their own."""


def test_every_command_has_a_miniature(bare):
    said = bare.cprl("--help")
    listed = re.findall(r"^  ([a-z]+) ", said, re.MULTILINE)
    waiting = re.search(r"Experimental, and may change: ([a-z,\s]+)\.", said)[1]
    others = {"watch", "play", "show", "report", "egta", "sandbox", "search"}
    assert {*listed, *re.findall(r"[a-z]+", waiting)} == {*COMMANDS, *others}


@pytest.mark.parametrize("name", list(COMMANDS))
def test_a_command_works_outside_the_checkout(name, bare, run):
    line, word = COMMANDS[name]
    assert word in bare.cprl(line.format(run=run))


def test_a_game_is_played_in_the_terminal(bare, run):
    assert "turn" in bare.cprl(f"play {run} --steps 3", input="w\nwww\nquit\n")


def test_a_recording_is_served_until_ctrl_c(bare, run):
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    command = [str(bare.bin / "cprl"), "watch", run, "--serve"]
    process = subprocess.Popen(command, cwd=bare.folder, env=bare.env, stdout=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, usual)
    try:
        line = process.stdout.readline()
        assert line.startswith("Watch (browser): ")
        with urlopen(re.search(r"http://127\.0\.0\.1:\d+/", line)[0], timeout=60) as answer:
            assert "rerun" in answer.read().decode().lower()
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 0
    finally:
        process.kill()
        process.communicate()


def test_the_wheel_holds_how_to_cite_it_and_what_has_changed(bare):
    code = "from importlib.metadata import files; print(*(file.name for file in files('cprl')))"
    assert {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"} <= set(bare.python("-c", code).split())


def test_an_extra_that_is_lacking_is_named_and_a_run_says_which_cprl_and_which_commit_it_is_of(bare, run):
    assert 'pip install "cprl[theory]"' in bare.cprl("egta one two --episodes 1", code=1)
    recipe = json.loads((bare.folder / run / "recipe.json").read_text())
    assert recipe["versions"]["cprl"] == bare.cprl("--version").split()[1]
    assert (recipe["git"] or {}).get("commit", "") == bare.commit, "that of the wheel, not of this folder"
    assert recipe["command"].startswith("cprl run two_complex --engine eager")
    resumed = bare.cprl(f"{TRAINED} --out one --resume --episodes 3")
    assert "is finished" in resumed or "Training curve:" in resumed


@pytest.mark.parametrize("name", ["commons", "swap_the_loss", "study/theory/sharing"])
def test_a_printed_recipe_of_an_experiment_runs_anywhere(name, bare, tmp_path):
    (tmp_path / "mine.py").write_text(bare.cprl(f"recipe {name}"))
    line = "--engine eager --episodes 1 --replicas 1 --evaluation-episodes 1 --watch off --out run"
    if name != "study/theory/sharing":
        line += " --game.rules.episode-steps 20"
    bare.python("mine.py", *line.split(), cwd=tmp_path)
    assert (tmp_path / "run" / "report.json").exists()


@pytest.mark.parametrize(
    "name", ["study/exploration", "study/learners/tuning_commons", "study/perolat/perolat_walls"]
)
def test_a_printed_recipe_of_a_study_finds_what_it_imports(name, bare, tmp_path):
    (tmp_path / "mine.py").write_text(bare.cprl(f"recipe {name}"))
    assert "0 of" in bare.python("mine.py", "--dry-run", cwd=tmp_path)
    assert "0 of" in bare.cprl(f"run {name} --dry-run", cwd=tmp_path)


PLAYED = """
from matrix_games import chicken

from cprl.envs import make_env

print(make_env(chicken(turns=5), worlds=2).rollout(9)["next", "agents", "reward"].shape)
"""


@pytest.mark.parametrize(("name", "code"), [("study/theory/matrix_games", PLAYED)])
def test_a_printed_game_of_ones_own_is_played_anywhere(name, code, bare, tmp_path):
    (tmp_path / f"{Path(name).name}.py").write_text(bare.cprl(f"recipe {name}"))
    (tmp_path / "mine.py").write_text(code)
    assert "[2, 5, 2, 1]" in bare.python("mine.py", cwd=tmp_path)


def test_the_types_of_the_wheel_serve_a_users_file(bare):
    (bare.folder / "mine.py").write_text(OF_A_USER)
    assert "Success" in bare.python("-m", "mypy", "--strict", "mine.py")
    (bare.folder / "wrong.py").write_text(OF_A_USER + "\nRules(freeze_steps='three')\n")
    assert "arg-type" in bare.python("-m", "mypy", "--strict", "wrong.py", code=1)
