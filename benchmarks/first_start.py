"""What the first start costs, by two checkouts: processor time of a process, user and system, with those it
starts.

    python benchmarks/first_start.py ../main .

Each case runs in a new process with empty caches, CPRL_CACHE and torch's, and in a second one with what the
first kept there. A first turn: one world is made, begins an episode, plays a turn, and loads its state. A
first update: of `recipes/tragedy.py`, compiled and eager, and with layers of another width, which
starts with the caches that the recipe filled.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

GAMES: Final = {
    "first turn: commons, published": 'presets.game("commons")',
    "first turn: commons, as run": 'presets.game("commons", variant="as_run")',
    "first turn: commons, with a quota": 'replace(presets.game("commons"), institutions=(Quota(),))',
    "first turn: cleanup": 'presets.game("ssd/cleanup-v1")',
}
START: Final = """
from dataclasses import replace
import numpy as np
from cprl import presets
from cprl.commons.batch import Batch
from cprl.institutions import Quota
batch = Batch({game}, 1)
output = batch.begin()
batch.play(np.zeros((1, batch.game.agents), np.int64), output)
batch.load(batch.state(), output)
"""
UPDATE: Final = """
import os, sys
from dataclasses import replace
import cprl
from cprl.algorithms import DQN
from cprl.population import Learning
sys.path.insert(0, {recipes!r})
import tragedy
experiment = tragedy.experiment()
settings = replace(experiment.agents[0].algorithm.settings, **{settings})
experiment = replace(experiment, agents=(Learning(DQN(settings=settings)),) * 4, **{changes})
class Stop(BaseException):
    pass
from cprl.training.training import Training
step = Training.step
def stepped(training):
    step(training)
    if any(learner.steps >= 2 * settings.learning_starts for learner in training.learners.values()):
        raise Stop
Training.step = stepped
try:
    cprl.run(experiment, {run!r})
except Stop:
    pass
"""
TRAININGS: Final = {
    "first update: make run, compiled": ({}, {"engine": "compiled"}),
    "first update: make run, eager": ({}, {"engine": "eager"}),
}


def spent_s(checkout: Path, code: str, caches: str) -> float:
    """Return the processor time in seconds of a process that runs code with the library of a checkout."""
    folders = {"CPRL_CACHE": f"{caches}/cprl", "TORCHINDUCTOR_CACHE_DIR": f"{caches}/torch"}
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve() / "src"), **folders}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def update_code(checkout: Path, run: str, settings: dict[str, object], changes: dict[str, object]) -> str:
    """Return the code of a training that stops after some updates."""
    recipes = str(checkout.resolve() / "recipes")
    return UPDATE.format(recipes=recipes, run=run, settings=settings, changes=changes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    options = parser.parse_args()
    for name, game in GAMES.items():
        if options.only not in name:
            continue
        for checkout in (options.before, options.after):
            with tempfile.TemporaryDirectory() as caches:
                first_s, second_s = (spent_s(checkout, START.format(game=game), caches) for _ in range(2))
            print(f"{name}, {checkout}: {first_s:6.1f} s, then {second_s:4.1f} s", flush=True)
    for name, (settings, changes) in TRAININGS.items():
        if options.only not in name:
            continue
        for checkout in (options.before, options.after):
            with tempfile.TemporaryDirectory() as caches:
                code = [update_code(checkout, f"{caches}/run{n}", settings, changes) for n in range(2)]
                first_s, second_s = (spent_s(checkout, each, caches) for each in code)
                wider = update_code(checkout, f"{caches}/wider", {"hidden_cells": (48, 40)}, changes)
                wider_s = spent_s(checkout, wider, caches)
            print(
                f"{name}, {checkout}: {first_s:6.1f} s, then {second_s:4.1f} s; layers of another width "
                f"{wider_s:4.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
