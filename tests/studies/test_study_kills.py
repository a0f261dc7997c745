"""SIGKILL of the process that runs a study, and of its group, in every stage: what the same line makes of it
afterwards is what nobody killed, and an edited study runs what is new alone."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from same_runs import assert_same_study, attempts_of, still_alive, written_at
from tiny_study import FREEZE, GAMMA, study_of

from cprl.runs.states import state_of
from cprl.studies import InProcess, run_study
from cprl.studies.study import STATUS
from cprl.studies.trials import trials_of

GRID = {FREEZE: [2, 5], GAMMA: [0.5, 0.9]}
EDITED = {FREEZE: [2, 5, 10], GAMMA: [0.5, 0.9]}
SCRIPT = """
from tiny_study import study_of
from cprl.experimental.ray_executor import Ray
from cprl.studies import Processes, run_study
# No `if __name__ == "__main__"`, which a user may forget.
failed = run_study(study_of({factors!r}, {episodes}), {out!r}, on={on}, results=False).failed
print("failed" if failed else "whole")
"""
ON = ("Processes(2)", "Ray(jobs=2)")
ENDED_WITHIN_S = {ON[0]: 10.0, ON[1]: 30.0}
"""A process that is just being started has to import what tells it that its parent died."""
UNFINISHED = ("begun", "stopped")
STAGES = {
    "a trial is begun": lambda out: any(runs_in(out, *UNFINISHED)),
    "trials train": lambda out: any(
        list(run.glob("checkpoints/training-*")) for run in runs_in(out, *UNFINISHED)
    ),
    "some trials are finished, others train": lambda out: (
        len(runs_in(out, "finished")) >= 3 and STAGES["trials train"](out)
    ),
}


def runs_in(out, *states):
    return [run for run in (out / "runs").glob("*-s*") if state_of(run) in states]


def started(out, on, factors=GRID, episodes=24):
    """A process that runs the study, with a group of its own."""
    script = out.with_suffix(".py")
    script.write_text(SCRIPT.format(out=str(out), on=on, factors=factors, episodes=episodes))
    with open(out.with_suffix(".out"), "ab") as output:
        return subprocess.Popen(
            [sys.executable, str(script)],
            stdout=output,
            stderr=output,
            start_new_session=True,
        )


def printed(out):
    return out.with_suffix(".out").read_text()


def wait_until(condition, driver, out):
    """Waits for a stage; gives the processes of the driver then."""
    last = time.monotonic() + 300
    while not condition(out):
        assert driver.poll() is None, printed(out)[-2000:]
        assert time.monotonic() < last, printed(out)[-2000:]
        time.sleep(0.02)
    return psutil.Process(driver.pid).children(recursive=True)


def is_of_trial(process):
    try:
        return "--trial" in process.cmdline()
    except psutil.NoSuchProcess:  # It was a short-lived helper, of a compiler for example.
        return False


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Gives the runs of a study in one process that nobody killed, and those of earlier, smaller ones."""
    folder = tmp_path_factory.mktemp("undisturbed")

    def undisturbed(study):
        assert run_study(study, folder, on=InProcess(), results=False).failed == ()
        return folder / "runs"

    return undisturbed


def kill(driver, out, stage, on):
    """Kills a driver and its group in a stage, and waits for the processes of its trials to end."""
    processes = wait_until(STAGES[stage], driver, out)
    os.killpg(driver.pid, signal.SIGKILL)
    driver.wait()
    assert still_alive(processes, ENDED_WITHIN_S[on]) == []


@pytest.mark.integration
def test_a_study_that_is_killed_while_its_trials_train_ends_the_same(tmp_path, undisturbed):
    out, on, factors = tmp_path / "study", ON[0], {FREEZE: [2], GAMMA: [0.5]}
    kill(started(out, on, factors), out, "trials train", on)
    assert started(out, on, factors).wait(300) == 0, printed(out)[-2000:]
    study = study_of(factors)
    assert_same_study(study, out / "runs", undisturbed(study))


@pytest.mark.slow
@pytest.mark.parametrize("on", ON)
def test_a_study_that_is_killed_three_times_ends_the_same_and_an_edited_one_runs_what_is_new_alone(
    on, tmp_path, undisturbed
):
    out, grid, edited = tmp_path / "study", study_of(GRID), study_of(EDITED)
    for stage in STAGES:
        kill(started(out, on), out, stage, on)
    assert 3 <= len(runs_in(out, "finished")) < 8, "something is left to do"
    assert started(out, on).wait(600) == 0, printed(out)[-2000:]
    assert "\nwhole\n" in printed(out)
    assert len(runs_in(out, "finished")) == 8
    assert_same_study(grid, out / "runs", undisturbed(grid))

    before = written_at(out / "runs")
    assert started(out, on, EDITED).wait(600) == 0, printed(out)[-2000:]
    assert before.items() <= written_at(out / "runs").items()
    new = {trial.name for trial in trials_of(edited)} - {trial.name for trial in trials_of(grid)}
    assert len(new) == 4
    assert [attempts_of(out, trial) for trial in trials_of(edited) if trial.name in new] == [1] * 4
    assert_same_study(edited, out / "runs", undisturbed(edited))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("on", ON)
def test_a_study_that_is_asked_to_stop_saves_and_the_same_line_continues_it(tmp_path, on, number):
    out = tmp_path / "study"
    driver = started(out, on, episodes=100_000)
    processes = wait_until(
        lambda out: len(list((out / "runs").glob("*/checkpoints/training-*"))) >= 2, driver, out
    )
    trials = list(filter(is_of_trial, processes))
    assert trials
    driver.send_signal(number)
    # An unhandled KeyboardInterrupt ends Python by SIGINT, or with 1 where TorchRL is imported.
    allowed = {signal.SIGTERM: (143,), signal.SIGINT: (-number, 1)}[number]
    assert driver.wait(60) in allowed, printed(out)
    assert "Stopping: each trial finishes its step and saves a checkpoint" in printed(out)
    assert "Stopped; 8 trials are left. The same line again continues the study." in printed(out)
    assert still_alive(trials, 5) == []
    assert not list((out / "runs").glob("*/run.lock"))
    begun = runs_in(out, *UNFINISHED)
    assert all(list(run.glob("checkpoints/training-*.pt")) for run in begun)
    logs = [(out / STATUS / f"{run.name}.log").read_text() for run in begun]
    assert all("Stopped; everything up to step" in log for log in logs)
