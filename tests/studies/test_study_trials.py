"""A trial becomes a finished run, whatever was there and whichever process dies; how far all of them are."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from importlib import invalidate_caches
from pathlib import Path
from threading import Thread
from types import ModuleType, SimpleNamespace

import psutil
import pyarrow.compute as pc
import pytest
from rich.console import Console
from same_runs import assert_same_study, attempts_of, differences, log_of, still_alive, written_at
from study_runs import EXPERIMENT, TIME_OUT, write_run
from tiny_study import FREEZE, OFTEN_SAVED, TINY

import cprl
from cprl import Custom, Study, run_study
from cprl.experimental import ray_executor
from cprl.experimental.ray_executor import Ray
from cprl.runs.checkpoints import CHECKPOINTS as CHECKPOINTS
from cprl.runs.episodes import read_episodes, read_table
from cprl.runs.files import LOCK_FILE, RunLock, RunLockedError, write_json
from cprl.runs.recipe import read_recipe, start_run, write_circumstances
from cprl.runs.states import state_of
from cprl.studies import InProcess, Processes, executors, read_study, run, trial_progress
from cprl.studies.results import write_results
from cprl.studies.run import trials_with
from cprl.studies.status import PATIENCE_S, Status, StatusFile
from cprl.studies.study import STATUS
from cprl.studies.trial_progress import Overview, Progress, progress_table
from cprl.studies.trials import FinishedRuns, Task, TrialOutcome, begin_from_shorter, trials_of
from cprl.training import running

STUDY = Study(TINY, {FREEZE: [5, 25]})


def task_in(folder, study=STUDY, place=0):
    trial = trials_of(study, folder / "runs")[place]
    status = Status(folder / "status", trial.name)
    return Task(trial=trial, status=status, finished=FinishedRuns(trial.runs))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run of the first trial."""
    first = task_in(tmp_path_factory.mktemp("undisturbed"))
    assert first.run_here().worked
    return first.directory


@pytest.fixture
def first(tmp_path):
    """The first trial, whose directory is there."""
    first = task_in(tmp_path)
    first.directory.mkdir(parents=True)
    first.status.folder.mkdir()
    return first


@pytest.mark.integration
def test_a_missing_trial_is_run_and_says_how_far_it_is_and_a_finished_one_is_left_as_it_is(tmp_path, capsys):
    missing = task_in(tmp_path)
    assert missing.run_here() == TrialOutcome(missing.name, "finished", worked=True)
    assert capsys.readouterr().out == ""
    assert "tiny, 1 replica, 2 episodes" in missing.status.log.read_text()
    status = missing.status.read()
    assert (status["episodes"], status["of"], status["steps"], status["pid"]) == (2, 2, 40, os.getpid())
    assert status["peak_bytes"] > 10**7
    assert not list(tmp_path.rglob("*.partial"))
    before = written_at(missing.directory)
    assert missing.run_here() == TrialOutcome(missing.name, "finished", worked=False)
    assert written_at(missing.directory) == before


@pytest.mark.integration
@pytest.mark.parametrize("is_begun", [False, True])
def test_what_a_process_left_that_was_killed_before_its_recipe_or_first_checkpoint_is_no_obstacle(
    first, undisturbed, is_begun
):
    if is_begun:
        ended = ("report.json", "manifest.json", "episodes.parquet", CHECKPOINTS, "evaluation")
        ignored = shutil.ignore_patterns(*ended)
        shutil.copytree(undisturbed, first.directory, ignore=ignored, dirs_exist_ok=True)
        assert state_of(first.directory) == "begun"
    else:
        (first.directory / "recipe.json.0123abcd.partial").write_text("{")
        (first.directory / LOCK_FILE).write_text("")
    assert first.run_here().state == "finished"
    assert differences(first.directory, undisturbed) == []


