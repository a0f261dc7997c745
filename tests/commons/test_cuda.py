"""The CUDA driver plays the same game as the CPU driver: in Numba's simulator, and on a GPU if any."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from boards import random_actions
from dqn_parts import make_learner
from governed import EVERYTHING, random_decisions
from places import SUPPORT

from cprl import CommonsEnv, keys, presets
from cprl.algorithms import DQN
from cprl.commons.literature import LITERATURE_GAMES
from cprl.learners.settings import DQNSettings
from cprl.measuring.playing import evaluate
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.system.jit.compiled import PLAIN_RULES, RULES_VARIABLE
from cprl.training import Schedule, train

SCRIPT = SUPPORT / "cuda_in_simulator.py"
GAMES = [f"{board}:{variant}" for board, variant in presets.GAMES]

GOVERNED = ["institutions", "stopped", "literature"]


@pytest.fixture(scope="module")
def simulated():
    """The lines the script printed, and its process; Numba must be imported with the simulator enabled."""
    done = subprocess.run(
        [sys.executable, SCRIPT],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    return done.stdout.splitlines(), done


@pytest.mark.integration
@pytest.mark.parametrize("check", [*GAMES, "forms", "blocks", "state", "unknown", *GOVERNED])
def test_the_simulated_gpu_plays_the_same_game_as_the_cpu(simulated, check):
    lines, done = simulated
    assert f"{check} equal" in lines, done.stderr


@pytest.mark.integration
def test_the_simulator_exits_without_an_error(simulated):
    assert simulated[1].returncode == 0, simulated[1].stderr


def test_a_gpu_runs_no_rules_as_plain_python(monkeypatch):
    monkeypatch.setenv(RULES_VARIABLE, PLAIN_RULES)
    with pytest.raises(ValueError, match='device is "cuda" and CPRL_RULES is "python"'):
        CommonsEnv(presets.game("commons"), device="cuda")


@pytest.mark.gpu
@pytest.mark.parametrize(("board", "variant"), presets.GAMES)
def test_the_gpu_plays_the_same_game_as_the_cpu(board, variant):
    check_gpu(presets.game(board, variant=variant))


@pytest.mark.gpu
@pytest.mark.parametrize("name", LITERATURE_GAMES)
def test_the_gpu_plays_the_games_of_the_literature(name):
    check_gpu(presets.game(name), turns=60)


@pytest.mark.gpu
def test_the_gpu_plays_the_same_game_as_the_cpu_under_every_kind_of_institution():
    check_gpu(EVERYTHING)
    for own in EVERYTHING.institutions:
        check_gpu(replace(EVERYTHING, institutions=(own,)), turns=40)


def check_gpu(game, turns=300):
    """The same turns on the CPU and on the GPU: all entries and the whole state are equal."""
    envs = [CommonsEnv(game, 300, seed=3, device=device, state=True) for device in ("cpu", "cuda")]
    moments = [env.reset() for env in envs]
    decisions = torch.as_tensor(random_decisions(turns, 300, game))
    for turn, decided in zip(torch.as_tensor(random_actions(turns, 300, game)), decisions, strict=True):
        steps = []
        for i, env in enumerate(envs):
            moments[i].set(keys.ACTION, turn.to(env.device))
            if game.decisions:
                moments[i].set(keys.DECISION, decided.to(env.device))
            now, moments[i] = env.step_and_maybe_reset(moments[i])
            steps.append(now["next"])
        for key in steps[0].keys(True, True):
            assert steps[1][key].is_cuda
            assert torch.equal(steps[0][key], steps[1][key].cpu()), key
    states = [env.worlds.state() for env in envs]
    assert all(np.array_equal(array, states[1][name]) for name, array in states[0].items())


@pytest.mark.gpu
def test_an_agent_learns_on_the_gpu():
    game = presets.game("two_complex")
    env = CommonsEnv(game, device="cuda")
    settings = DQNSettings(buffer_size=500, learning_starts=50)
    how = {"agents": (0,), "replicas": 1, "engine": "torchrl", "device": "cuda"}
    learner = make_learner(DQN(settings=settings), game.spaces, **how)
    network = learner.lane_networks.parts[0][0]
    before = [weights.clone() for weights in network.parameters()]
    random = RandomActor(8, device="cuda")
    train(env, {(0,): learner}, Schedule(episodes=1), others={1: random})
    assert learner.memory.buffer.each[0].storage[:10]["observation"].is_cuda
    assert all(not torch.equal(*pair) for pair in zip(before, network.parameters(), strict=True))
    policies = JointPolicy({(0,): learner.evaluation_actor(8), 1: random})
    assert len(evaluate(CommonsEnv(game, 8, device="cuda"), policies)) == 8
