"""A trial becomes a finished run, whatever was there: nothing, half a run, a failure, another's lock."""

import json
import os
import pickle
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from importlib import invalidate_caches
from pathlib import Path

import pyarrow.compute as pc
import pytest
from study_runs import EXPERIMENT, TIME_OUT, write_run
from tiny_study import FREEZE, TINY

import cprl
from cprl import Custom, Study, run_study
from cprl.runs.checkpoints import FOLDER as CHECKPOINTS
from cprl.runs.episodes import read_episodes
from cprl.runs.files import LOCK_FILE, RunLock, RunLockedError
from cprl.runs.recipe import changed_circumstances, start_run
from cprl.studies import read_study, trials
from cprl.studies.results import write_results
from cprl.studies.run import trials_with
from cprl.studies.trials import Outcome, Status, run_task, state_of, task_of, trials_of

STUDY = Study(TINY, {FREEZE: [5, 25]})


def task(tmp_path, study=STUDY, nth=0):
    return task_of(trials_of(study)[nth], runs=tmp_path / "runs", status=tmp_path / "status")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run of the first trial."""
    first = task(tmp_path_factory.mktemp("undisturbed"))
    assert run_task(first).worked
    return first.directory


def assert_same(run, other):
    assert read_episodes(run).equals(read_episodes(other))
    for name in ("trained", "random"):
        path = f"evaluation/{name}.parquet"
        assert (run / path).read_bytes() == (other / path).read_bytes()


def written_at(folder):
    """When all files of a folder were written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.fixture
def first(tmp_path):
    """The first trial, whose directory is there."""
    first = task(tmp_path)
    first.directory.mkdir(parents=True)
    return first


@pytest.fixture
def status(first):
    """Where the first trial says how far it is."""
    status = Status(Path(first.status), first.name)
    status.folder.mkdir(parents=True)
    return status


@pytest.mark.integration
def test_a_missing_trial_is_run_and_says_how_far_it_is_and_a_finished_one_is_left_as_it_is(tmp_path, capsys):
    missing = task(tmp_path)
    assert state_of(missing.directory) == "missing"
    done = run_task(missing)
    assert (done.name, done.state, done.worked) == (missing.name, "finished", True)
    assert capsys.readouterr().out == ""
    status = Status(Path(missing.status), missing.name)
    assert "tiny, 1 replicas, 2 episodes" in status.log.read_text()
    said = status.read()
    assert (said["episodes"], said["of"], said["steps"], said["pid"]) == (2, 2, 40, os.getpid())
    assert said["peak_bytes"] > 10**7
    assert not list(tmp_path.rglob("*.partial"))
    before = written_at(missing.directory)
    again = run_task(missing)
    assert (again.state, again.worked) == ("finished", False)
    assert written_at(missing.directory) == before


@pytest.mark.integration
def test_what_a_killed_process_left_before_its_recipe_is_no_obstacle(first, undisturbed):
    (first.directory / "recipe.json.0123abcd.partial").write_text("{")
    (first.directory / LOCK_FILE).write_text("")
    assert run_task(first).state == "finished"
    assert_same(first.directory, undisturbed)


@pytest.mark.integration
def test_a_trial_that_was_killed_before_its_first_checkpoint_starts_over(first, undisturbed):
    ended = ("report.json", "manifest.json", "episodes.parquet", CHECKPOINTS, "evaluation")
    shutil.copytree(undisturbed, first.directory, ignore=shutil.ignore_patterns(*ended), dirs_exist_ok=True)
    assert state_of(first.directory) == "unfinished"
    assert run_task(first).state == "finished"
    assert_same(first.directory, undisturbed)


