"""A search finds good values of factors, goes on where it was stopped, and runs nothing twice."""

import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from tiny_study import FREEZE, GAMMA, TINY

from cprl.algorithms import PPO, RolloutSettings
from cprl.commands.studies import SweepOptions, wanted
from cprl.population import Learning
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.studies import Integers, LogUniform, Search, Uniform, read_study, run_search
from cprl.studies.search import FILE_NAME, JOURNAL, value_of
from cprl.studies.trials import Outcome, trials_of

optuna = pytest.importorskip("optuna")

ONE = replace(TINY, episodes=1)
RATE = "agents.*.algorithm.settings.learning_rate"


class Counting:
    """Runs nothing: a finished run is whatever the test says it is worth."""

    def __init__(self):
        self.run_so_far = []

    def run(self, tasks):
        for task in tasks:
            if not task.directory.exists():
                task.directory.mkdir(parents=True)
                (task.directory / "report.json").write_text(json.dumps(task.recipe["experiment"]))
                self.run_so_far.append(task.name)
            yield Outcome(task.name, "finished", worked=True)


def rules_of(run):
    return json.loads((run / "report.json").read_text())["game"]["rules"]


@pytest.fixture
def worth(monkeypatch):
    """The best time-out is 40."""

    def value(search, point, runs):
        if point.reason:
            return None
        (trial,) = search_trials(search, point)
        run = runs / trial.name
        return -abs(rules_of(run)["freeze_steps"] - 40.0) if run.exists() else None

    monkeypatch.setattr("cprl.studies.search.value_of", value)


def search_trials(search, point):
    return trials_of(search.study_of([replace(point, is_repeated=False)]))


def a_search(points=12, **how):
    return Search(ONE, {FREEZE: Integers(0, 1000), GAMMA: [0.5, 0.9]}, points=points, **how)


def in_words(result):
    return [(point.number, point.name, point.value, point.is_repeated) for point in result.points]


def searched(search, out, executor=None):
    """The search, carried out by a counting executor."""
    return run_search(search, out, on=executor or Counting(), progress=False)


@pytest.mark.integration
def test_points_get_better_and_are_the_same_again(tmp_path, worth):
    first = searched(a_search(28), tmp_path / "a")
    again = searched(a_search(13), tmp_path / "b")
    assert in_words(first)[:12] == in_words(again)[:12], "three whole batches"
    by_chance = np.mean([own.value for own in first.points[:10]])
    assert np.mean([own.value for own in first.points[-10:]]) > by_chance + 100
    assert first.ranked[0].value == max(own.value for own in first.points)


@pytest.mark.integration
def test_a_search_that_was_stopped_anywhere_runs_the_rest_alone(tmp_path, worth):
    class Killed(Counting):
        def run(self, tasks):
            for outcome in super().run(tasks):
                yield outcome
                if len(self.run_so_far) == self.most:
                    raise KeyboardInterrupt

    whole = Counting()
    undisturbed = searched(a_search(), tmp_path / "whole", whole)
    ran = []
    for most in (1, 5, 3):
        killed = Killed()
        killed.most = most
        with pytest.raises(KeyboardInterrupt):
            searched(a_search(), tmp_path / "killed", killed)
        ran += killed.run_so_far
        for name in (FILE_NAME, JOURNAL, "study.json"):  # nothing but the runs is needed
            (tmp_path / "killed" / name).unlink(missing_ok=True)
    last = Counting()
    done = searched(a_search(), tmp_path / "killed", last)
    assert in_words(done) == in_words(undisturbed)
    assert ran + last.run_so_far == whole.run_so_far, "each once, in the same order"


@pytest.mark.integration
def test_more_points_continue_a_search(tmp_path, worth):
    searched(a_search(8), tmp_path)
    more = Counting()
    longer = searched(a_search(12), tmp_path, more)
    assert len(more.run_so_far) == 4
    assert len(longer.points) == 12