@pytest.mark.integration
def test_a_failure_is_noted_with_its_reason_and_forgotten_when_it_is_mended(first, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(running, "evaluate_population", lambda *_, **__: 1 / 0)
        failed = first.run_here()
    assert (failed.state, failed.reason) == ("failed", "ZeroDivisionError: division by zero")
    assert first.status.failure() == "ZeroDivisionError: division by zero"
    assert "evaluate_population" in first.status.failed.read_text()
    assert first.run_here().state == "finished"
    assert first.status.failure() is None


@pytest.mark.integration
@pytest.mark.parametrize("is_begun", [False, True])
def test_a_trial_that_another_process_runs_is_left_to_it_as_long_as_it_does(first, undisturbed, is_begun):
    if is_begun:
        shutil.copy(undisturbed / "recipe.json", first.directory)
    first.status.path.write_text('{"episodes": 3}')
    with RunLock(first.directory):
        before = sorted(first.directory.iterdir())
        assert first.run_here() == TrialOutcome(first.name, "elsewhere")
        assert sorted(first.directory.iterdir()) == before
    assert first.status.read() == {"episodes": 3}
    assert first.run_here().worked, "as soon as nobody else runs it"


@pytest.mark.integration
@pytest.mark.parametrize("on", [None, Processes(2)], ids=["here", "processes"])
def test_a_trial_that_another_process_runs_does_not_hold_up_the_others(on, tmp_path, monkeypatch, capsys):
    first, second = (tmp_path / "runs" / trial.name for trial in trials_of(STUDY))
    first.mkdir(parents=True)
    lock = RunLock(first)
    lock.__enter__()
    waited = []

    def wait(seconds):
        assert state_of(second) == "finished", "before it waits for the first"
        waited.append(seconds)
        if len(waited) == 2:
            lock.__exit__(None, None, None)

    monkeypatch.setattr(run, "time", SimpleNamespace(sleep=wait))
    result = run_study(STUDY, tmp_path, on=on, results=False)
    assert not result.failed
    assert state_of(first) == "finished"
    assert len(waited) == 2
    assert "elsewhere" not in capsys.readouterr().out


@pytest.mark.integration
def test_the_lock_of_another_host_is_taken_over_once_its_trial_is_silent(tmp_path, undisturbed, monkeypatch):
    study, directory = Study(TINY, {FREEZE: [5]}), tmp_path / "runs" / undisturbed.name
    directory.mkdir(parents=True)
    shutil.copy(undisturbed / "recipe.json", directory)
    holder = {"host": "a-node-that-died", "pid": 1, "started": "2026-01-01T00:00:00+00:00"}
    (directory / LOCK_FILE).write_text(json.dumps(holder))
    (tmp_path / "status").mkdir()
    status = Status(tmp_path / "status", directory.name)
    clock = SimpleNamespace(now=0.0, episodes=0)

    def wait(seconds):
        assert state_of(directory) == "begun"
        clock.now += 10.0
        if clock.now < 50:  # its last signs of life
            status.path.write_text(json.dumps({"episodes": clock.now}))

    monkeypatch.setattr(run, "time", SimpleNamespace(sleep=wait))
    monkeypatch.setattr("cprl.studies.status.time", SimpleNamespace(monotonic=lambda: clock.now))
    assert not run_study(study, tmp_path, progress=False, results=False).failed
    assert clock.now == 40 + PATIENCE_S
    assert differences(directory, undisturbed) == []


@pytest.mark.integration
def test_a_run_that_another_study_began_under_another_name_is_gone_on_with(tmp_path, undisturbed):
    other = task_in(tmp_path, Study(replace(TINY, name="other", on_nan="continue"), {FREEZE: [5]}))
    other.directory.mkdir(parents=True)
    shutil.copy(undisturbed / "recipe.json", other.directory)
    assert other.run_here().state == "finished"
    recipe = json.loads((other.directory / "recipe.json").read_text())
    assert (recipe["recipe"], recipe["experiment"]["on_nan"]) == ("tiny", "continue")


@pytest.mark.parametrize("is_finished", [True, False])
@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({}, "freeze_steps"),
        ({"seed": 1000}, "seed"),
        ({"replicas": 1}, "replicas"),
        ({"episodes": 50}, "episodes"),
        ({"evaluation_episodes": 9}, "evaluation_episodes"),
    ],
    ids=["condition", "seed", "replicas", "longer", "evaluation"],
)
def test_a_trial_in_whose_directory_another_run_is_is_a_failure_by_name_and_no_part_of_the_table(
    changes, place, is_finished, tmp_path
):
    study = Study(EXPERIMENT, {TIME_OUT: [5, 25]})
    first, second = trials_of(study, tmp_path / "runs")
    other = replace(first.experiment, **changes) if changes else second.experiment
    directory = write_run(first.directory, other, lambda *_: 1, is_finished=is_finished)
    assert first.state() == "refused"
    before = written_at(directory)
    result = run_study(study, tmp_path, only=["freeze_steps=5"], progress=False)
    (failed,) = result.failed
    assert failed.name == first.name
    assert place in failed.reason
    assert written_at(directory) == before
    assert result.table is None


def test_a_finished_run_with_fewer_episodes_or_without_a_file_is_refused_and_an_unfinished_one_continued(
    tmp_path,
):
    study = Study(EXPERIMENT)
    for state, seen in (("finished", "refused"), ("unfinished", "begun")):
        (trial,) = trials_of(study, tmp_path / state)
        shorter = replace(trial.experiment, episodes=30)
        write_run(trial.directory, shorter, lambda *_: 1, is_finished=state == "finished")
        assert trial.state() == seen
    directory = write_run(tmp_path / "runs" / trial.name, trial.experiment, lambda *_: 1)
    (directory / "evaluation" / "trained.parquet").unlink()
    (failed,) = run_study(study, tmp_path, progress=False, results=False).failed
    assert "evaluation/trained.parquet" in failed.reason, "which its manifest lists"


