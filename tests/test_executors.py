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
from cprl.studies import InProcess, Processes, Ray, run_study
from cprl.studies.executors import on_ray, processes
from cprl.studies.executors.on_ray import BASE_BYTES, MemoryNeeds, estimated_bytes
from cprl.studies.executors.processes import Stopping
from cprl.studies.study import STATUS
from cprl.studies.trials import Status, run_task, task_of, trials_of

STUDY = Study(TINY, {FREEZE: [2, 5]})
TESTS = Path(__file__).parent


def tasks_in(folder, study=STUDY):
    return [task_of(own, runs=folder / "runs", status=folder / STATUS) for own in trials_of(study)]


def attempts_of(task):
    """The numbers of the processes that tried it."""
    path = Path(task.status) / f"{task.name}.attempts"
    return path.read_text().split() if path.exists() else []


def note_attempt(task):
    Path(task.status).mkdir(parents=True, exist_ok=True)
    with open(Path(task.status) / f"{task.name}.attempts", "a") as file:
        file.write(f"{os.getpid()}\n")


def run_or_die_once(task):
    """A worker that is killed in the study's first training, when a checkpoint is there."""
    note_attempt(task)
    saved = Checkpointer.save

    def save_and_die(self, *arguments, **how):
        path = saved(self, *arguments, **how)
        if task.recipe["experiment"]["game"]["rules"]["freeze_steps"] == 2 and len(attempts_of(task)) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return path

    Checkpointer.__init__.__kwdefaults__["every_s"] = 1e-6
    Checkpointer.save = save_and_die
    try:
        return run_task(task)
    finally:
        Checkpointer.save = saved


def die_or_run(task):
    """A worker that always dies of the study's first trial."""
    note_attempt(task)
    if task.recipe["experiment"]["game"]["rules"]["freeze_steps"] == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return run_task(task)


