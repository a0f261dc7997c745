"""What is killed: a study of 3 x 2 conditions, and executors whose trials save a checkpoint every second."""

from dataclasses import replace
from pathlib import Path
from typing import Final

from cprl import Experiment, presets
from cprl.algorithms import DQN
from cprl.population import Learning
from cprl.runs.checkpoints import Checkpointer
from cprl.studies import InProcess, Processes, Ray, Study, run_study
from cprl.studies.executors import Executor
from cprl.studies.trials import Outcome, Task, run_task

EVERY_S: Final = 1.0
JOBS: Final = 2


def study(episodes: int = 12) -> Study:
    """Time-outs and discounts of four DQN agents on the commons as run, 4 replicas in blocks of 2."""
    game = presets.game("commons", variant="as_run")
    settings = replace(
        presets.dqn_settings("commons", variant="as_run"),
        buffer_size=2000,
        learning_starts=200,
        epsilon_decay_steps=2000,
    )
    experiment = Experiment(
        name="killed",
        game=replace(game, rules=replace(game.rules, episode_steps=200)),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=episodes,
        evaluation_episodes=4,
    )
    factors = {
        "game.rules.freeze_steps": [5, 25, 100],
        "agents.*.algorithm.settings.gamma": [0.9, 0.99],
    }
    return Study(experiment, factors, replicas=4, block=2)


def run_often_saved(task: Task) -> Outcome:
    """`run_task` with a checkpoint every second."""
    Checkpointer.__init__.__kwdefaults__["every_s"] = EVERY_S
    return run_task(task)


class _Processes(Processes):
    work = staticmethod(run_often_saved)


class _Ray(Ray):
    work = staticmethod(run_often_saved)


def executor(on: str) -> Executor:
    """By its name on the command line; that of processes and Ray has `JOBS` workers."""
    return {
        "here": lambda: InProcess(),
        "processes": lambda: _Processes(JOBS),
        "ray": lambda: _Ray(jobs=JOBS),
    }[on]()


def drive(out: Path, on: str, episodes: int) -> int:
    """Runs the study; how many of its trials failed."""
    return len(run_study(study(episodes), out, on=executor(on), results=False).failed)
