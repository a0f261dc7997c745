"""The examples run as they stand; those of other people's trainers in miniature."""

import importlib.util
import re
import runpy
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from unittest.mock import MagicMock

import pytest
import torch
from places import ROOT

from cprl import Game, Rules, maps, presets
from cprl.envs import parallel_env

EXAMPLES = ROOT / "examples"
OTHERS = EXAMPLES / "other_trainers"
OWN = EXAMPLES / "own_algorithm"
NUMBER = r"[+-]?(\d+\.\d+|nan)"
INTERVAL = rf"{NUMBER} \[{NUMBER}, {NUMBER}\]"
PRINTS = {
    "run": rf"runs/run-\S+: {NUMBER} apples at first, {NUMBER} in the end",
    "resume": r"stopped; on the command line: cprl run runs/\S+ --resume\n(.*\n)*the same episodes: True",
    "extend": "the same episodes: True",
    "own_metric": rf"largest_share, trained: {INTERVAL}\nlargest_share, random: {INTERVAL}",
    "own_network": "agent_0: ConvNetwork, [0-9,]+ weights\n.*agent_1: Tanh, [0-9,]+ weights",
    "own_loss": rf"__main__:huber: {NUMBER}, {NUMBER} apples\n__main__:Hysteretic: {NUMBER}, {NUMBER} apples",
    "own_institution": rf"fee 0.5: \d+ shots, which cost {NUMBER} apples",
    "licence": r"fines by episode and agent: \[\d\.\d, ",
    "stop_bites": r"a reserve of 3: [23] to [23] apples are left",
    "own_game": rf"trained, agent_0/return: {INTERVAL}\nrandom, agent_0/return: {INTERVAL}",
    "evaluate": rf"collective_return, trained - random: {INTERVAL}\ntensor\(\[\[",
    "sweep": rf"collective_return, freeze_steps=25: {INTERVAL}\n.*/summary.md",
    "plot": r"runs/plot-\S+/own\.png",
    "c51": rf"agent_0: {NUMBER} apples\nreplica_0/agent_1: {NUMBER} apples",
    "cql": rf"agent_0: {NUMBER} apples\nreplica_0/agent_1: {NUMBER} apples",
    "iql": r"agent_0: [01]\.\d\d\nreplica_0/agent_1: [01]\.\d\d",
}
"""What each example prints at its end."""
BY_THEMSELVES = ("remote_agent", "collect")
"""Examples that no test runs in its process: tests/web serves the game of one, the other spawns processes."""
EASY = Game(
    map=maps.parse(">.A.\n....\n.A.<"), rules=Rules(regrow_prob=(0.5,), may_fire=False, episode_steps=60)
)
"""Apples that always come back: whoever walks about harvests little, whoever stays near them a lot."""

RLLIB = [
    "ray",
    "ray.rllib.algorithms.ppo",
    "ray.rllib.core.rl_module.default_model_config",
    "ray.rllib.env.wrappers.pettingzoo_env",
    "ray.tune.registry",
]


OF_CPRL = sorted([*EXAMPLES.glob("*.py"), *OWN.glob("*.py")])


@pytest.mark.parametrize("path", [*OF_CPRL, *OTHERS.glob("*.py")], ids=lambda path: path.stem)
def test_an_example_is_short_says_what_it_shows_and_has_a_place_in_the_one_list(path):
    lines = path.read_text().splitlines()
    assert len(lines) <= (115 if path.parent == OWN else 70)
    if path.parent == OTHERS:
        page = (EXAMPLES.parent / "docs" / "algorithms.md").read_text()
        assert f"| `{path.relative_to(EXAMPLES.parent)} " in page
        return
    assert re.match(r'"""How to .*\.$', lines[0])
    assert re.match(r'Prints .*\."""$', lines[1])
    assert f"]({path.relative_to(EXAMPLES)})" in (EXAMPLES / "README.md").read_text()


