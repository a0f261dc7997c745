"""A search finds good values of factors, continues where it was stopped, and runs nothing twice."""

import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from tiny_study import FREEZE, GAMMA, TINY

from cprl.algorithms import PPO, RolloutSettings
from cprl.experimental.search import FOLDER, JOURNAL, Search, run_search, value_of
from cprl.population import Learning
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.runs.files import RunLock, RunLockedError
from cprl.studies import Integers, LogUniform, Uniform, read_study
from cprl.studies.trials import TrialOutcome, trials_of

optuna = pytest.importorskip("optuna")

ONE = replace(TINY, episodes=1)
RATE = "agents.*.algorithm.settings.learning_rate"
STEPS = "agents.*.algorithm.settings.rollout_steps"
SETTINGS = RolloutSettings(rollout_steps=20, minibatch_size=10)
PPO_ONE = replace(ONE, agents=(Learning(PPO(settings=SETTINGS)),) * 2)


class Counting:
    """Runs nothing: a finished run is whatever the test says it is worth; may be killed, and trials fail."""

    def __init__(self, most=10**6, fails=()):
        self.names, self.most, self.fails = [], most, fails

    def run(self, tasks):
        for task in tasks:
            experiment = task.recipe["experiment"]
            if experiment["game"]["rules"]["freeze_steps"] in self.fails:
                yield TrialOutcome(task.name, "failed", "ValueError: no", True)
                continue
            if not task.directory.exists():
                task.directory.mkdir(parents=True)
                (task.directory / "recipe.json").write_text(json.dumps(task.recipe))
                (task.directory / "report.json").write_text("{}")
                self.names.append(task.name)
            yield TrialOutcome(task.name, "finished", worked=True)
            if len(self.names) == self.most:
                raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def worth(monkeypatch):
    """The best time-out is 40."""

    def value(search, point, runs):
        trials = [] if point.reason else trials_of(search.study_of([point]))
        if not trials or not (runs / trials[0].name).exists():
            return None
        return -abs(trials[0].experiment.game.rules.freeze_steps - 40.0)

    monkeypatch.setattr("cprl.experimental.search.value_of", value)


def a_search(points=12, **options):
    return Search(ONE, {FREEZE: Integers(0, 1000), GAMMA: [0.5, 0.9]}, points=points, **options)


def in_words(result):
    return [(point.number, point.name, point.value) for point in result.points]


def stored_in(out):
    """What Optuna's own tools read in the directory of a search."""
    backend = optuna.storages.journal.JournalFileBackend(str(out / FOLDER / JOURNAL))
    return optuna.load_study(study_name=None, storage=optuna.storages.JournalStorage(backend))


def searched(search, out, executor=None):
    return run_search(search, out, on=executor or Counting(), progress=False, results=False)


@pytest.mark.integration
def test_points_get_better_and_are_the_same_again(tmp_path):
    first = searched(a_search(28), tmp_path / "a")
    again = searched(a_search(13), tmp_path / "b")
    assert in_words(first)[:12] == in_words(again)[:12], "three whole batches"
    by_chance = np.mean([point.value for point in first.points[:10]])
    assert np.mean([point.value for point in first.points[-10:]]) > by_chance + 100
    assert first.ranked[0].value == max(point.value for point in first.points)


@pytest.mark.integration
def test_a_search_that_was_stopped_anywhere_runs_the_rest_alone(tmp_path):
    whole = Counting()
    undisturbed = searched(a_search(), tmp_path / "whole", whole)
    names = []
    for most in (1, 5, 3):
        killed = Counting(most)
        with pytest.raises(KeyboardInterrupt):
            searched(a_search(), tmp_path / "killed", killed)
        names += killed.names
        (tmp_path / "killed" / "study.json").unlink()
    executor = Counting()
    done = searched(a_search(), tmp_path / "killed", executor)
    assert in_words(done) == in_words(undisturbed)
    assert names + executor.names == whole.names, "each once, in the same order"
    longer = Counting()
    assert len(searched(a_search(16), tmp_path / "killed", longer).points) == 16
    assert len(longer.names) == 4, "more points continue a search"