@pytest.mark.parametrize("other", [{}, {"seed": 1000}], ids=["condition", "block"])
def test_files_of_another_trial_beside_a_trials_own_recipe_are_a_failure_by_name(other, tmp_path):
    """As after a restore that mixed two trials: each file is sound, and the recipe is right."""
    study = Study(EXPERIMENT, {TIME_OUT: [5, 25]})
    first, second = trials_of(study)
    experiment = replace(first.experiment, **other) if other else second.experiment
    directory = write_run(tmp_path / "runs" / first.name, first.experiment, lambda *_: 1)
    mixed = write_run(tmp_path / "mixed", experiment, lambda *_: 1)
    shutil.copytree(mixed, directory, ignore=shutil.ignore_patterns("recipe.json"), dirs_exist_ok=True)
    result = run_study(study, tmp_path, only=["freeze_steps=5"], progress=False)
    (failed,) = result.failed
    assert "another experiment" in failed.reason
    assert len(result.table.rows) == 0
    (reason,) = (each.reason for each in result.table.missing_runs if each.name == first.name)
    assert "another experiment" in reason


@pytest.mark.parametrize("name", ["study.json", "run.lock", "table.parquet", "status", "figures"])
def test_a_study_with_a_link_out_of_it_is_refused_by_the_link_unless_its_runs_are_on_another_disk(
    name, tmp_path
):
    study, outside = Study(EXPERIMENT), tmp_path / "outside"
    for folder in ("study", "outside", "disk"):
        (tmp_path / folder).mkdir()
    (tmp_path / "study" / "runs").symlink_to(tmp_path / "disk")
    result = run_study(study, tmp_path / "study", on=Written(study, 1.0), progress=False, results=False)
    assert state_of(tmp_path / "disk" / result.trials[0].name) == "finished"
    (tmp_path / "study" / "study.json").unlink()
    (tmp_path / "study" / name).symlink_to(outside / "file" if "." in name else outside)
    for use in (
        lambda: run_study(study, tmp_path / "study", on=Written(study, 1.0), progress=False),
        lambda: write_results(study, tmp_path / "study", tmp_path / "runs"),
    ):
        with pytest.raises(ValueError, match=f"{name} is a symbolic link"):
            use()
    assert list(outside.iterdir()) == []


class Written:
    """An executor that writes runs instead of training them, each with a harvest of so many apples."""

    def __init__(self, study, apples):
        self.names = []
        self._trials, self._apples = {trial.name: trial for trial in trials_of(study)}, apples

    def run(self, tasks):
        for task in tasks:
            if state_of(task.directory) == "missing":
                write_run(task.directory, self._trials[task.name].experiment, lambda *_: self._apples)
                self.names.append(task.name)
            yield TrialOutcome(task.name, "finished")


def only_name(study):
    """The name of the only trial of a study."""
    (trial,) = trials_of(study)
    return trial.name


OWN_CODE = replace(EXPERIMENT, callbacks=(Custom("own_callback:Callback"),))


@pytest.fixture
def write_module(tmp_path, monkeypatch):
    """Writes a module `own_callback`, which is then imported anew, as in another process."""

    def write(text):
        (tmp_path / "own_callback.py").write_text(text)
        monkeypatch.delitem(sys.modules, "own_callback", raising=False)
        invalidate_caches()

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    return write


@pytest.mark.integration
def test_a_study_runs_anew_what_was_made_with_other_code_and_keeps_what_was_there(
    tmp_path, write_module, capsys
):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    first = run_study(study, tmp_path / "study", on=Written(study, 1.0), results=False)
    before = read_episodes(first.runs / only_name(study))
    same = Written(study, 2.0)
    write_module("class Callback: ...")
    run_study(study, tmp_path / "study", on=same, results=False)
    assert same.names == []
    edited = Written(study, 2.0)
    write_module("class Callback: apples = 2")
    capsys.readouterr()
    table = run_study(study, tmp_path / "study", on=edited).table
    assert edited.names == [only_name(study)]
    rows = table.rows.filter(pc.field("metric") == "collective_return")
    assert set(rows["value"].to_pylist()) == {2.0, 4.0}, "4 of random play"
    (earlier,) = (tmp_path / "study" / "runs-earlier").iterdir()
    assert read_episodes(earlier).equals(before)
    assert str(earlier) in capsys.readouterr().out


