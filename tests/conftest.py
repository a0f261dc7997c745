"""What the tests share: small boards that are never square, and a quiet, seeded torch."""

import gc
import inspect
import os
import signal
from dataclasses import replace

import pytest
import torch
from places import TESTS

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning, Scripted
from cprl.system.jit.compiled import PLAIN_RULES, RULES_VARIABLE
from cprl.values import METRIC_WORDS, trusting

RUN_DEFAULTS = inspect.unwrap(cprl.run).__kwdefaults__
DRAWS_CURVES = RUN_DEFAULTS["figures"]


def pytest_addoption(parser):
    parser.addoption("--plain", action="store_true", help="run the rules of the game as plain Python")


def pytest_configure(config):
    # Processes that tests start import what tests share, which imports examples of own algorithms.
    folders = [
        str(path)
        for path in config.getini("pythonpath")
        if path.is_relative_to(TESTS) or path.name == "own_algorithm"
    ]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [*folders, os.environ.get("PYTHONPATH", "")]))
    if config.getoption("--plain"):
        os.environ[RULES_VARIABLE] = PLAIN_RULES
    # The curve of a small training takes longer than the training; tests that look at it ask for `curves`.
    RUN_DEFAULTS["figures"] = False
    # What tests write need not survive a crash of the machine.
    os.fsync = lambda file: None


def pytest_collection_finish():
    # Each training ends with a garbage collection, which need not look at all that the tests have imported.
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def seeded_torch() -> None:
    """TorchRL's modules draw from torch's global generator; every test starts it anew."""
    torch.manual_seed(0)
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def trusted():
    """What a test allows to be imported is not allowed in the next one."""
    with trusting(()):
        yield


@pytest.fixture(autouse=True)
def names_of_metrics():
    """What a test, or code of the docs that it runs, calls a metric of its own is forgotten after it."""
    yield
    METRIC_WORDS.clear()


@pytest.fixture
def curves(monkeypatch):
    """Trainings draw their curve, as they do for users."""
    monkeypatch.setitem(RUN_DEFAULTS, "figures", DRAWS_CURVES)


@pytest.fixture
def stopped(monkeypatch):
    """Trains an experiment with a callback of `own_parts`, which ends the process at a step."""

    def run_until(at_step, experiment, out, **options):
        monkeypatch.setenv("STOP_AT_STEP", str(at_step))
        with pytest.raises(SystemExit) as error:
            cprl.run(experiment, out, watch="off", **options)
        monkeypatch.delenv("STOP_AT_STEP")
        assert error.value.code == 128 + signal.SIGTERM
        return out

    return run_until


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved, in order, each with its caption; not rendered."""
    figures = []

    def keep(figure, path, *, caption, **how):
        figure.caption = caption
        figures.append(figure)
        return path

    monkeypatch.setattr("cprl.terminal.style.save", keep)
    return figures


@pytest.fixture
def shorter_episodes(monkeypatch, request):
    """Episodes of 60 steps in published games, but for slow tests."""
    if "slow" in request.keywords:
        return
    game = presets.game

    def shorter(board, *, variant="published"):
        whole = game(board, variant=variant)
        return replace(whole, rules=replace(whole.rules, episode_steps=60))

    monkeypatch.setattr(presets, "game", shorter)


@pytest.fixture(scope="session")
def corridors(tmp_path_factory):
    """Runs on `stored_runs.CORRIDORS` by the policy of both agents."""
    from stored_runs import CORRIDORS, ran

    from cprl.population import Scripted

    folder = tmp_path_factory.mktemp("corridors")
    return {
        policy: ran(folder / policy, CORRIDORS, [Scripted(policy)] * 2, replicas=2)
        for policy in ("greedy", "sustainable")
    }


@pytest.fixture(scope="session")
def alike(tmp_path_factory):
    """A run on `stored_runs.MEADOW` of two DQN agents that learned a little, three replicas."""
    from stored_runs import DQN, MEADOW, ran

    return ran(tmp_path_factory.mktemp("learned") / "alike", MEADOW, [DQN] * 2)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of experiment 4 in miniature: 2 replicas of 12 episodes of 40 steps."""
    game = presets.game("two_complex", variant="as_run")
    learner = Learning(DQN(settings=presets.dqn_settings("two_complex", variant="as_run")))
    experiment = cprl.Experiment(
        name="two_against_random",
        game=replace(game, rules=replace(game.rules, episode_steps=40)),
        agents=(learner, Scripted("random")),
        replicas=2,
        episodes=12,
        evaluation_episodes=2,
        engine="eager",
    )
    return cprl.run(experiment, tmp_path_factory.mktemp("runs") / "four")