def test_points_that_come_twice_are_run_once(tmp_path, worth):
    few = Search(ONE, {FREEZE: [30, 50, 80]}, points=12)
    executor = Counting()
    result = searched(few, tmp_path, executor)
    assert len(executor.run_so_far) == len(set(executor.run_so_far)) <= 3
    assert sum(own.is_repeated for own in result.points) == 12 - len(executor.run_so_far)
    assert {own.value for own in result.points if own.name == "freeze_steps=30"} == {-10.0}
    assert len(result.study.all_conditions) == len(executor.run_so_far)


STEPS = "agents.*.algorithm.settings.rollout_steps"
PPO_ONE = replace(
    ONE, agents=(Learning(PPO(settings=RolloutSettings(rollout_steps=20, minibatch_size=10))),) * 2
)


@pytest.mark.integration
def test_levels_that_the_experiment_refuses_together_are_kept_with_the_reason_and_the_search_goes_on(
    tmp_path, worth
):
    every = {"update_every": [1, 2, 3], STEPS: [20, 30]}  # 3 does not divide 20
    executor = Counting()
    search = Search(PPO_ONE, every, points=12, at_once=12, sampler="random")
    result = searched(search, tmp_path, executor)
    refused = [own for own in result.points if own.reason]
    assert {own.name for own in refused} == {"update_every=3, rollout_steps=20"}
    assert {own.value for own in refused} == {None}
    assert value_of(search, refused[0], result.runs) is None
    assert all("update_every is 3; it must divide" in own.reason for own in refused)
    assert len(result.points) == 12
    assert len(result.study.all_conditions) == len(executor.run_so_far) == 5
    table = json.loads((tmp_path / FILE_NAME).read_text())
    assert [own["reason"] for own in table["points"]] == [own.reason for own in result.points]


@pytest.mark.integration
def test_a_search_begins_with_the_first_points_that_fit_and_is_refused_where_none_does(tmp_path, worth):
    class Proposes(optuna.samplers.RandomSampler):
        """Three points that do not fit, then one that does."""

        def sample_independent(self, study, trial, name, distribution):
            return {"update_every": 3, STEPS: "20" if trial.number < 3 else "30"}[name]

    how = {"at_once": 2, "sampler": lambda seed: Proposes()}
    levels = {"update_every": Integers(1, 3), STEPS: [20, 30]}
    result = searched(Search(PPO_ONE, levels, points=4, **how), tmp_path / "a")
    assert [bool(own.reason) for own in result.points] == [True, True, True, False]
    with pytest.raises(ValueError, match=r"none of the search's 3 points fits; the first, .*must divide"):
        searched(Search(PPO_ONE, levels, points=3, **how), tmp_path / "b")
    assert not (tmp_path / "b").exists()


@pytest.mark.integration
def test_a_search_is_refused_only_where_no_levels_fit_together():
    for seed in range(4):
        Search(replace(PPO_ONE, seed=seed), {"update_every": [3], STEPS: [20, 30]}, points=1)
    with pytest.raises(ValueError, match="update_every is 3"):
        Search(PPO_ONE, {"update_every": [3], STEPS: [20]}, points=1)


def test_named_levels_and_the_lowest_value(tmp_path, worth):
    factors = {"stay out": {"briefly": {FREEZE: 1}, "long": {FREEZE: 500}}, GAMMA: Uniform(0.5, 0.9)}
    result = searched(Search(ONE, factors, points=6, direction="minimise", sampler="random"), tmp_path)
    assert result.ranked[0].value == -460.0
    assert result.ranked[0].name.startswith("stay out=long, gamma=0.")


def test_what_has_failed_is_told_as_failed_and_tried_again_next_time(tmp_path, worth):
    class Fails(Counting):
        def run(self, tasks):
            for task in tasks:
                if task.recipe["experiment"]["game"]["rules"]["freeze_steps"] == 50:
                    yield Outcome(task.name, "failed", "ValueError: no", True)
                else:
                    yield from super().run([task])

    few = Search(ONE, {FREEZE: [30, 50]}, points=8, sampler="random")
    result = searched(few, tmp_path, Fails())
    assert [own.reason for own in result.failed] == ["ValueError: no"]
    assert {own.name: own.value for own in result.points} == {
        "freeze_steps=30": -10.0,
        "freeze_steps=50": None,
    }
    assert [own.name for own in result.ranked] == ["freeze_steps=30"]
    mended = searched(few, tmp_path)
    assert not mended.failed
    assert {own.value for own in mended.points} == {-10.0}