def break_at_start(task):
    raise OSError("no such disk")


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
    """The study of one process that nobody killed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_study(STUDY, folder, on=InProcess(), results=False).failed == ()
    return folder / "runs"


def assert_same_runs(folder, undisturbed):
    runs = sorted(own.name for own in undisturbed.iterdir())
    assert sorted(own.name for own in folder.iterdir()) == runs
    assert {name: differences(folder / name, undisturbed / name) for name in runs} == {
        name: [] for name in runs
    }


@pytest.mark.integration
def test_a_worker_process_that_is_killed_is_replaced_and_its_trial_ends_the_same(tmp_path, undisturbed):
    result = run_study(STUDY, tmp_path, on=Dying(1), results=False)
    assert result.failed == ()
    assert_same_runs(result.runs, undisturbed)
    killed, other = map(attempts_of, tasks_in(tmp_path))
    assert len(set(killed)) == 2
    assert len(other) == 1


@pytest.mark.slow
def test_a_trial_whose_processes_always_die_fails_alone_and_its_neighbour_keeps_its_process(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(processes, "ATTEMPTS", 3)
    study = Study(TINY, {FREEZE: [2, 5, 10]})
    result = run_study(study, tmp_path, on=Hopeless(2), results=False)
    dead, *others = tasks_in(tmp_path, study)
    (failed,) = result.failed
    assert failed.name == dead.name
    assert "the process that ran it died" in failed.reason
    assert Status(tmp_path / STATUS, dead.name).failure() == failed.reason
    assert len(set(attempts_of(dead))) == 3
    assert [len(attempts_of(other)) for other in others] == [1, 1]


@pytest.mark.slow
def test_what_a_worker_cannot_even_begin_is_the_trials_failure(tmp_path):
    result = run_study(STUDY, tmp_path, on=Broken(1), results=False)
    assert [own.reason for own in result.failed] == ["OSError: no such disk"] * 2


SCRIPT = """
import sys
from dataclasses import replace
sys.path[:0] = [{tests!r}]
from tiny_study import FREEZE, TINY
from cprl.studies import Processes, Ray, Study, run_study
{more}
# No `if __name__ == "__main__"`, which a user may forget.
run_study(Study(replace(TINY, episodes={episodes}), {{FREEZE: [2, 5]}}), {out!r}, on={on}, results=False)
print("whole")
"""


def started(out, on, *, episodes, more=""):
    """A process that runs the tiny study, of so many episodes."""
    script = SCRIPT.format(tests=str(TESTS), out=str(out), on=on, episodes=episodes, more=more)
    path = out.with_suffix(".py")
    path.write_text(script)
    return subprocess.Popen(
        [sys.executable, str(path)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def wait_until_both_train(out, process):
    """The processes that run the two trials."""
    last = time.monotonic() + 300
    while time.monotonic() < last and process.poll() is None:
        said = [json.loads(own.read_text()) for own in (out / STATUS).glob("*.json")]
        if len(said) == 2 and all(own["steps"] > 20 for own in said):
            return [psutil.Process(own["pid"]) for own in said]
        time.sleep(0.1)
    raise AssertionError(f"the trials do not train: {process.poll()}")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("on", ["Processes(2)", "Ray(jobs=2)"])
def test_a_study_that_is_asked_to_stop_saves_and_the_same_line_continues_it(tmp_path, on, number):
    out = tmp_path / "study"
    with started(out, on, episodes=100_000) as process:
        workers = wait_until_both_train(out, process)
        process.send_signal(number)
        said, _ = process.communicate(timeout=60)
    # An unhandled KeyboardInterrupt ends Python by SIGINT, or with 1 where TorchRL is imported.
    allowed = {signal.SIGTERM: (143,), signal.SIGINT: (-number, 1)}[number]
    assert process.returncode in allowed, said
    assert "Stopping: each trial finishes its step and saves a checkpoint" in said
    assert "Stopped; 2 trials are left. The same line again continues the study." in said
    assert ("Traceback" in said) == (number == signal.SIGINT), "of a KeyboardInterrupt, by Python"
    assert still_alive(workers, 5) == []
    for run in (out / "runs").iterdir():
        assert list((run / "checkpoints").glob("training-*.pt")), said
        assert not (run / "run.lock").exists()
    for log in (out / STATUS).glob("*.log"):
        assert "Stopped; everything up to step" in log.read_text()


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


@pytest.mark.slow
@pytest.mark.parametrize(("on", "within_s"), [("Processes(2)", 2.0), ("Ray(jobs=2)", 30.0)])
def test_workers_end_when_the_process_that_runs_the_study_is_killed(tmp_path, on, within_s):
    out = tmp_path / "study"
    with started(out, on, episodes=100_000) as process:
        workers = wait_until_both_train(out, process)
        process.kill()
        began = time.monotonic()
        assert still_alive(workers, within_s) == []
        print(f"{on}: {time.monotonic() - began:.2f} s")


@pytest.mark.slow
def test_a_script_without_a_guard_runs_its_study_once(tmp_path):
    with started(tmp_path / "study", "Processes(2)", episodes=1) as process:
        said, _ = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert said.count("whole") == 1
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_tasks_of_ray_whose_workers_are_killed_make_the_same_runs(tmp_path, undisturbed, monkeypatch):
    monkeypatch.chdir(TESTS)  # Ray's workers import this module from there
    import ray

    result = run_study(STUDY, tmp_path / "study", on=DyingOnRay(jobs=2), results=False)
    assert result.failed == ()
    assert_same_runs(result.runs, undisturbed)
    assert not ray.is_initialized()
    monkeypatch.setattr(on_ray, "ATTEMPTS", 2)
    result = run_study(STUDY, tmp_path / "hopeless", on=HopelessOnRay(jobs=2), results=False)
    (failed,) = result.failed
    assert failed.name == tasks_in(tmp_path / "hopeless")[0].name
    assert "its worker or node died (WorkerCrashedError)" in failed.reason


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Processes(0), "Processes.jobs is 0"),
        (lambda: Processes(2.0), "Processes.jobs is 2.0"),
        (lambda: Processes(True), "Processes.jobs is True"),
        (lambda: Ray(""), "Ray.address is ''"),
        (lambda: Ray(7), "Ray.address is 7"),
        (lambda: Ray(jobs=0), "Ray.jobs is 0"),
        (lambda: Ray(memory_bytes=0), "Ray.memory_bytes is 0"),
    ],
)
def test_an_executor_refuses_what_does_not_fit(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("on", ["processes", 2, Processes, run_task])
def test_a_study_runs_on_an_executor_and_on_nothing_else(tmp_path, on):
    with pytest.raises(ValueError, match=r"on is .*"):
        run_study(STUDY, tmp_path / "study", on=on)
    assert not (tmp_path / "study").exists()


def test_where_ray_is_missing_a_sentence_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(on_ray, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[ray\]"'):
        Ray()


def test_a_trial_asks_for_what_its_buffers_take_until_another_has_finished(tmp_path, undisturbed):
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
    needs = MemoryNeeds([small, big])
    assert needs.of(big) == round(1.1 * 2 * (BASE_BYTES + buffers))
    assert on_ray.MemoryNeeds([big]).of(big) == round(1.1 * (BASE_BYTES + buffers))
