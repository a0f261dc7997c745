"""Where trials are run: the same runs come out, whatever dies on the way."""

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
from tiny_study import FREEZE, LEARNING, TINY

from cprl import Study
from cprl.algorithms import DQN
from cprl.learners.ring import storage_bytes
from cprl.population import Learning, Scripted
from cprl.runs.checkpoints import Checkpointer
from cprl.studies import InProcess, Processes, Ray, run_study, study_table
from cprl.studies.executors import on_ray, processes
from cprl.studies.executors.on_ray import BASE_BYTES, MemoryNeeds, estimated_bytes
from cprl.studies.executors.processes import Stopping
from cprl.studies.study import STATUS
from cprl.studies.trials import Status, run_task, task_of, trials_of

STUDY = Study(replace(TINY, episodes=80), {FREEZE: [2, 5]})
SHORT = Study(TINY, {FREEZE: [2, 5]})
TESTS = Path(__file__).parent


def tasks_in(folder, study=STUDY):
    return [task_of(trial, runs=folder / "runs", status=folder / STATUS) for trial in trials_of(study)]


def attempts_of(task):
    """The numbers of the processes that tried it."""
    path = Path(task.status) / f"{task.name}.attempts"
    return path.read_text().split() if path.exists() else []


def is_first(task):
    return task.recipe["experiment"]["game"]["rules"]["freeze_steps"] == 2


def note_attempt(task):
    Path(task.status).mkdir(parents=True, exist_ok=True)
    with open(Path(task.status) / f"{task.name}.attempts", "a") as file:
        file.write(f"{os.getpid()}\n")


def run_often_saved(task):
    Checkpointer.__init__.__kwdefaults__["every_s"] = 0.05
    return run_task(task)


def run_or_die_once(task):
    """A worker that is killed in the study's first training, when a checkpoint is there."""
    note_attempt(task)
    save = Checkpointer.save

    def save_and_die(self, *arguments, **how):
        path = save(self, *arguments, **how)
        if is_first(task) and len(attempts_of(task)) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return path

    Checkpointer.save = save_and_die
    try:
        return run_often_saved(task)
    finally:
        Checkpointer.save = save


def die_or_run(task):
    """A worker that always dies of the study's first trial."""
    note_attempt(task)
    if is_first(task):
        os.kill(os.getpid(), signal.SIGKILL)
    return run_task(task)


def break_at_start(task):
    raise OSError("no such disk")


class OftenSaved(Processes):
    work = staticmethod(run_often_saved)


class OftenSavedOnRay(Ray):
    work = staticmethod(run_often_saved)


class Dying(Processes):
    work = staticmethod(run_or_die_once)


class DyingOnRay(Ray):
    work = staticmethod(run_or_die_once)


class Hopeless(Processes):
    work = staticmethod(die_or_run)


class HopelessOnRay(Ray):
    work = staticmethod(die_or_run)


class Broken(Processes):
    work = staticmethod(break_at_start)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The runs of a study of one process that nobody killed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_study(STUDY, folder, on=InProcess(), results=False).failed == ()
    return folder / "runs"


def assert_same_study(runs, undisturbed):
    names = sorted(path.name for path in undisturbed.iterdir())
    assert sorted(path.name for path in runs.iterdir()) == names
    assert {name: differences(runs / name, undisturbed / name) for name in names} == {
        name: [] for name in names
    }
    # Marks say under which commit a run was made, which others may change meanwhile.
    tables = [study_table(STUDY, folder).rows.drop_columns(["marks"]) for folder in (runs, undisturbed)]
    assert repr(tables[0].to_pylist()) == repr(tables[1].to_pylist())


# Workers that die


@pytest.mark.integration
def test_a_worker_process_that_is_killed_is_replaced_and_its_trial_ends_the_same(tmp_path, undisturbed):
    result = run_study(STUDY, tmp_path, on=Dying(1), results=False)
    assert result.failed == ()
    assert_same_study(result.runs, undisturbed)
    killed, other = tasks_in(tmp_path)
    assert len(set(attempts_of(killed))) == 2
    assert len(attempts_of(other)) == 1
    assert "Resuming from step" in Status(Path(killed.status), killed.name).log.read_text()