def test_what_is_kept_is_read_by_optunas_own_tools_and_as_a_study(tmp_path, worth):
    result = searched(a_search(6), tmp_path)
    backend = optuna.storages.journal.JournalFileBackend(str(tmp_path / JOURNAL))
    kept = optuna.load_study(study_name="search", storage=optuna.storages.JournalStorage(backend))
    assert [own.value for own in kept.trials] == [own.value for own in result.points]
    assert read_study(tmp_path) == result.study
    table = json.loads((tmp_path / FILE_NAME).read_text())
    assert [own["value"] for own in table["points"]] == [own.value for own in result.points]
    assert not list(tmp_path.glob(".optuna*"))


@pytest.mark.integration
def test_a_value_is_the_mean_over_replicas_of_the_episodes_asked_for(tmp_path):
    experiment = replace(ONE, episodes=4, replicas=2, evaluation_episodes=3)
    factors = {RATE: LogUniform(1e-4, 1e-3)}
    search = Search(experiment, factors, points=1, block=1)
    result = run_search(search, tmp_path, progress=False)
    runs = [result.runs / trial.name for trial in result.trials]
    assert len(runs) == 2
    played = [as_curves(read_table(run / "evaluation" / "trained.parquet")) for run in runs]
    harvests = [own["collective_return"] for own in played]  # [1, 3] each
    assert result.points[0].value == pytest.approx(sum(own.sum() for own in harvests) / 6)
    last = Search(experiment, factors, points=1, block=1, metric="return_1", over="training", last=2)
    trained = [curves_of(run)["return_1"][0, 2:] for run in runs]
    assert value_of(last, result.points[0], result.runs) == pytest.approx(np.mean(trained))
    shutil.rmtree(runs[1])
    assert value_of(search, result.points[0], result.runs) is None


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"points": 0}, "points is 0"),
        ({"metric": "luck"}, "metric is 'luck'"),
        ({"metric": "return_2"}, "metric is 'return_2'"),
        ({"direction": "up"}, "direction is 'up'"),
        ({"over": "all"}, "over is 'all'"),
        ({"sampler": "magic"}, "sampler is 'magic'"),
        ({"at_once": 0}, "at_once is 0"),
        ({"replicas": 0}, "replicas is 0"),
        ({"factors": {"game.rules.freeze": [1]}}, "matches nothing"),
        ({"factors": {FREEZE: Uniform(0.1, 0.2)}}, "allowed: an integer"),
        ({"factors": {}}, "allowed: factors to draw from"),
    ],
)
def test_what_cannot_be_searched_is_refused(how, message):
    with pytest.raises(ValueError) as refused:  # noqa: PT011  (the message is the point)
        Search(ONE, **{"factors": {FREEZE: [1, 2]}, "points": 2, **how})
    assert message in str(refused.value)


def test_without_optuna_a_sentence_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cprl\[optuna\]"'):
        run_search(a_search(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_sweep_can_be_a_search():
    vary = (f"{FREEZE}=integers(1,9)", f"{GAMMA}=0.5,0.9")
    search = wanted(ONE, SweepOptions(vary=vary, search=7, minimise="peace", at_once=2, block=3))
    assert isinstance(search, Search)
    assert (search.points, search.metric, search.direction, search.at_once) == (7, "peace", "minimise", 2)
    assert search.factors == {FREEZE: Integers(1, 9), GAMMA: (0.5, 0.9)}


@pytest.mark.integration
@pytest.mark.parametrize("sampler", ["random", "gp", lambda seed: optuna.samplers.RandomSampler(seed=seed)])
def test_other_samplers_propose_the_same_points_again_too(tmp_path, worth, sampler):
    first, again = (in_words(searched(a_search(6, sampler=sampler), tmp_path / name)) for name in "ab")
    assert first == again