@pytest.mark.integration
def test_a_failure_is_noted_with_its_reason_and_forgotten_when_it_is_mended(first, status, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("cprl.training.running.evaluate_population", lambda *_, **__: 1 / 0)
        failed = run_task(first)
    assert (failed.state, failed.reason) == ("failed", "ZeroDivisionError: division by zero")
    assert status.failure() == "ZeroDivisionError: division by zero"
    assert "evaluate_population" in status.failed.read_text()
    assert run_task(first).state == "finished"
    assert status.failure() is None


SAID = {"episodes": 3, "of": 4}
"""What the process says that runs a trial."""


@pytest.mark.parametrize("is_begun", [False, True])
def test_a_trial_waits_while_another_process_runs_it(first, status, undisturbed, monkeypatch, is_begun):
    if is_begun:
        shutil.copy(undisturbed / "recipe.json", first.directory)
    lock = RunLock(first.directory)
    lock.__enter__()
    waited = []
    status.path.write_text(json.dumps(SAID))

    def finished_elsewhere(seconds):
        waited.append(seconds)
        assert status.read() == SAID
        lock.__exit__(None, None, None)
        shutil.copytree(undisturbed, first.directory, dirs_exist_ok=True)

    monkeypatch.setattr(trials.time, "sleep", finished_elsewhere)
    assert run_task(first).state == "finished"
    assert len(waited) == 1


@pytest.mark.integration
@pytest.mark.parametrize("is_begun", [False, True])
def test_a_task_that_does_not_wait_leaves_a_trial_to_the_process_that_runs_it(
    first, status, undisturbed, is_begun
):
    impatient = replace(first, waits=False)
    if is_begun:
        shutil.copy(undisturbed / "recipe.json", first.directory)
    status.path.write_text(json.dumps(SAID))
    with RunLock(first.directory):
        before = sorted(first.directory.iterdir())
        assert run_task(impatient) == Outcome(first.name, "elsewhere")
        assert sorted(first.directory.iterdir()) == before
    assert status.read() == SAID
    assert run_task(impatient).worked, "as soon as nobody else runs it"


@pytest.mark.integration
def test_a_trial_that_another_process_runs_does_not_hold_up_the_others(tmp_path, monkeypatch, capsys):
    first, second = (own.name for own in trials_of(STUDY))
    lock = RunLock(tmp_path / "runs" / first)
    (tmp_path / "runs" / first).mkdir(parents=True)
    lock.__enter__()

    class Clock:
        monotonic = time.monotonic

        @staticmethod
        def sleep(_):
            assert state_of(tmp_path / "runs" / second) == "finished", "before it waits for the first"
            lock.__exit__(None, None, None)

    monkeypatch.setattr(trials, "time", Clock)
    result = run_study(STUDY, tmp_path, results=False)
    assert not result.failed
    assert state_of(tmp_path / "runs" / first) == "finished"
    assert "elsewhere" not in capsys.readouterr().out


@pytest.mark.integration
def test_the_lock_of_another_host_is_taken_over_once_its_trial_is_silent(first, undisturbed, monkeypatch):
    shutil.copy(undisturbed / "recipe.json", first.directory)
    holder = {"host": "a-node-that-died", "pid": 1, "started": "2026-01-01T00:00:00+00:00"}
    (first.directory / LOCK_FILE).write_text(json.dumps(holder))
    monkeypatch.setattr(trials, "PATIENCE_S", 0.3)
    monkeypatch.setattr(trials, "_POLL_S", 0.05)
    looks = []
    before = trials.is_silent

    def watched(status, patience_s):
        for is_silent in before(status, patience_s):
            looks.append((is_silent, status.read()))
            yield is_silent

    monkeypatch.setattr(trials, "is_silent", watched)
    began = time.monotonic()
    assert run_task(first).state == "finished"
    assert time.monotonic() - began > 0.3
    assert looks == [*[(False, {})] * (len(looks) - 1), (True, {})], "who waits says nothing"
    assert_same(first.directory, undisturbed)


@pytest.mark.integration
def test_a_run_that_another_study_began_under_another_name_is_gone_on_with(tmp_path, undisturbed):
    other = task(tmp_path, Study(replace(TINY, name="other"), {FREEZE: [5]}))
    other.directory.mkdir(parents=True)
    shutil.copy(undisturbed / "recipe.json", other.directory)
    assert run_task(other).state == "finished"
    assert json.loads((other.directory / "recipe.json").read_text())["recipe"] == "tiny"


def test_a_trial_in_the_directory_of_another_is_a_failure_by_name_and_stays_as_it_is(tmp_path):
    study = Study(EXPERIMENT, {TIME_OUT: [5, 25]})
    first, second = trials_of(study)
    run = write_run(tmp_path / "runs" / first.name, second.experiment, lambda *_: 1)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    result = run_study(study, tmp_path, only=["freeze_steps=5"], progress=False)
    (failed,) = result.failed
    assert failed.name == first.name
    assert "freeze_steps" in failed.reason
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    assert result.table is None


def test_a_finished_trial_that_lost_a_file_of_its_manifest_is_a_failure_by_that_file(tmp_path):
    study = Study(EXPERIMENT)
    (trial,) = trials_of(study)
    run = write_run(tmp_path / "runs" / trial.name, trial.experiment, lambda *_: 1)
    (run / "evaluation" / "trained.parquet").unlink()
    (failed,) = run_study(study, tmp_path, progress=False, results=False).failed
    assert "evaluation/trained.parquet" in failed.reason


@pytest.mark.parametrize("name", ["study.json", "run.lock", "table.parquet", "status", "figures"])
def test_a_study_with_a_link_out_of_it_is_refused_by_the_link(name, tmp_path):
    study = Study(EXPERIMENT)
    (tmp_path / "study").mkdir()
    (tmp_path / "outside").mkdir()
    (tmp_path / "study" / name).symlink_to(
        tmp_path / "outside" / "file" if "." in name else tmp_path / "outside"
    )
    for use in (
        lambda: run_study(study, tmp_path / "study", on=Written(study, 1.0), progress=False),
        lambda: write_results(study, tmp_path / "study", tmp_path / "runs"),
    ):
        with pytest.raises(ValueError, match=f"{name} is a symbolic link"):
            use()
    assert list((tmp_path / "outside").iterdir()) == []


def test_the_runs_of_a_study_may_be_a_link_to_another_disk(tmp_path):
    study = Study(EXPERIMENT)
    (tmp_path / "study").mkdir()
    (tmp_path / "disk").mkdir()
    (tmp_path / "study" / "runs").symlink_to(tmp_path / "disk")
    result = run_study(study, tmp_path / "study", on=Written(study, 1.0), progress=False, results=False)
    assert state_of(tmp_path / "disk" / result.trials[0].name) == "finished"


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
            yield Outcome(task.name, "finished")


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


def test_a_study_runs_anew_what_was_made_with_other_code_and_keeps_what_was_there(
    tmp_path, write_module, capsys
):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    first = run_study(study, tmp_path / "study", on=Written(study, 1.0), results=False)
    kept = read_episodes(first.runs / only_name(study))
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
    assert read_episodes(earlier).equals(kept)
    assert str(earlier) in capsys.readouterr().out


def test_a_trial_that_another_process_makes_with_other_code_is_refused_by_its_directory(
    tmp_path, write_module
):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    run = write_run(tmp_path / "runs" / only_name(study), study.experiment, lambda *_: 1.0, is_finished=False)
    write_module("class Callback: apples = 2")
    with RunLock(run), pytest.raises(RunLockedError, match=only_name(study)):
        run_study(study, tmp_path, progress=False)


def test_a_recipe_without_a_checksum_of_code_is_taken_as_it_is(tmp_path, write_module):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    run = write_run(tmp_path / "runs" / only_name(study), study.experiment, lambda *_: 1.0, code=None)
    assert changed_circumstances(run) == []
    executor = Written(study, 2.0)
    run_study(study, tmp_path, on=executor, progress=False, results=False)
    assert executor.names == []


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
    run = cprl.run(experiment, tmp_path / "run", watch="off", figures=False)
    cprl.load(run, allow=[target])
    assert "own_callback" not in capsys.readouterr().err
    write_module(text + "# edited\n")
    for use in (
        lambda: cprl.load(run, allow=[target]),
        lambda: cprl.evaluate_run(run, episodes=1, allow=[target]),
        lambda: cprl.run(replace(experiment, episodes=3), run, resume=True, watch="off", figures=False),
    ):
        use()
        assert "own_callback" in capsys.readouterr().err
    recipe = json.loads((run / "recipe.json").read_text())
    assert set(recipe["code_text"].values()) == {text, text + "# edited\n"}
    assert recipe["code_text"][recipe["code"]["own_callback"]] == text
    assert recipe["code_text"][recipe["extended"][0]["code"]["own_callback"]] == text + "# edited\n"


@pytest.mark.integration
def test_a_study_runs_what_is_missing_and_an_edited_one_keeps_what_is_there(tmp_path):
    first = run_study(STUDY, tmp_path, results=False)
    assert first.failed == ()
    assert read_study(tmp_path) == STUDY
    reports = [tmp_path / "runs" / trial.name / "report.json" for trial in first.trials]
    before = [report.stat().st_mtime_ns for report in reports]
    edited = Study(TINY, {FREEZE: [5, 25, 50]}, name="edited")
    assert len(run_study(edited, tmp_path, results=False).trials) == 3
    assert [report.stat().st_mtime_ns for report in reports] == before
    assert read_study(tmp_path) == edited


@pytest.mark.integration
def test_studies_may_share_their_runs(tmp_path):
    run_study(STUDY, tmp_path / "a", runs=tmp_path / "pool", results=False)
    shared = run_study(Study(TINY, {FREEZE: [25, 30]}), tmp_path / "b", runs=tmp_path / "pool", results=False)
    assert shared.runs == tmp_path / "pool"
    assert len(list((tmp_path / "pool").iterdir())) == 3
    assert not (tmp_path / "b" / "runs").exists()


def test_a_part_of_a_study_is_chosen_by_whole_levels_and_not_by_parts_of_them():
    cells = "agents.*.algorithm.settings.hidden_cells"
    trials = trials_of(Study(TINY, {cells: [(32, 32), (32, 8, 32), (8, 32)], FREEZE: [2, 5]}))

    def chosen(*only):
        return [
            (own.condition.levels[cells], own.condition.levels[FREEZE]) for own in trials_with(trials, only)
        ]

    assert chosen("hidden_cells=(32, 32)") == [((32, 32), 2), ((32, 32), 5)]
    assert chosen("freeze_steps=5, hidden_cells=(32, 8, 32)") == [((32, 8, 32), 5)]
    assert chosen("hidden_cells=(8, 32), freeze_steps=2") == [((8, 32), 2)]
    named = trials_of(Study(TINY, conditions={"a (b, c": {}, "d), e": {FREEZE: 3}}))
    assert [own.condition.name for own in trials_with(named, ["a (b, c"])] == ["a (b, c"]
    assert [own.condition.name for own in trials_with(named, ["e"])] == ["d), e"]
    for part in ("32", "8, 32)", "", ", "):
        with pytest.raises(ValueError, match="allowed: a condition or levels of some"):
            trials_with(trials, [part])


@pytest.mark.integration
def test_a_study_varies_code_of_ones_own_and_a_process_that_knows_nothing_of_it_runs_it(tmp_path):
    fatigue = Custom("one_road_parts:Fatigue", arguments={"per_step": 0.5})
    study = Study(replace(TINY, transforms=(fatigue,)), {"transforms.0.arguments.per_step": [0.0, 0.5]})
    code = (
        "import pickle, sys; from cprl.studies.trials import run_task; "
        "print(run_task(pickle.load(sys.stdin.buffer)))"
    )
    sent = pickle.dumps(task(tmp_path, study, 1))
    command = [sys.executable, "-W", "ignore", "-c", code]
    told = subprocess.run(command, input=sent, capture_output=True, cwd="/", check=True).stdout.decode()
    assert "state='finished'" in told, told
    recipe = json.loads(next((tmp_path / "runs").glob("*/recipe.json")).read_text())
    assert recipe["experiment"]["transforms"][0]["arguments"] == {"per_step": 0.5}
