"""Where trials are run: the same runs come out, whatever process of a trial dies on the way."""

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from threading import Thread
from types import ModuleType

import psutil
import pytest
from same_runs import assert_same_study, attempts_of, log_of, still_alive
from tiny_study import FREEZE, TINY

from cprl import Custom, Study
from cprl.studies import InProcess, Processes, Ray, executors, run_study
from cprl.studies.status import Status
from cprl.studies.study import STATUS
from cprl.studies.trials import Task, trials_of

OFTEN_SAVED = replace(TINY, episodes=60, callbacks=(Custom("often_saved:OftenSaved"),))
STUDY = Study(OFTEN_SAVED, {FREEZE: [2, 5]})
SEVERAL = Study(replace(OFTEN_SAVED, episodes=40), {FREEZE: [2, 5, 10]})


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The runs of a study of one process that nobody killed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_study(STUDY, folder, on=InProcess(), results=False).failed == ()
    return folder / "runs"


@pytest.fixture
def deaths(tmp_path, monkeypatch):
    """Sets how many processes of trials die, the first ones that train."""
    monkeypatch.setenv("DEATHS", str(tmp_path / "deaths"))
    return (tmp_path / "deaths").write_text


@pytest.mark.integration
def test_a_trial_whose_process_is_killed_is_resumed_in_another_one_and_ends_the_same(
    tmp_path, undisturbed, deaths
):
    deaths("1")
    result = run_study(STUDY, tmp_path, on=Processes(1), results=False)
    assert result.failed == ()
    assert_same_study(STUDY, result.runs, undisturbed)
    killed, other = result.trials
    assert (attempts_of(tmp_path, killed), attempts_of(tmp_path, other)) == (2, 1)
    assert "Resuming from step" in log_of(tmp_path, killed)


@pytest.mark.slow
@pytest.mark.parametrize("on", [Processes(1), Ray(jobs=1)], ids=["processes", "ray"])
def test_a_trial_whose_processes_always_die_fails_alone(on, tmp_path, deaths, monkeypatch):
    monkeypatch.setattr(executors, "ATTEMPTS", 2)
    deaths("2")
    result = run_study(SEVERAL, tmp_path, on=on, results=False)
    (failed,) = result.failed
    assert "its process died" in failed.reason
    assert [attempts_of(tmp_path, trial) for trial in result.trials] == [2, 1, 1]
    status = Status(tmp_path / STATUS, result.trials[0].name)
    assert (failed.name, failed.reason) == (status.name, status.failure())


@pytest.mark.integration
def test_a_trial_that_failed_says_why_and_can_be_repeated_by_hand_with_the_line_in_its_log(
    tmp_path, monkeypatch
):
    module = ModuleType("only_here")
    module.Callback = type("Callback", (), {"on_episode": lambda *_: None, "__module__": "only_here"})
    monkeypatch.setitem(sys.modules, "only_here", module)
    experiment = replace(TINY, callbacks=(Custom("only_here:Callback"),))
    result = run_study(Study(experiment), tmp_path, on=Processes(1), results=False)
    (failed,) = result.failed
    assert "No module named 'only_here'" in failed.reason
    assert attempts_of(tmp_path, result.trials[0]) == 1
    (tmp_path / "only_here.py").write_text("class Callback:\n    def on_episode(self, *_): ...\n")
    command = log_of(tmp_path, result.trials[0]).partition("\n")[0].removeprefix("$ ")
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    subprocess.run(command, shell=True, env=environment, check=True, capture_output=True)
    assert result.trials[0].state(result.runs) == "finished"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_by_ray_a_trial_whose_worker_is_killed_ends_the_same(tmp_path, undisturbed):
    import ray

    killed = []

    def kill_a_worker():
        while not list(tmp_path.glob("runs/*/checkpoints/training-*")):
            time.sleep(0.02)
        children = psutil.Process().children(recursive=True)
        trial = next(process for process in children if "--trial" in process.cmdline())
        killed.extend([trial, trial.parent()])
        trial.parent().kill()

    thread = Thread(target=kill_a_worker)
    thread.start()
    result = run_study(STUDY, tmp_path, on=Ray(jobs=2), results=False)
    thread.join()
    assert result.failed == ()
    assert still_alive(killed, 5) == []
    assert_same_study(STUDY, result.runs, undisturbed)
    assert sum(attempts_of(tmp_path, trial) for trial in result.trials) == 3
    assert not ray.is_initialized()


class FakeProcess(nullcontext):
    """A process that ends when it is stopped, and asks this one to stop whenever it is looked at."""

    def __init__(self, signals):
        super().__init__(self)
        self.signals, self.stops = [*signals], []

    def poll(self):
        if self.signals:
            os.kill(os.getpid(), self.signals.pop(0))
            return None
        return 143 if self.stops else None

    def kill(self):
        self.stops.append("kill")


@pytest.mark.parametrize(
    ("signals", "kind", "stops"),
    [
        ([signal.SIGINT], KeyboardInterrupt, ["ask"]),
        ([signal.SIGTERM], SystemExit, ["ask"]),
        ([signal.SIGINT, signal.SIGTERM], SystemExit, ["ask", "kill"]),
    ],
    ids=str,
)
def test_a_study_that_is_asked_to_stop_asks_its_processes_once_and_kills_them_if_asked_again(
    signals, kind, stops, tmp_path, capsys, monkeypatch
):
    process = FakeProcess(signals)
    monkeypatch.setattr(executors, "_started", lambda *_: process)
    monkeypatch.setattr(executors, "_ask_to_stop", lambda process: process.stops.append("ask"))
    with pytest.raises(kind) as ended:
        run_study(Study(TINY, {FREEZE: [2, 5]}), tmp_path, on=Processes(1), results=False)
    assert getattr(ended.value, "code", None) in (None, 143)
    assert process.stops == stops
    assert "2 trials are left" in capsys.readouterr().out


def test_what_cannot_be_started_is_the_failure_of_its_trial(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-python"))
    result = run_study(Study(TINY, {FREEZE: [2, 5]}), tmp_path, on=Processes(1), results=False)
    assert [outcome.reason.split(":")[0] for outcome in result.failed] == ["FileNotFoundError"] * 2


@pytest.mark.parametrize(
    ("kind", "arguments", "name"),
    [
        (Processes, {"jobs": 0}, "Processes.jobs is 0"),
        (Ray, {"address": ""}, "Ray.address is ''"),
        (Ray, {"jobs": 0}, "Ray.jobs is 0"),
        (Ray, {"memory_bytes": 0}, "Ray.memory_bytes is 0"),
    ],
)
def test_an_executor_refuses_what_does_not_fit(kind, arguments, name):
    with pytest.raises(ValueError, match=name):
        kind(**arguments)


def test_where_ray_is_missing_a_sentence_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(executors, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[ray\]"'):
        Ray()


def test_a_trial_asks_ray_for_a_tenth_more_than_the_largest_of_its_study_took(tmp_path):
    small, big = (
        Task(trial=trial, runs=tmp_path, status=Status(tmp_path, trial.name)) for trial in trials_of(STUDY)
    )
    assert executors.bytes_of(small) == 1e9, "while nothing is known"
    for task, taken in ((small, 2_000_000_000), (big, 3_000_000_000)):
        task.status.path.write_text(f'{{"peak_bytes": {taken}}}')
    assert executors.bytes_of(small) == pytest.approx(3.3e9)