@pytest.mark.slow
def test_a_trial_whose_processes_always_die_fails_alone_and_its_neighbour_keeps_its_process(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(processes, "ATTEMPTS", 3)
    study = Study(TINY, {FREEZE: [2, 5, 10]})
    (failed,) = run_study(study, tmp_path, on=Hopeless(2), results=False).failed
    dead, *others = tasks_in(tmp_path, study)
    assert failed.name == dead.name
    assert "the process that ran it died" in failed.reason
    assert Status(tmp_path / STATUS, dead.name).failure() == failed.reason
    assert len(set(attempts_of(dead))) == 3
    assert [len(attempts_of(other)) for other in others] == [1, 1]


@pytest.mark.slow
def test_what_a_worker_cannot_even_begin_is_the_trials_failure(tmp_path):
    result = run_study(SHORT, tmp_path, on=Broken(1), results=False)
    assert [outcome.reason for outcome in result.failed] == ["OSError: no such disk"] * 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_tasks_of_ray_whose_workers_are_killed_make_the_same_runs(tmp_path, undisturbed, monkeypatch):
    monkeypatch.chdir(TESTS)  # Ray's workers import this module from there
    import ray

    result = run_study(STUDY, tmp_path / "study", on=DyingOnRay(jobs=2), results=False)
    assert result.failed == ()
    assert_same_study(result.runs, undisturbed)
    assert not ray.is_initialized()
    monkeypatch.setattr(on_ray, "ATTEMPTS", 2)
    (failed,) = run_study(SHORT, tmp_path / "hopeless", on=HopelessOnRay(jobs=2), results=False).failed
    assert failed.name == tasks_in(tmp_path / "hopeless", SHORT)[0].name
    assert "its worker or node died (WorkerCrashedError)" in failed.reason


# A driver in a process of its own


SCRIPT = """
from dataclasses import replace
from test_executors import OftenSaved, OftenSavedOnRay
from tiny_study import FREEZE, TINY
from cprl.studies import Study, run_study
# No `if __name__ == "__main__"`, which a user may forget.
study = Study(replace(TINY, episodes={episodes}), {{FREEZE: [2, 5]}})
failed = run_study(study, {out!r}, on={on}, results=False).failed
print("failed" if failed else "whole")
"""
ON = ("OftenSaved(2)", "OftenSavedOnRay(jobs=2)")
ENDED_WITHIN_S = {ON[0]: 2.0, ON[1]: 30.0}


def started(out, on, *, episodes=80):
    """A process that runs the tiny study, of so many episodes."""
    script = out.with_suffix(".py")
    script.write_text(SCRIPT.format(out=str(out), on=on, episodes=episodes))
    paths = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])
    with open(out.with_suffix(".out"), "ab") as output:
        return subprocess.Popen(
            [sys.executable, str(script)],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=output,
            stderr=output,
        )


def printed(out):
    return out.with_suffix(".out").read_text()


def training(out, driver, *, count=1):
    """The processes of this driver that train a trial, as soon as there are so many."""
    last = time.monotonic() + 300
    while time.monotonic() < last and driver.poll() is None:
        family = {child.pid: child for child in psutil.Process(driver.pid).children(recursive=True)}
        reports = [json.loads(path.read_text()) for path in (out / STATUS).glob("*.json")]
        workers = [family[each["pid"]] for each in reports if each["steps"] > 40 and each["pid"] in family]
        if len(workers) >= count:
            return workers
        time.sleep(0.02)
    raise AssertionError(f"no trial trains: {driver.poll()}, {printed(out)[-2000:]}")


def assert_ends_the_same_after_kills(out, on, victims, undisturbed, *, ended_within_s=60.0):
    """Kill a driver or a worker of the study in turn, and let it end."""
    driver = started(out, on)
    for victim in victims:
        workers = training(out, driver)
        if victim == "worker":
            workers[0].send_signal(signal.SIGKILL)
            assert still_alive(workers[:1], 30) == []
        else:
            driver.kill()
            driver.wait()
            assert still_alive(workers, ended_within_s) == []
            driver = started(out, on)
    assert driver.wait(300) == 0, printed(out)[-2000:]
    assert "\nwhole\n" in printed(out)
    assert_same_study(out / "runs", undisturbed)