def test_other_code_is_refused_where_another_process_makes_the_trial_and_unknown_where_no_checksum_is(
    tmp_path, write_module
):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    name, executor = only_name(study), Written(study, 2.0)
    run = write_run(tmp_path / "a/runs" / name, study.experiment, lambda *_: 1.0, is_finished=False)
    write_module("class Callback: apples = 2")
    with RunLock(run), pytest.raises(RunLockedError, match=name):
        run_study(study, tmp_path / "a", progress=False)
    run = write_run(tmp_path / "b/runs" / name, study.experiment, lambda *_: 1.0, code=None)
    assert write_circumstances(run) == []
    run_study(study, tmp_path / "b", on=executor, progress=False, results=False)
    assert executor.names == []


def test_nothing_is_moved_from_under_another_process_that_runs_a_trial_of_earlier_code(
    tmp_path, write_module
):
    study = Study(OWN_CODE, {TIME_OUT: [5, 25]})
    write_module("class Callback: ...")
    runs = run_study(study, tmp_path, on=Written(study, 1.0), progress=False, results=False).runs
    *_, last = (trial.name for trial in trials_of(study))
    write_module("class Callback: apples = 2")
    before = sorted(path.name for path in runs.iterdir())
    with RunLock(runs / last), pytest.raises(RunLockedError, match=last):
        run_study(study, tmp_path, progress=False)
    assert sorted(path.name for path in runs.iterdir()) == before
    assert not (tmp_path / "runs-earlier").exists()


def test_code_that_was_edited_and_not_imported_again_is_what_a_recipe_keeps(tmp_path, write_module):
    write_module("class Callback: ...")
    OWN_CODE.callbacks[0].resolve()
    (tmp_path / "own_callback.py").write_text("class Callback: apples = 2")
    run = start_run(tmp_path / "run", "run", OWN_CODE.to_recipe)
    assert [*json.loads((run / "recipe.json").read_text())["code_text"].values()] == ["class Callback: ..."]


@pytest.mark.integration
def test_loading_evaluating_and_resuming_warn_of_other_code_and_the_recipe_keeps_each_text(
    tmp_path, write_module, capsys
):
    target = "own_callback:Callback"
    experiment = replace(TINY, callbacks=(Custom(target),))
    text = "class Callback:\n    is_extendable = True\n    def on_episode(self, episode, learning): ...\n"
    write_module(text)
    run = cprl.run(experiment, tmp_path / "run", watch="off", keep_checkpoint=True)
    cprl.trust(target)
    cprl.load(run)
    assert "own_callback" not in capsys.readouterr().err
    write_module(text + "# edited\n")
    for use in (
        lambda: cprl.load(run),
        lambda: cprl.evaluate_run(run, cprl.Fresh(episodes=1)),
        lambda: cprl.run(replace(experiment, episodes=3), run, resume=True, watch="off"),
    ):
        use()
        assert "own_callback" in capsys.readouterr().err
    recipe = json.loads((run / "recipe.json").read_text())
    assert set(recipe["code_text"].values()) == {text, text + "# edited\n"}
    assert recipe["code_text"][recipe["code"]["own_callback"]] == text
    assert recipe["code_text"][recipe["extended"][0]["code"]["own_callback"]] == text + "# edited\n"


@pytest.mark.integration
def test_a_study_runs_what_is_missing_and_an_edited_or_another_one_keeps_what_is_there(tmp_path):
    first = run_study(STUDY, tmp_path, results=False)
    assert first.failed == ()
    assert read_study(tmp_path) == STUDY
    reports = [tmp_path / "runs" / trial.name / "report.json" for trial in first.trials]
    before = [report.stat().st_mtime_ns for report in reports]
    edited = Study(TINY, {FREEZE: [5, 25, 50]}, name="edited")
    assert len(run_study(edited, tmp_path, results=False).trials) == 3
    assert [report.stat().st_mtime_ns for report in reports] == before
    assert read_study(tmp_path) == edited
    shared = run_study(Study(TINY, {FREEZE: [25, 30]}), tmp_path / "b", runs=first.runs, results=False)
    assert shared.runs == first.runs
    assert len(list(first.runs.iterdir())) == 4, "one more"
    assert not (tmp_path / "b" / "runs").exists()


