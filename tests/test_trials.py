"""A trial becomes a finished run, whatever was there: nothing, half a run, a failure, another's lock."""

import json
import os
import shutil
import sys
from dataclasses import replace
from importlib import invalidate_caches
from types import SimpleNamespace

import pyarrow.compute as pc
import pytest
from same_runs import differences
from study_runs import EXPERIMENT, TIME_OUT, write_run
from tiny_study import FREEZE, TINY

import cprl
from cprl import Custom, Study, run_study
from cprl.runs.checkpoints import FOLDER as CHECKPOINTS
from cprl.runs.episodes import read_episodes
from cprl.runs.files import LOCK_FILE, RunLock, RunLockedError
from cprl.runs.recipe import changed_circumstances, start_run
from cprl.studies import Processes, read_study, run
from cprl.studies.results import write_results
from cprl.studies.run import trials_with
from cprl.studies.status import PATIENCE_S, Status
from cprl.studies.trials import Outcome, Task, state_of, trials_of
from cprl.training import running

STUDY = Study(TINY, {FREEZE: [5, 25]})


def task_in(folder, study=STUDY, place=0):
    trial = trials_of(study)[place]
    return Task(trial=trial, runs=folder / "runs", status=Status(folder / "status", trial.name))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run of the first trial."""
    first = task_in(tmp_path_factory.mktemp("undisturbed"))
    assert first.run_here().worked
    return first.directory


def written_at(folder):
    """When all files of a folder were written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


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
    assert missing.run_here() == Outcome(missing.name, "finished", worked=True)
    assert capsys.readouterr().out == ""
    assert "tiny, 1 replicas, 2 episodes" in missing.status.log.read_text()
    status = missing.status.read()
    assert (status["episodes"], status["of"], status["steps"], status["pid"]) == (2, 2, 40, os.getpid())
    assert status["peak_bytes"] > 10**7
    assert not list(tmp_path.rglob("*.partial"))
    before = written_at(missing.directory)
    assert missing.run_here() == Outcome(missing.name, "finished", worked=False)
    assert written_at(missing.directory) == before


@pytest.mark.integration
def test_what_a_killed_process_left_before_its_recipe_is_no_obstacle(first, undisturbed):
    (first.directory / "recipe.json.0123abcd.partial").write_text("{")
    (first.directory / LOCK_FILE).write_text("")
    assert first.run_here().state == "finished"
    assert differences(first.directory, undisturbed) == []


@pytest.mark.integration
def test_a_trial_that_was_killed_before_its_first_checkpoint_starts_over(first, undisturbed):
    ended = ("report.json", "manifest.json", "episodes.parquet", CHECKPOINTS, "evaluation")
    shutil.copytree(undisturbed, first.directory, ignore=shutil.ignore_patterns(*ended), dirs_exist_ok=True)
    assert state_of(first.directory) == "unfinished"
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
        assert first.run_here() == Outcome(first.name, "elsewhere")
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
        assert state_of(directory) == "unfinished"
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
    first, second = trials_of(study)
    other = replace(first.experiment, **changes) if changes else second.experiment
    directory = write_run(tmp_path / "runs" / first.name, other, lambda *_: 1, is_finished=is_finished)
    assert first.state(tmp_path / "runs") == "refused"
    before = written_at(directory)
    result = run_study(study, tmp_path, only=["freeze_steps=5"], progress=False)
    (failed,) = result.failed
    assert failed.name == first.name
    assert place in failed.reason
    assert written_at(directory) == before
    assert result.table is None


def test_a_finished_run_with_fewer_episodes_is_another_trial_and_an_unfinished_one_is_continued(tmp_path):
    (trial,) = trials_of(Study(EXPERIMENT))
    shorter = replace(trial.experiment, episodes=30)
    for state in ("finished", "unfinished"):
        write_run(tmp_path / state / trial.name, shorter, lambda *_: 1, is_finished=state == "finished")
    assert trial.state(tmp_path / "finished") == "refused"
    assert trial.state(tmp_path / "unfinished") == "unfinished"


def test_a_finished_trial_that_lost_a_file_of_its_manifest_is_a_failure_by_that_file(tmp_path):
    study = Study(EXPERIMENT)
    (trial,) = trials_of(study)
    directory = write_run(tmp_path / "runs" / trial.name, trial.experiment, lambda *_: 1)
    (directory / "evaluation" / "trained.parquet").unlink()
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


def test_a_trial_that_another_process_makes_with_other_code_is_refused_by_its_directory(
    tmp_path, write_module
):
    study = Study(OWN_CODE)
    write_module("class Callback: ...")
    name = only_name(study)
    run = write_run(tmp_path / "runs" / name, study.experiment, lambda *_: 1.0, is_finished=False)
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
            (trial.condition.levels[cells], trial.condition.levels[FREEZE])
            for trial in trials_with(trials, only)
        ]

    assert chosen("hidden_cells=(32, 32)") == [((32, 32), 2), ((32, 32), 5)]
    assert chosen("freeze_steps=5, hidden_cells=(32, 8, 32)") == [((32, 8, 32), 5)]
    assert chosen("hidden_cells=(8, 32), freeze_steps=2") == [((8, 32), 2)]
    named = trials_of(Study(TINY, conditions={"a (b, c": {}, "d), e": {FREEZE: 3}}))
    assert [trial.condition.name for trial in trials_with(named, ["a (b, c"])] == ["a (b, c"]
    assert [trial.condition.name for trial in trials_with(named, ["e"])] == ["d), e"]
    for part in ("32", "8, 32)", "", ", "):
        with pytest.raises(ValueError, match="allowed: a condition or levels of some"):
            trials_with(trials, [part])


@pytest.mark.integration
def test_a_study_varies_code_of_ones_own_and_processes_import_it_from_where_this_one_does(tmp_path):
    fatigue = Custom("one_road_parts:Fatigue", arguments={"per_step": 0.5})
    study = Study(replace(TINY, transforms=(fatigue,)), {"transforms.0.arguments.per_step": [0.0, 0.5]})
    result = run_study(study, tmp_path, on=Processes(1), only=["per_step=0.5"], results=False)
    assert not result.failed
    recipe = json.loads(next(result.runs.glob("*/recipe.json")).read_text())
    assert recipe["experiment"]["transforms"][0]["arguments"] == {"per_step": 0.5}