def test_a_search_that_was_stopped_while_it_proposed_a_point_continues(tmp_path):
    class Stopped(optuna.samplers.RandomSampler):
        def sample_independent(self, study, trial, name, distribution):
            if trial.number == 2 and name == GAMMA:
                raise KeyboardInterrupt
            return super().sample_independent(study, trial, name, distribution)

    def stopping(seed):
        return Stopped(seed=seed)

    with pytest.raises(KeyboardInterrupt):
        searched(a_search(6, sampler=stopping), tmp_path)
    result = searched(a_search(6, sampler=stopping), tmp_path)
    assert [point.number for point in result.points] == [0, 1, 3, 4, 5]


def test_an_edited_search_begins_anew_and_finds_the_runs_that_are_there(tmp_path):
    few = Search(ONE, {FREEZE: [30, 50]}, points=8, sampler="random")
    searched(few, tmp_path)
    executor = Counting()
    more = searched(replace(few, factors={FREEZE: [30, 50, 80]}), tmp_path, executor)
    assert len(more.points) == 8
    assert len(executor.names) == 1
    with RunLock(tmp_path / FOLDER), pytest.raises(RunLockedError):
        searched(few, tmp_path)


def test_points_that_come_twice_are_run_once_and_read_by_optunas_own_tools_and_as_a_study(tmp_path):
    executor = Counting()
    result = searched(Search(ONE, {FREEZE: [30, 50, 80]}, points=12), tmp_path, executor)
    assert len(executor.names) == len(set(executor.names)) <= 3
    assert len(result.points) == 12
    assert {point.value for point in result.points if point.name == "freeze_steps=30"} == {-10.0}
    assert len(result.study.all_conditions) == len(result.ranked) == len(executor.names)
    trials = stored_in(tmp_path).trials
    assert [trial.value for trial in trials] == [point.value for point in result.points]
    assert [trial.params for trial in trials] == [point.levels for point in result.points]
    assert read_study(tmp_path) == result.study


@pytest.mark.integration
def test_levels_that_the_experiment_refuses_together_are_not_run_and_keep_the_reason(tmp_path):
    every = {"update_every": [1, 2, 3], STEPS: [20, 30]}  # 3 does not divide 20
    executor = Counting()
    search = Search(PPO_ONE, every, points=12, at_once=12, sampler="random")
    result = searched(search, tmp_path, executor)
    refused = [point for point in result.points if point.reason]
    assert {point.name for point in refused} == {"update_every=3, rollout_steps=20"}
    assert {point.value for point in refused} == {None}
    assert value_of(search, refused[0], result.runs) is None
    assert all("update_every is 3; it must divide" in point.reason for point in refused)
    assert len(result.points) == 12
    assert len(result.study.all_conditions) == len(executor.names) == 5
    reasons = [trial.user_attrs.get("reason", "") for trial in stored_in(tmp_path).trials]
    assert reasons == [point.reason for point in result.points]


@pytest.mark.integration
def test_a_search_begins_with_the_first_points_that_fit_and_is_refused_where_none_does(tmp_path):
    class Proposes(optuna.samplers.RandomSampler):
        """Three points that do not fit, then one that does."""

        def sample_independent(self, study, trial, name, distribution):
            return {"update_every": 3, STEPS: "20" if trial.number < 3 else "30"}[name]

    search = Search(
        PPO_ONE,
        {"update_every": Integers(1, 3), STEPS: [20, 30]},
        points=4,
        at_once=2,
        sampler=lambda seed: Proposes(),
    )
    result = searched(search, tmp_path / "a")
    assert [bool(point.reason) for point in result.points] == [True, True, True, False]
    with pytest.raises(ValueError, match=r"none of the search's 3 points fits"):
        searched(replace(search, points=3), tmp_path / "b")
    for seed in range(4):
        Search(replace(PPO_ONE, seed=seed), {"update_every": [3], STEPS: [20, 30]}, points=1)
    with pytest.raises(ValueError, match="update_every is 3"):
        Search(PPO_ONE, {"update_every": [3], STEPS: [20]}, points=1)


def test_named_levels_and_the_lowest_value(tmp_path):
    factors = {"stay out": {"briefly": {FREEZE: 1}, "long": {FREEZE: 500}}, GAMMA: Uniform(0.5, 0.9)}
    result = searched(Search(ONE, factors, points=6, direction="minimise", sampler="random"), tmp_path)
    assert result.ranked[0].value == -460.0
    assert result.ranked[0].name.startswith("stay out=long, gamma=0.")


