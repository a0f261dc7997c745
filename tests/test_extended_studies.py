"""A study of more episodes goes on from the runs of a shorter one that kept the state of its trainings."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_study import FREEZE, TINY

from cprl import Custom, Study, run_study
from cprl.runs.episodes import read_table
from cprl.studies.trials import begin_from_shorter, trials_of

pytestmark = pytest.mark.integration


def study_of(episodes):
    return Study(replace(TINY, episodes=episodes), {FREEZE: [2, 5]}, name="tiny")


def run_of(study, runs, place=0):
    return runs / trials_of(study)[place].name


def ran(study, out, runs, **options):
    result = run_study(study, out, runs=runs, progress=False, results=False, **options)
    assert not result.failed
    return result


def files_of(folder):
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def test_what_is_extended_equals_what_was_longer_from_the_first_episode_on(tmp_path):
    pool, apart = tmp_path / "pool", tmp_path / "apart"
    short, long = study_of(2), study_of(5)
    ran(short, tmp_path / "short", pool, keep_checkpoints=True)
    before = files_of(run_of(short, pool))
    ran(long, tmp_path / "long", pool)
    ran(long, tmp_path / "again", apart)
    for place in (0, 1):
        extended, whole = run_of(long, pool, place), run_of(long, apart, place)
        assert (extended / "evaluation-2").is_dir(), "it went on from the shorter one"
        assert not (whole / "evaluation-2").exists()
        for name in ("episodes.parquet", "evaluation/trained.parquet", "evaluation/random.parquet"):
            one, other = (repr(read_table(run / name).to_pydict()) for run in (extended, whole))  # with NaN
            assert one == other, name
    assert files_of(run_of(short, pool)) == before
    assert [path.name for path in pool.iterdir() if path.name.startswith(".")] == []


def test_it_goes_on_from_the_longest_and_keeps_its_own_state_only_if_asked(tmp_path):
    pool = tmp_path / "pool"
    for episodes in (2, 3):
        ran(study_of(episodes), tmp_path / "study", pool, only=["freeze_steps=2"], keep_checkpoints=True)
    ran(study_of(4), tmp_path / "study", pool, only=["freeze_steps=2"])
    assert (run_of(study_of(4), pool) / "evaluation-3").is_dir()
    ran(study_of(5), tmp_path / "study", pool, only=["freeze_steps=2"])
    evaluations = sorted(path.name for path in run_of(study_of(5), pool).glob("evaluation-*"))
    assert evaluations == ["evaluation-2", "evaluation-3"], "the one of 4 episodes kept no state"


def test_runs_that_kept_nothing_or_differ_are_no_beginning(tmp_path):
    pool = tmp_path / "pool"
    ran(study_of(2), tmp_path / "short", pool)
    ran(study_of(4), tmp_path / "long", pool)
    assert not (run_of(study_of(4), pool) / "evaluation-2").exists()
    other = Study(replace(TINY, episodes=2), {FREEZE: [9]}, name="tiny")
    ran(other, tmp_path / "other", pool, keep_checkpoints=True)
    ran(study_of(3), tmp_path / "more", pool)
    assert not list(run_of(study_of(3), pool).glob("evaluation-*"))


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
    assert begin_from_shorter(pool / trial.name, trial.experiment, recipe) is None
    assert len(list(pool.iterdir())) == 2


class SeesTheEnd:
    """What it does could depend on how long the training is to be."""

    def on_start(self, training):
        """Sees the number of episodes."""


def test_a_training_that_sees_how_long_it_is_to_be_begins_anew(tmp_path):
    pool = tmp_path / "pool"
    for episodes in (2, 4):
        watched = replace(TINY, episodes=episodes, callbacks=(Custom(f"{__name__}:SeesTheEnd"),))
        ran(Study(watched, name="tiny"), tmp_path / "study", pool, keep_checkpoints=True)
    assert len(list(pool.iterdir())) == 2
    assert not list(pool.glob("*/evaluation-2"))


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
