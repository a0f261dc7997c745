"""SIGKILL while a study runs, of its driver and of its workers: it ends like one that nobody killed."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from same_runs import differences, still_alive
from tiny_study import FREEZE, TINY

from cprl import Study
from cprl.runs.checkpoints import Checkpointer
from cprl.studies import InProcess, Processes, Ray, run_study, study_table
from cprl.studies.study import STATUS
from cprl.studies.trials import run_task

STUDY = Study(replace(TINY, episodes=80), {FREEZE: [2, 5]})
TESTS = Path(__file__).parent


def run_often_saved(task):
    Checkpointer.__init__.__kwdefaults__["every_s"] = 0.05
    return run_task(task)


class OftenSaved(Processes):
    work = staticmethod(run_often_saved)


class OftenSavedOnRay(Ray):
    work = staticmethod(run_often_saved)


def drive(out, on):
    """The body of the process that runs the study."""
    executor = {"processes": OftenSaved, "ray": OftenSavedOnRay}[on]
    sys.exit(len(run_study(STUDY, out, on=executor(jobs=2), results=False).failed))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_study(STUDY, folder, on=InProcess(), results=False).failed == ()
    return folder / "runs"


def started(out, on):
    paths = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    program = "import sys; from test_study_kills import drive; drive(*sys.argv[1:])"
    with open(out.with_suffix(".out"), "ab") as said:
        return subprocess.Popen(
            [sys.executable, "-c", program, str(out), on],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=said,
            stderr=said,
        )


def training(out, driver):
    """The processes of this driver that train a trial, as soon as there is one."""
    last = time.monotonic() + 200
    while time.monotonic() < last and driver.poll() is None:
        family = {child.pid: child for child in psutil.Process(driver.pid).children(recursive=True)}
        said = [json.loads(path.read_text()) for path in (out / STATUS).glob("*.json")]
        found = [family[own["pid"]] for own in said if own["steps"] > 40 and own["pid"] in family]
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"no trial trains: {driver.poll()}, {out.with_suffix('.out').read_text()[-2000:]}")


def killed_and_ended(out, on, victims):
    """Kills a driver or a worker of the study in turn, and lets it end."""
    driver = started(out, on)
    for victim in victims:
        workers = training(out, driver)
        if victim == "worker":
            workers[0].send_signal(signal.SIGKILL)
            assert still_alive(workers[:1], 30) == []
        else:
            driver.kill()
            driver.wait()
            assert still_alive(workers, 60) == []
            driver = started(out, on)
    assert driver.wait(300) == 0, out.with_suffix(".out").read_text()[-2000:]


def assert_same_study(out, undisturbed):
    names = sorted(path.name for path in undisturbed.iterdir())
    assert sorted(path.name for path in (out / "runs").iterdir()) == names
    found = {name: differences(out / "runs" / name, undisturbed / name) for name in names}
    assert not any(found.values()), found
    tables = [study_table(STUDY, runs).rows for runs in (out / "runs", undisturbed)]
    # Marks say under which commit a run was made, which others may change meanwhile.
    one, other = (repr(table.drop_columns(["marks"]).to_pylist()) for table in tables)
    assert one == other


@pytest.mark.integration
@pytest.mark.parametrize("victim", ["driver", "worker"])
def test_a_study_is_the_same_after_one_kill(victim, tmp_path, undisturbed):
    killed_and_ended(tmp_path / "study", "processes", [victim])
    assert_same_study(tmp_path / "study", undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("on", ["processes", "ray"])
def test_a_study_is_the_same_after_kills_of_drivers_and_workers(on, tmp_path, undisturbed):
    killed_and_ended(tmp_path / "study", on, ["driver", "worker", "driver"])
    assert_same_study(tmp_path / "study", undisturbed)