@pytest.mark.integration
@pytest.mark.parametrize("victim", ["driver", "worker"])
def test_a_study_is_the_same_after_one_kill(victim, tmp_path, undisturbed):
    assert_ends_the_same_after_kills(tmp_path / "study", ON[0], [victim], undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("on", ON)
def test_a_study_is_the_same_after_kills_and_workers_end_soon_after_their_driver(on, tmp_path, undisturbed):
    victims, within_s = ["driver", "worker", "driver"], ENDED_WITHIN_S[on]
    assert_ends_the_same_after_kills(tmp_path / "study", on, victims, undisturbed, ended_within_s=within_s)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("on", ON)
def test_a_study_that_is_asked_to_stop_saves_and_the_same_line_continues_it(tmp_path, on, number):
    out = tmp_path / "study"
    driver = started(out, on, episodes=100_000)
    workers = training(out, driver, count=2)
    driver.send_signal(number)
    # An unhandled KeyboardInterrupt ends Python by SIGINT, or with 1 where TorchRL is imported.
    allowed = {signal.SIGTERM: (143,), signal.SIGINT: (-number, 1)}[number]
    assert driver.wait(60) in allowed, printed(out)
    assert "Stopping: each trial finishes its step and saves a checkpoint" in printed(out)
    assert "Stopped; 2 trials are left. The same line again continues the study." in printed(out)
    assert ("Traceback" in printed(out)) == (number == signal.SIGINT), "of a KeyboardInterrupt, by Python"
    assert still_alive(workers, 5) == []
    for run in (out / "runs").iterdir():
        assert list((run / "checkpoints").glob("training-*.pt")), printed(out)
        assert not (run / "run.lock").exists()
    for log in (out / STATUS).glob("*.log"):
        assert "Stopped; everything up to step" in log.read_text()


@pytest.mark.slow
def test_a_script_without_a_guard_runs_its_study_once(tmp_path):
    out = tmp_path / "study"
    assert started(out, "OftenSaved(2)", episodes=1).wait(120) == 0, printed(out)
    assert printed(out).count("whole") == 1
    assert "Traceback" not in printed(out)


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)], ids=str
)
def test_a_study_stopped_in_worker_processes_ends_as_its_signal_says(number, kind, capsys):
    def stopped():
        with Stopping() as stopping:
            os.kill(os.getpid(), number)
            assert stopping.asked == 1
            stopping.end(2)

    with pytest.raises(kind) as ended:
        stopped()
    assert getattr(ended.value, "code", None) in (None, 143)
    assert "2 trials are left" in capsys.readouterr().out


# Values


@pytest.mark.parametrize(
    ("kind", "how", "name"),
    [
        (Processes, {"jobs": 0}, "Processes.jobs is 0"),
        (Processes, {"jobs": 2.0}, "Processes.jobs is 2.0"),
        (Ray, {"address": ""}, "Ray.address is ''"),
        (Ray, {"jobs": 0}, "Ray.jobs is 0"),
        (Ray, {"memory_bytes": 0}, "Ray.memory_bytes is 0"),
    ],
)
def test_an_executor_refuses_what_does_not_fit(kind, how, name):
    with pytest.raises(ValueError, match=name):
        kind(**how)


@pytest.mark.parametrize("on", ["processes", Processes])
def test_a_study_runs_on_an_executor_and_on_nothing_else(tmp_path, on):
    with pytest.raises(ValueError, match="on is "):
        run_study(SHORT, tmp_path / "study", on=on)
    assert not (tmp_path / "study").exists()


def test_where_ray_is_missing_a_sentence_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(on_ray, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[ray\]"'):
        Ray()


def test_a_trial_asks_for_what_its_buffers_take_until_another_has_finished(tmp_path):
    large = replace(LEARNING.algorithm.settings, buffer_size=100_000)
    agents = (Learning(DQN(settings=large)), Scripted("greedy"))
    study = Study(replace(TINY, replicas=3), {"agents": [TINY.agents, agents]})
    small, big = tasks_in(tmp_path, study)
    # Three lanes of 100,000 transitions of windows [3, 2, 3], and their copy in a checkpoint.
    buffers = 2 * 3 * storage_bytes(1, 100_000, study.experiment.game.spaces.observation_shape)
    assert estimated_bytes(big) == BASE_BYTES + buffers
    assert MemoryNeeds([small, big]).of(big) == round(1.1 * (BASE_BYTES + buffers))

    small.directory.mkdir(parents=True)
    (small.directory / "report.json").write_text("{}")
    Path(small.status).mkdir()
    taken = 2 * estimated_bytes(small)  # twice what was expected
    Status(Path(small.status), small.name).path.write_text(json.dumps({"peak_bytes": taken}))
    assert MemoryNeeds([small, big]).of(big) == round(1.1 * 2 * (BASE_BYTES + buffers))
    assert MemoryNeeds([big]).of(big) == round(1.1 * (BASE_BYTES + buffers))
