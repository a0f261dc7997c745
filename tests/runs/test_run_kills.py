"""SIGKILL in every stage of a run: what is resumed afterwards ends like what nobody killed."""

import os
import signal
import subprocess
import sys
from functools import cache

import pytest
from same_runs import differences

import cprl
from cprl import Experiment, Game, Rules, maps
from cprl.algorithms import DQN, PPO, VDN, DQNSettings, RolloutSettings
from cprl.population import Learning, Team
from cprl.runs.checkpoints import Checkpointer

REPLAY = DQNSettings(
    buffer_size=300,
    batch_size=4,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=20,
    epsilon_decay_steps=1000,
    target_every_episodes=2,
)
ROLLOUTS = RolloutSettings(
    rollout_steps=40, epochs=2, minibatch_size=20, learning_rate=1e-3, hidden_cells=(8,)
)
AGENTS = {
    "DQN": (Learning(DQN(settings=REPLAY)),) * 2,
    "PPO": (Learning(PPO(settings=ROLLOUTS)),) * 2,
    "VDN": (Team(VDN(settings=REPLAY), agents=(0, 1)),),
}
MOMENTS = {
    "before the first checkpoint": ("checkpoints/training", 1),
    "training": ("checkpoints/training", 40),
    "weights": ("checkpoints/final.pt", 2),
    "evaluation": ("evaluation/trained", 2),
    "figures": ("figures/", 1),
    "report": ("report.json", 2),
}
"""The beginning of a path in the run, and before which operation on such paths a process dies."""


def experiment(name):
    rules = Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=25, freeze_steps=2)
    return Experiment(
        name=name,
        game=Game(map=maps.parse(".A>.A\n.A.A.\n..<.A"), rules=rules),
        agents=AGENTS[name],
        episodes=24,
        replicas=2,
        seed=3,
        evaluation_episodes=4,
        engine="eager",
    )


def live(name, run, path, number):
    """The body of a process: begins or resumes a run, and kills itself before an operation on a file."""
    left = int(number)

    def die(event, arguments):
        nonlocal left
        if event in ("open", "os.rename", "os.remove", "os.mkdir") and isinstance(
            arguments[0], str | os.PathLike
        ):
            left -= os.fspath(arguments[0]).startswith(f"{run}/{path}")
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    if path:
        sys.addaudithook(die)
    Checkpointer.__init__.__kwdefaults__["every_s"] = 0.05
    cprl.run(experiment(name), run, resume=os.path.exists(f"{run}/recipe.json"), watch="off")


def lived(name, run, moment=("", 0)):
    """The exit code of a process."""
    argv = [sys.executable, __file__, name, str(run), *map(str, moment)]
    process = subprocess.run(argv, capture_output=True, text=True, timeout=300)
    assert process.returncode in (0, -signal.SIGKILL), process.stderr
    return process.returncode


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """The run that nobody killed, of an experiment."""

    @cache
    def of(name):
        run = tmp_path_factory.mktemp("twins") / name
        return cprl.run(experiment(name), run, watch="off", figures=True)

    return of


@pytest.mark.integration
@pytest.mark.parametrize(
    ("name", "stages"),
    [("DQN", ["training"]), *(pytest.param(name, MOMENTS, marks=pytest.mark.slow) for name in AGENTS)],
)
def test_a_run_that_is_killed_in_stages_of_it_ends_bit_identical(name, stages, twin, tmp_path):
    run = tmp_path / "run"
    assert {lived(name, run, MOMENTS[stage]) for stage in stages} == {-signal.SIGKILL}
    assert list((run / "checkpoints").glob("training-*.pt"))
    assert not (run / "report.json").exists()
    assert lived(name, run) == 0
    assert differences(run, twin(name)) == []


if __name__ == "__main__":
    live(*sys.argv[1:])