def test_a_part_of_a_study_is_chosen_by_whole_levels_and_not_by_parts_of_them():
    cells = "agents.*.algorithm.settings.hidden_cells"
    trials = trials_of(Study(TINY, {cells: [(32, 32), (32, 8, 32), (8, 32)], FREEZE: [2, 5]}))

    def chosen(*only):
        return [
            (trial.condition.levels[cells], trial.condition.levels[FREEZE])
            for trial in trials_with(trials, only)
        ]

    assert chosen("hidden_cells=(32, 32)") == [((32, 32), 2), ((32, 32), 5)]
    assert chosen("freeze_steps=5, hidden_cells=(32, 8, 32)") == [((32, 8, 32), 5)]
    assert chosen("hidden_cells=(8, 32), freeze_steps=2") == [((8, 32), 2)]
    named = trials_of(Study(TINY, conditions={"a (b, c": {}, "d), e": {FREEZE: 3}}))
    assert [trial.condition.name for trial in trials_with(named, ["a (b, c"])] == ["a (b, c"]
    assert [trial.condition.name for trial in trials_with(named, ["e"])] == ["d), e"]
    longer = trials_of(Study(TINY, conditions={"a, b": {}, "a, b, c": {FREEZE: 3}}))
    assert [trial.condition.name for trial in trials_with(longer, ["a, b"])] == ["a, b"], "a name is one"
    for part in ("32", "8, 32)", "", ", "):
        with pytest.raises(ValueError, match="allowed: a condition or levels of some"):
            trials_with(trials, [part])


@pytest.mark.integration
def test_a_study_varies_code_of_ones_own_and_processes_import_it_from_where_this_one_does(tmp_path):
    fatigue = Custom("own_parts:Fatigue", arguments={"per_step": 0.5})
    study = Study(replace(TINY, transforms=(fatigue,)), {"transforms.0.arguments.per_step": [0.0, 0.5]})
    result = run_study(study, tmp_path, on=Processes(1), only=["per_step=0.5"], results=False)
    assert not result.failed
    recipe = json.loads(next(result.runs.glob("*/recipe.json")).read_text())
    assert recipe["experiment"]["transforms"][0]["arguments"] == {"per_step": 0.5}


# Processes of trials


TWO = Study(OFTEN_SAVED, {FREEZE: [2, 5]})
SEVERAL = Study(replace(OFTEN_SAVED, episodes=40), {FREEZE: [2, 5, 10]})