def test_what_has_failed_has_no_value_and_is_tried_again_next_time(tmp_path):
    few = Search(ONE, {FREEZE: [30, 50]}, points=8, sampler="random")
    result = searched(few, tmp_path, Counting(fails=[50]))
    assert {outcome.reason for outcome in result.failed} == {"ValueError: no"}
    values = {point.name: point.value for point in result.points}
    assert values == {"freeze_steps=30": -10.0, "freeze_steps=50": None}
    assert [point.name for point in result.ranked] == ["freeze_steps=30"]
    mended = searched(few, tmp_path)
    assert not mended.failed
    assert {point.value for point in mended.points} == {-10.0}
    assert len(mended.points) == 8


def test_a_search_all_of_whose_points_fail_tries_each_once(tmp_path):
    class Failing(Counting):
        def run(self, tasks):
            self.names += [task.name for task in tasks]
            yield from super().run(tasks)

    few = Search(ONE, {FREEZE: [30, 50]}, points=4, sampler="random")
    executor = Failing(fails=[30, 50])
    result = searched(few, tmp_path, executor)
    assert len(executor.names) == len(set(executor.names)) == len(result.failed) == 2
    assert {point.value for point in result.points} == {None}


def test_a_lock_of_optunas_that_a_killed_process_left_holds_nobody_up(tmp_path, monkeypatch):
    searched(a_search(2), tmp_path)
    lock = tmp_path / FOLDER / f"{JOURNAL}.lock"
    lock.touch()
    monkeypatch.setattr("time.sleep", lambda _: pytest.fail("Optuna waits for the lock"))
    assert len(searched(a_search(3), tmp_path).points) == 3
    assert not lock.exists()


@pytest.mark.integration
def test_a_value_is_the_mean_over_replicas_of_the_episodes_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.experimental.search.value_of", value_of)
    experiment = replace(ONE, episodes=4, replicas=2, evaluation_episodes=3)
    search = Search(experiment, {RATE: LogUniform(1e-4, 1e-3)}, points=1, block=1)
    result = run_search(search, tmp_path, progress=False)
    assert (tmp_path / "summary.md").exists()
    runs = [result.runs / trial.name for trial in result.trials]
    assert len(runs) == 2
    played = [as_curves(read_table(run / "evaluation" / "trained.parquet")) for run in runs]
    harvests = [curves["collective_return"] for curves in played]  # [1, 3] each
    assert result.points[0].value == pytest.approx(sum(harvest.sum() for harvest in harvests) / 6)
    last = replace(search, metric="agent_1/return", over="training", last=2)
    trained = [curves_of(run)["return_1"][0, 2:] for run in runs]
    assert value_of(last, result.points[0], result.runs) == pytest.approx(np.mean(trained))
    net = sum((curves["return_0"] + curves["return_1"]).sum() for curves in played) / 6
    assert value_of(replace(search, metric="income"), result.points[0], result.runs) == pytest.approx(net)
    shutil.rmtree(runs[1])
    assert value_of(search, result.points[0], result.runs) is None


def test_what_cannot_be_searched_is_refused_and_without_optuna_a_sentence_names_the_extra(
    tmp_path, monkeypatch
):
    for name, value, message in (
        *((name, 0, f"{name} is 0") for name in ("points", "at_once", "replicas")),
        *((name, "up", f"{name} is 'up'") for name in ("metric", "direction", "over", "sampler")),
        ("metric", "return_2", "metric is 'return_2'"),
        ("factors", {"game.rules.freeze": [1]}, "matches nothing"),
        ("factors", {FREEZE: Uniform(0.1, 0.2)}, "freeze_steps"),
        ("factors", {}, "draws is given without factors"),
    ):
        with pytest.raises(ValueError, match=message):
            Search(ONE, **{"factors": {FREEZE: [1, 2]}, "points": 2, name: value})
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[optuna\]"'):
        run_search(a_search(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.integration
@pytest.mark.parametrize("sampler", ["random", "gp", lambda seed: optuna.samplers.RandomSampler(seed=seed)])
def test_other_samplers_propose_the_same_points_again_too(tmp_path, sampler):
    first, again = (in_words(searched(a_search(6, sampler=sampler), tmp_path / name)) for name in "ab")
    assert first == again