@pytest.mark.integration
def test_the_collector_of_several_processes_runs_as_a_script(tmp_path):
    command = [sys.executable, str(EXAMPLES / "collect.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 10


@pytest.mark.integration
@pytest.mark.parametrize(
    "path",
    [path for path in OF_CPRL if path.stem not in BY_THEMSELVES],
    ids=lambda path: path.stem,
)
def test_an_example_prints_at_its_end_what_it_says(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path), run_name="__main__")
    assert re.search(PRINTS[path.stem], capsys.readouterr().out)


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
@pytest.mark.parametrize("name", ["resume", "extend"])
def test_runs_are_compared_alike_where_nobody_harvests_and_numbers_are_undefined(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    source = (EXAMPLES / f"{name}.py").read_text()
    far = source.replace(r".A>.A.\nAA..AA\n.A.<A.", r"A#.>.<")
    assert far != source
    exec(compile(far, name, "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.endswith("the same episodes: True\n")


def game_of(env):
    """The seed and the number of the episode that a world plays: all that its chance depends on."""
    world = env.batch.now
    return int(world.seed[0, 0]), int(world.episode[0, 0])


@pytest.fixture
def example(monkeypatch):
    """Loads an example, as a module that can be pickled."""

    def loaded(name):
        spec = importlib.util.spec_from_file_location(name, OTHERS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return loaded


@pytest.mark.integration
def test_ippo_of_torchrls_parts_says_what_agents_harvest(example, shorter_episodes, capsys):
    (harvest,) = example("torchrl_ippo").main(iterations=1, worlds=2)
    assert harvest >= 0
    assert f"iteration 1: an agent harvests {harvest:.1f} in an episode" in capsys.readouterr().out


@pytest.mark.integration
def test_ppo_in_plain_torch_repeats_itself(example, shorter_episodes):
    first, again, other = (
        example("cleanrl_style_ppo").main(iterations=2, worlds=2, seed=s) for s in (3, 3, 4)
    )
    assert first == again
    assert first != other


@pytest.mark.slow
@pytest.mark.parametrize("name", ["torchrl_ippo", "cleanrl_style_ppo"])
def test_plain_ppo_finds_apples_that_always_come_back(name, example, monkeypatch):
    monkeypatch.setattr(presets, "game", lambda _: EASY)
    harvests = example(name).main(iterations=20, worlds=8)
    assert sum(harvests[-3:]) > 1.5 * sum(harvests[:3])


@pytest.mark.integration
def test_the_single_agent_is_compared_with_random_play_and_counts_no_apple_twice(
    example, monkeypatch, capsys
):
    # Two apples, and none grows again: a world ends with the second bite, others play on.
    two = Game(map=maps.parse(">AA"), rules=Rules(regrow_prob=(0.0,), may_fire=False, episode_steps=40))
    monkeypatch.setattr(presets, "game", lambda _: two)
    played = example("single_agent").main(episodes=10)
    assert set(played) == {"random", "greedy"}
    assert 0 < played["random"] <= 2
    assert 0 <= played["greedy"] <= 2
    assert "episode 10: harvest" in capsys.readouterr().out


@pytest.mark.slow
def test_the_single_agent_earns_three_times_what_chance_does(example):
    played = example("single_agent").main(episodes=20)
    assert played["greedy"] >= 3 * played["random"]


class TestSB3:
    """Stable-Baselines3 through PettingZoo and SuperSuit."""

    @pytest.fixture
    def sb3(self, example):
        pytest.importorskip("stable_baselines3", reason="needs the extra sb3")
        pytest.importorskip("supersuit", reason="needs the extra sb3")
        return example("sb3_ppo")

    @pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined")
    def test_ppo_learns_with_shared_weights(self, sb3, shorter_episodes):
        harvests = sb3.main(iterations=2, worlds=2)
        assert len(harvests) == 2
        assert min(harvests) >= 0

    @pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined")
    def test_copies_play_different_worlds_and_the_clock_is_not_an_ending(self, sb3, shorter_episodes):
        env = sb3.worlds_of(presets.game("commons"), 2, seed=0)
        env.reset()
        differs = False
        for _ in range(60):
            seen, _, done, infos = env.step([0, 4, 0, 4] * 2)
            differs = differs or (seen[:4] != seen[4:]).any()
        assert differs, "apples grow elsewhere in the second world"
        assert done.all()
        assert all(info["TimeLimit.truncated"] for info in infos)


class TestRLlib:
    """RLlib resets world i of runner w with the seed s + w + i, in each iteration anew."""

    def test_worlds_of_all_runners_differ_and_play_on_from_iteration_to_iteration(self, example, monkeypatch):
        for name in RLLIB:
            monkeypatch.setitem(sys.modules, name, MagicMock())  # the wrapper needs none of it
        rllib, games = example("rllib_ppo"), []
        for runner in range(3):
            torch.manual_seed(5 + runner)  # as RLlib does before a runner makes its worlds
            worlds = [rllib.FlatWindows(parallel_env(EASY)) for _ in range(3)]
            for _ in range(2):
                for i, world in enumerate(worlds):
                    world.reset(seed=5 + runner + i)
                    games.append(game_of(world.env))
        assert len(set(games)) == 3 * 3 * 2
        assert len({seed for seed, _ in games}) == 3 * 3, "the worlds of a runner keep their seeds"

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore")
    @pytest.mark.parametrize(("runners", "worlds"), [(0, 2), (2, 2)])
    def test_no_two_episodes_of_a_training_are_the_same_game(
        self, example, monkeypatch, tmp_path, runners, worlds
    ):
        pytest.importorskip("ray.rllib.algorithms.ppo", reason="needs the extra rllib", exc_type=ImportError)
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        short = replace(EASY, rules=replace(EASY.rules, episode_steps=30))
        monkeypatch.setattr(presets, "game", lambda _: short)
        rllib, log = example("rllib_ppo"), tmp_path / "seeds"

        def logged(game):
            env = parallel_env(game)
            play = env.step

            def step(actions):
                with log.open("a") as file:
                    file.write(f"{game_of(env)}\n")
                return play(actions)

            env.step = step
            return env

        monkeypatch.setattr(rllib, "parallel_env", logged)
        for module in (rllib, sys.modules[__name__]):  # runners could not import them
            importlib.import_module("ray.cloudpickle").register_pickle_by_value(module)
        harvests = rllib.main(iterations=2, worlds=worlds, runners=runners)
        assert len(harvests) == 2
        assert min(harvests) >= 0
        turns = Counter(log.read_text().splitlines())
        assert len(turns) >= max(runners, 1) * worlds * 2, "an episode for each world and iteration"
        assert max(turns.values()) <= short.rules.episode_steps, "no episode was played twice"


@pytest.mark.filterwarnings("ignore")
def test_benchmarl_learns_the_task(example, shorter_episodes, tmp_path):
    if importlib.util.find_spec("benchmarl") is None:
        pytest.skip("needs BenchMARL, installed as docs/algorithms.md says")
    harvest = example("benchmarl_task").main(iterations=2, worlds=2, out=str(tmp_path))
    assert harvest >= 0
    assert list(tmp_path.glob("ippo_commons_*/config.pkl"))