@pytest.fixture(scope="module")
def both_undisturbed(tmp_path_factory):
    """The runs of a study of one process that nobody killed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_study(TWO, folder, on=InProcess(), results=False).failed == ()
    return folder / "runs"


@pytest.fixture
def deaths(tmp_path, monkeypatch):
    """Sets how many processes of trials die, the first ones that train."""
    monkeypatch.setenv("DEATHS", str(tmp_path / "deaths"))
    return (tmp_path / "deaths").write_text


@pytest.mark.integration
def test_a_trial_whose_process_is_killed_is_resumed_in_another_one_and_ends_the_same(
    tmp_path, both_undisturbed, deaths
):
    deaths("1")
    result = run_study(TWO, tmp_path, on=Processes(1), results=False)
    assert result.failed == ()
    assert_same_study(TWO, result.runs, both_undisturbed)
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
    assert result.trials[0].state() == "finished"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_by_ray_a_trial_whose_worker_is_killed_ends_the_same(tmp_path, both_undisturbed):
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
    result = run_study(TWO, tmp_path, on=Ray(jobs=2), results=False)
    thread.join()
    assert result.failed == ()
    assert still_alive(killed, 5) == []
    assert_same_study(TWO, result.runs, both_undisturbed)
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

    wait = poll

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
    monkeypatch.setattr(executors, "start_process", lambda *_: process)
    monkeypatch.setattr(executors, "ask_to_stop", lambda process: process.stops.append("ask"))
    with pytest.raises(kind) as ended:
        run_study(Study(TINY, {FREEZE: [2, 5]}), tmp_path, on=Processes(1), results=False)
    assert getattr(ended.value, "code", None) in (None, 143)
    assert process.stops == stops
    assert "2 trials are left" in capsys.readouterr().out


def test_what_cannot_be_started_is_the_failure_of_its_trial(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-python"))
    result = run_study(Study(TINY, {FREEZE: [2, 5]}), tmp_path, on=Processes(1), results=False)
    assert [outcome.reason.split(":")[0] for outcome in result.failed] == ["FileNotFoundError"] * 2


def test_an_executor_refuses_what_does_not_fit_and_ray_says_how_to_install_it(monkeypatch):
    for kind, name, value in (
        *((kind, "jobs", 0) for kind in (Processes, Ray)),
        *((Ray, "address", ""), (Ray, "memory_bytes", 0)),
    ):
        with pytest.raises(ValueError, match=f"{kind.__name__}.{name} is {value!r}"):
            kind(**{name: value})
    monkeypatch.setattr(ray_executor, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[ray\]"'):
        Ray()


def test_a_trial_asks_ray_for_a_tenth_more_than_the_largest_of_its_study_took(tmp_path):
    small, big = (
        Task(trial=trial, status=Status(tmp_path, trial.name), finished=FinishedRuns(tmp_path))
        for trial in trials_of(TWO)
    )
    assert ray_executor.bytes_of(small) == 1e9, "while nothing is known"
    for task, taken in ((small, 2_000_000_000), (big, 3_000_000_000)):
        task.status.path.write_text(f'{{"peak_bytes": {taken}}}')
    assert ray_executor.bytes_of(small) == pytest.approx(3.3e9)


# Progress


TRIALS = trials_of(Study(replace(TINY, episodes=10, replicas=2), {FREEZE: [2, 5, 9]}))


@pytest.fixture
def says(tmp_path):
    """Writes what a trial says of itself, by its place."""
    folder = tmp_path / "status"
    folder.mkdir()

    def write(place, **status):
        path = Status(folder, TRIALS[place].name).path
        write_json(path, {"pid": 7, "host": "here", "of": 20, **status})

    return write


@pytest.fixture
def look(tmp_path, says):
    """Looks at all trials; gives the snapshot, and its row of a trial."""
    overview = Overview([replace(trial, runs=tmp_path / "runs") for trial in TRIALS], tmp_path / "status")

    def look(place=0):
        snapshot = overview.look()
        return snapshot, next(row for row in snapshot.rows if row.trial.name == TRIALS[place].name)

    return look


def test_the_time_left_is_that_of_the_speed_at_which_trials_say_they_play(says, look):
    says(0, beat=1, episodes=0, steps=0, compiling_s=0.0)
    says(1, beat=9, episodes=0, steps=0)
    look()
    says(1, beat=10, episodes=0, steps=0, compiling_s=31.0, is_compiling=True)
    snapshot, row = look(1)
    assert (row.state, row.note) == ("compiling", "for 31 s")
    assert snapshot.left_s is None, "nothing is known yet"
    says(0, beat=19, episodes=5, steps=99, episodes_per_s=0.5)
    snapshot, row = look(0)
    # 15 of this trial are left, and with those of the other two 55
    assert (row.state, row.note) == ("running", "30 s left")
    assert snapshot.left_s == pytest.approx(110.0)
    assert snapshot.line == (
        "0 of 3 trials finished, 2 running, 5 of 60 episodes, 1 compiling, 2 min left"
    )  # 110 s in words


def test_a_trial_says_its_speed_without_compiling_and_what_it_had_done_before(tmp_path, monkeypatch):
    now, clock = SimpleNamespace(s=0.0), SimpleNamespace(total_s=0.0, is_running=False)
    monkeypatch.setattr("cprl.system.times.time", SimpleNamespace(perf_counter=lambda: now.s))
    monkeypatch.setattr("cprl.system.times.CLOCK", clock)
    file = StatusFile(Status(tmp_path, "trial"), TRIALS[0].experiment)

    def speed():
        file.write()
        return json.loads((tmp_path / "trial.json").read_text())["episodes_per_s"]

    now.s = 5.0
    file.on_start(SimpleNamespace(steps=200, episodes_played=10))
    assert speed() is None
    now.s, clock.total_s = 39.0, 30.0
    for _ in range(2):
        file.on_episode(None, {})
    assert speed() == pytest.approx(0.5), "2 episodes in 4 s of work"


def test_a_trial_of_so_many_steps_is_as_far_as_its_steps_however_short_episodes_are(tmp_path):
    experiment = replace(TRIALS[0].experiment, episodes=None, steps=400, replicas=2, worlds=4)
    expected = 2 * experiment.length.episodes
    file = StatusFile(Status(tmp_path, "trial"), experiment)

    def played():
        file.write()
        return json.loads((tmp_path / "trial.json").read_text())["episodes"]

    file.on_start(SimpleNamespace(steps=200, episodes_played=10**6))
    assert played() == expected // 2
    for _ in range(49):
        file.on_step(None)
        file.on_episode(None, {})
    assert played() < expected, "it is not over yet"
    file.on_step(None)
    assert played() == expected


def test_a_trial_runs_while_it_says_something_new_whatever_the_clock_says(says, look, monkeypatch):
    says(0, beat=500, episodes=4, steps=9)
    assert look()[1].state == "waiting", "perhaps the last words of a dead process"
    says(0, beat=501, episodes=4, steps=9)
    assert look()[1].state == "running"
    says(0, beat=502, episodes=20, steps=9)
    assert look()[1].state == "evaluating", "all are played, and it is not finished yet"
    monkeypatch.setattr(trial_progress, "SILENT_S", 0.0)
    assert look()[1].state == "waiting"


def test_trials_that_count_steps_are_shown_by_their_steps(tmp_path):
    (long,) = trials_of(Study(replace(TINY, episodes=None, steps=4000, replicas=2)))
    says = Status(tmp_path, long.name).path
    expected = 2 * long.experiment.length.episodes
    overview = Overview([long], tmp_path)
    for beat in (1, 2):
        write_json(says, {"beat": beat, "episodes": expected // 2})
        snapshot = overview.look()
    assert snapshot.line.startswith("0 of 1 trials finished, 1 running, 4,000 of 8,000 steps")
    screen = Console(file=io.StringIO(), width=80)
    screen.print(progress_table(snapshot, title="mine"))
    assert screen.file.getvalue().splitlines()[1].split() == ["trial", "state", "steps"]


@pytest.mark.integration
def test_a_table_is_never_higher_than_a_screen_and_counts_the_rest(tmp_path):
    many = trials_of(Study(TINY, {FREEZE: range(1, 101)}))
    Status(tmp_path, many[77].name).fail("ValueError: no", "")
    snapshot = Overview(many, tmp_path).look()
    screen = Console(file=io.StringIO(), width=80, height=24)
    screen.print(progress_table(snapshot, title="mine", most=16))
    lines = screen.file.getvalue().splitlines()
    assert len(lines) == 19
    assert lines[2].split() == ["freeze_steps=78,", "replica", "0", "failed", "0/2", "ValueError:", "no"]
    assert lines[-2].strip() == "and 85 waiting"
    assert lines[-1].startswith("0 of 100 trials finished, 1 failed, 0 of 200 episodes")


def test_what_trials_print_does_not_disturb_lines_that_come_while_they_run(tmp_path, capsys, monkeypatch):
    printed = io.StringIO()
    with Progress(TRIALS, tmp_path, title="mine") as table:
        monkeypatch.setattr(sys, "stdout", printed)
        print("noise")
        Status(tmp_path, TRIALS[0].name).fail("ValueError: no", "")
        table.ended(TrialOutcome(TRIALS[0].name, "failed", "ValueError: no", True))
        table.ended(TrialOutcome(TRIALS[1].name, "finished"))
    assert printed.getvalue() == "noise\n"
    assert capsys.readouterr().out.splitlines() == [
        "mine: 0 of 3 trials finished, 0 of 60 episodes",
        "mine: freeze_steps=2, replicas 0-1 failed: ValueError: no (1 of 3)",
        "mine: 0 of 3 trials finished, 1 failed, 0 of 60 episodes",
    ]
    monkeypatch.undo()
    monkeypatch.setattr("cprl.studies.trial_progress._TABLE_PERIOD_S", 0.01)
    monkeypatch.setattr("cprl.studies.trial_progress._LINE_PERIOD_S", 0.05)
    with Progress(TRIALS, tmp_path, title="mine"):
        time.sleep(0.5)
    assert 3 <= len(capsys.readouterr().out.splitlines()) <= 14


@pytest.mark.integration
@pytest.mark.parametrize("wanted", [True, False])
def test_in_a_terminal_one_table_is_drawn_again_and_again_where_progress_is_wanted(
    wanted, tmp_path, monkeypatch
):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("TERM", "xterm")
    study = Study(replace(TINY, episodes=1), {FREEZE: [2]})
    run_study(study, tmp_path / "out", results=False, progress=wanted)
    printed = screen.getvalue()
    if wanted:
        assert "\x1b[" in printed
        assert "freeze_steps=2, replica 0" in printed
        assert "1 of 1 trials finished, 1 of 1 episodes" in printed.splitlines()[-2]
    else:
        assert printed == ""


# A study of more episodes goes on from the runs of a shorter one that kept the state of its trainings.


def study_of(episodes):
    return Study(replace(TINY, episodes=episodes), {FREEZE: [2, 5]}, name="tiny")


def run_of(study, runs, place=0):
    return runs / trials_of(study)[place].name


def ran(study, out, runs, **options):
    result = run_study(study, out, runs=runs, progress=False, results=False, **options)
    assert not result.failed
    return result


@pytest.mark.integration
def test_what_is_extended_equals_what_was_longer_from_the_first_episode_on(tmp_path):
    pool, apart = tmp_path / "pool", tmp_path / "apart"
    short, long = study_of(2), study_of(5)
    ran(short, tmp_path / "short", pool, keep_checkpoints=True)
    before = written_at(run_of(short, pool))
    ran(long, tmp_path / "long", pool)
    ran(long, tmp_path / "again", apart)
    for place in (0, 1):
        extended, whole = run_of(long, pool, place), run_of(long, apart, place)
        assert (extended / "evaluation-2").is_dir(), "it went on from the shorter one"
        assert not (whole / "evaluation-2").exists()
        for name in ("episodes.parquet", "evaluation/trained.parquet", "evaluation/random.parquet"):
            one, other = (repr(read_table(run / name).to_pydict()) for run in (extended, whole))  # with NaN
            assert one == other, name
    assert written_at(run_of(short, pool)) == before
    assert [path.name for path in pool.iterdir() if path.name.startswith(".")] == []


@pytest.mark.integration
def test_it_goes_on_from_the_longest_and_keeps_its_own_state_only_if_asked(tmp_path):
    pool = tmp_path / "pool"
    for episodes in (2, 3):
        ran(study_of(episodes), tmp_path / "study", pool, only=["freeze_steps=2"], keep_checkpoints=True)
    ran(study_of(4), tmp_path / "study", pool, only=["freeze_steps=2"])
    assert (run_of(study_of(4), pool) / "evaluation-3").is_dir()
    ran(study_of(5), tmp_path / "study", pool, only=["freeze_steps=2"])
    evaluations = sorted(path.name for path in run_of(study_of(5), pool).glob("evaluation-*"))
    assert evaluations == ["evaluation-2", "evaluation-3"], "the one of 4 episodes kept no state"


@pytest.mark.integration
def test_runs_that_kept_nothing_or_differ_are_no_beginning(tmp_path):
    pool = tmp_path / "pool"
    ran(study_of(2), tmp_path / "short", pool)
    ran(study_of(4), tmp_path / "long", pool)
    assert not (run_of(study_of(4), pool) / "evaluation-2").exists()
    other = Study(replace(TINY, episodes=2), {FREEZE: [9]}, name="tiny")
    ran(other, tmp_path / "other", pool, keep_checkpoints=True)
    ran(study_of(3), tmp_path / "more", pool)
    assert not list(run_of(study_of(3), pool).glob("evaluation-*"))


def test_the_recipe_of_each_finished_run_is_read_once_however_many_trials_begin(tmp_path, monkeypatch):
    seen = []

    def reads(run):
        seen.append(run.name)
        return read_recipe(run)

    class Begun:
        def run(self, tasks):
            for task in tasks:
                assert task.begin() is None
                yield TrialOutcome(task.name, "failed", "is not trained here")

    for number in range(3):
        write_run(tmp_path / "pool" / f"other-{number}", replace(EXPERIMENT, seed=number), lambda *_: 1.0)
    monkeypatch.setattr("cprl.studies.trials.read_recipe", reads)
    study = Study(EXPERIMENT, {TIME_OUT: [1, 2, 3, 4]})
    run_study(study, tmp_path / "study", runs=tmp_path / "pool", on=Begun(), progress=False, results=False)
    assert sorted(name for name in seen if name.startswith("other")) == ["other-0", "other-1", "other-2"]


@pytest.mark.integration
def test_a_trial_that_somebody_else_begins_meanwhile_is_left_to_them(tmp_path, monkeypatch):
    pool, long = tmp_path / "pool", study_of(4)
    ran(study_of(2), tmp_path / "short", pool, only=["freeze_steps=2"], keep_checkpoints=True)
    trial = trials_of(long)[0]
    copy = shutil.copytree

    def overtaken(source, target, *more, **options):
        if not (pool / trial.name).exists():
            (pool / trial.name).mkdir()
            (pool / trial.name / "recipe.json").write_text("{}")
        return copy(source, target, *more, **options)

    monkeypatch.setattr(shutil, "copytree", overtaken)
    recipe = trial.experiment.to_recipe(pool / trial.name)
    begin_from_shorter(pool / trial.name, trial.experiment, recipe, FinishedRuns(pool))
    assert len(list(pool.iterdir())) == 2


class SeesTheEnd:
    """What it does could depend on how long the training is to be."""

    def on_start(self, training):
        """Sees the number of episodes."""


@pytest.mark.integration
def test_a_training_that_sees_how_long_it_is_to_be_begins_anew(tmp_path):
    pool = tmp_path / "pool"
    for episodes in (2, 4):
        watched = replace(TINY, episodes=episodes, callbacks=(Custom(f"{__name__}:SeesTheEnd"),))
        ran(Study(watched, name="tiny"), tmp_path / "study", pool, keep_checkpoints=True)
    assert len(list(pool.iterdir())) == 2
    assert not list(pool.glob("*/evaluation-2"))


@pytest.mark.integration
def test_a_copy_that_was_cut_off_is_made_anew(tmp_path, monkeypatch):
    pool, long = tmp_path / "pool", study_of(4)
    ran(study_of(2), tmp_path / "short", pool, keep_checkpoints=True)

    def cut_off(*given, **options):
        Path(given[1]).mkdir()
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "copytree", cut_off)
        failed = run_study(long, tmp_path / "long", runs=pool, progress=False, results=False).failed
    assert [outcome.reason for outcome in failed] == ["OSError: [Errno 28] No space left on device"] * 2
    assert len(list(pool.iterdir())) == 2
    ran(long, tmp_path / "long", pool)
    assert (run_of(long, pool) / "evaluation-2").is_dir()


def test_failures_have_their_reason_and_stand_before_those_that_wait(look, tmp_path):
    Status(tmp_path / "status", TRIALS[2].name).fail("ValueError: of | chance", "trace")
    snapshot, row = look(2)
    assert snapshot.rows[0] is row
    assert row.note == "ValueError: of | chance"
