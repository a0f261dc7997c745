"""The table of a study: from small runs whose numbers are known, to every row, mark and gap of it."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from study_runs import EXPERIMENT, TIME_OUT, with_seed, write_run, write_study

from cprl import Study
from cprl.runs.recipe import runs_in, write_changed_circumstances
from cprl.studies.status import Status
from cprl.studies.tables.pooled import pooled_table
from cprl.studies.tables.sources import circumstances_of, design_of, study_table
from cprl.studies.tables.table import METADATA, StudyTable
from cprl.studies.trials import trials_of

STUDY = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="small", replicas=3, block=2)
NAN = float("nan")


def harvest(condition, replica, number):
    """10 apples for each turn of time-out, 100 for each replica and one for each episode."""
    return 10 * condition.levels[TIME_OUT] + 100 * replica + number


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return write_study(STUDY, tmp_path_factory.mktemp("runs"), harvest)


def rows_of(table, **wanted):
    """The rows that have these values, as dictionaries."""
    return [row for row in table.rows.to_pylist() if wanted.items() <= row.items()]


def made_under(folder, *circumstances):
    """The table of three conditions whose runs were made under these, and the names of their trials."""
    study = Study(EXPERIMENT, {TIME_OUT: [5, 25, 100]}, name="mixed")
    trials = trials_of(study)
    for trial, how in zip(trials, circumstances, strict=True):
        write_run(folder / trial.name, trial.experiment, lambda *_: 1, **how)
    return study_table(study, folder), [trial.name for trial in trials]


def test_a_row_is_a_window_of_a_metric_of_a_replica_under_a_condition(runs):
    table = study_table(STUDY, runs)
    found = rows_of(
        table, condition="freeze_steps=25", replica=2, part="training", metric="collective_return"
    )
    # Replica 2 is the first of the second block. 250 + 200 + the mean of 0..9 is 454.5, of 10..19 464.5.
    assert [(row["episode"], row["window_episodes"], row["value"]) for row in found] == [
        (0, 10, 454.5),
        (10, 10, 464.5),
        (20, 10, 474.5),
        (30, 10, 484.5),
    ]
    trial = trials_of(STUDY)[-1]
    assert (trial.block.first, trial.condition.name) == (2, "freeze_steps=25")
    assert {(row["run"], row["checksum"], row[TIME_OUT]) for row in found} == {
        (trial.name, trial.condition.checksum, 25)
    }
    assert table.rows.schema.field(TIME_OUT).type == "int64"
    for part, value in (("evaluation", 50 + 100 - 1), ("random", 4)):
        (row,) = rows_of(table, condition="freeze_steps=5", replica=1, part=part, metric="collective_return")
        assert (row["episode"], row["window_episodes"], row["value"]) == (0, 3, value)


def test_episodes_stand_one_by_one_on_request_and_the_last_window_may_be_shorter(runs):
    wanted = {"condition": "freeze_steps=5", "replica": 0, "metric": "collective_return"}
    found = rows_of(study_table(STUDY, runs, window=1), **wanted)
    assert [own["value"] for own in found if own["part"] == "training"] == [50.0 + n for n in range(40)]
    assert [own["value"] for own in found if own["part"] == "evaluation"] == [49.0] * 3
    found = rows_of(study_table(STUDY, runs, window=15), **wanted, part="training")
    # The last of 15, 15 and 10 episodes: 50 + the mean of 30..39.
    assert [(own["episode"], own["window_episodes"]) for own in found] == [(0, 15), (15, 15), (30, 10)]
    assert found[-1]["value"] == 84.5


def test_the_same_runs_give_the_same_file_to_the_bit_and_it_can_be_read_back(runs, tmp_path):
    table = study_table(STUDY, runs)
    paths = [
        each.write(tmp_path / name)
        for name, each in {"a.parquet": table, "b.parquet": study_table(STUDY, runs)}.items()
    ]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    again = StudyTable.read(paths[0])
    assert str(again) == str(table)
    assert (again.design, again.made, again.window) == (table.design, table.made, 10)
    keys = table.rows.select(["condition", "replica", "part", "metric", "episode"])
    assert keys.group_by(keys.column_names).aggregate([]).num_rows == len(table.rows), "no row twice"
    metadata = json.loads(pq.read_schema(paths[0]).metadata[METADATA])
    assert metadata["design"]["name"] == "small"
    assert metadata["versions"]["numpy"] == np.__version__


def test_a_file_that_is_no_table_of_a_study_is_refused(runs, tmp_path):
    for path in (next(runs.iterdir()) / "episodes.parquet", tmp_path / "none.parquet"):
        with pytest.raises(ValueError, match=f"{path.name} is not the table of a study"):
            StudyTable.read(path)


def test_episodes_in_which_a_metric_is_undefined_are_counted_and_no_part_of_a_mean(tmp_path):
    study = Study(EXPERIMENT, name="one")
    write_study(study, tmp_path, lambda *_: 3, equality=lambda replica, n: NAN if n < 12 else n / 10)
    table = study_table(study, tmp_path)
    found = rows_of(table, replica=0, part="training", metric="equality")
    assert [own["undefined"] for own in found] == [10, 2, 0, 0]
    assert np.isnan(found[0]["value"])
    assert found[1]["value"] == pytest.approx((1.2 + 1.9) / 2)  # of episodes 12 to 19


def test_what_is_not_finished_is_named_and_not_part_of_the_table(runs, tmp_path):
    unfinished, finished, failed, _ = trials_of(STUDY)
    write_run(tmp_path / unfinished.name, unfinished.experiment, lambda *_: 1, is_finished=False)
    write_run(tmp_path / finished.name, finished.experiment, lambda *_: 1)
    (tmp_path / "status").mkdir()
    Status(tmp_path / "status", failed.name).fail("ValueError: too hot", "trace")
    table = study_table(STUDY, tmp_path, status=tmp_path / "status")
    assert dict(table.replicas) == {"freeze_steps=5": 0, "freeze_steps=25": 2}
    reasons = {(lacking.condition, lacking.replicas): lacking.reason for lacking in table.lacking}
    assert reasons == {
        ("freeze_steps=5", 2): "has not ended",
        ("freeze_steps=5", 1): "failed: ValueError: too hot",
        ("freeze_steps=25", 1): "was not begun",
    }
    assert "small: 2 replicas of 1 of 2 conditions" in str(table)
    assert "3 runs are not in it" in str(table)
    assert all(str(lacking) in str(table) for lacking in table.lacking)


def test_two_trials_whose_directories_were_swapped_are_named_and_not_part_of_the_table(tmp_path):
    write_study(STUDY, tmp_path, harvest)
    one, other = (trial.name for trial in trials_of(STUDY)[:2])
    (tmp_path / one).rename(tmp_path / "aside")
    (tmp_path / other).rename(tmp_path / one)
    (tmp_path / "aside").rename(tmp_path / other)
    table = study_table(STUDY, tmp_path)
    assert {lacking.name for lacking in table.lacking} == {one, other}
    assert not {one, other} & set(table.rows["run"].to_pylist())


def test_a_study_none_of_whose_runs_is_there_has_an_empty_table(tmp_path):
    table = study_table(STUDY, tmp_path)
    assert (len(table.rows), table.metrics, len(table.lacking)) == (0, (), 4)
    assert len(StudyTable.read(table.write(tmp_path / "table.parquet")).rows) == 0


@pytest.mark.parametrize("name", ["episodes.parquet", "evaluation/trained.parquet"])
def test_a_damaged_run_is_named_and_does_not_end_the_table(tmp_path, name):
    write_study(STUDY, tmp_path, harvest)
    broken = trials_of(STUDY)[0]
    (tmp_path / broken.name / name).write_bytes(b"PAR1")
    table = study_table(STUDY, tmp_path)
    (lacking,) = table.lacking
    assert lacking.name == broken.name
    assert lacking.reason.startswith("is damaged: ")
    assert broken.name not in table.rows["run"].to_pylist()


def test_a_run_with_fewer_episodes_than_its_experiment_is_named(tmp_path):
    study = Study(EXPERIMENT, name="one")
    (trial,) = trials_of(study)
    run = write_run(tmp_path / trial.name, replace(trial.experiment, episodes=20), lambda *_: 1)
    recipe = json.loads((run / "recipe.json").read_text())
    recipe["experiment"]["episodes"] = 40
    (run / "recipe.json").write_text(json.dumps(recipe))
    (lacking,) = study_table(study, tmp_path).lacking
    assert r"episodes by replica in training: {0: 20, 1: 20}; allowed: 40 of each" in lacking.reason


def test_runs_of_other_versions_commits_and_processors_are_marked_and_named_in_a_sentence(tmp_path):
    def how(torch="2.13.0", *, dirty=False):
        versions = {"python": "3.11.7", "torch": torch}
        return {"versions": versions, "git": {"commit": "ab" * 20, "dirty": dirty}, "cpu": "Xeon"}

    table, names = made_under(tmp_path, how(), how("2.14.0"), how(dirty=True))
    more = "The runs were made under more than one"
    assert table.mixed == [
        f"{more} version of torch: 2.13.0 in 2 runs; 2.14.0 in 1 run ({names[1]}).",
        f"{more} git commit: abababababab in 2 runs; abababababab with changes in 1 run ({names[2]}).",
    ]
    marks = dict(zip(table.rows["run"].to_pylist(), table.rows["marks"].to_pylist(), strict=True))
    assert marks == {names[0]: "", names[1]: "torch", names[2]: "git commit"}
    assert all(sentence in str(table) for sentence in table.mixed)


def test_a_run_that_was_resumed_under_other_versions_is_marked(tmp_path):
    how = {"versions": {"torch": "2.13.0"}, "git": None, "cpu": "Xeon"}
    table, _ = made_under(tmp_path, how, how, {**how, "resumed": [{**how, "cpu": "Epyc"}]})
    (sentence,) = table.mixed
    assert "more than one processor: Xeon in 2 runs; Xeon then Epyc in 1 run" in sentence


def test_a_recipe_records_each_time_it_is_resumed_under_other_circumstances(tmp_path, monkeypatch):
    run = write_run(
        tmp_path / "run", EXPERIMENT, lambda *_: 1, versions={"torch": "2.0"}, git=None, cpu="Xeon"
    )
    for versions in ("2.1", "2.1", "2.2"):
        now = {"versions": {"torch": versions}, "git": None, "cpu": "Xeon"}
        monkeypatch.setattr("cprl.runs.recipe._circumstances", lambda recipe, now=now: now)
        write_changed_circumstances(run)
    resumed = json.loads((run / "recipe.json").read_text())["resumed"]
    assert [own["versions"]["torch"] for own in resumed] == ["2.1", "2.2"]
    assert circumstances_of(run) == {"torch": "2.0 then 2.1 then 2.2", "cpu": "Xeon"}


def test_levels_that_are_no_numbers_are_texts_and_a_column_has_no_name_twice(tmp_path):
    study = Study(
        EXPERIMENT,
        {
            "metric": {"short": {TIME_OUT: 5}, "long": {TIME_OUT: 25}},
            "game.rules.regrow_prob": [(0.0, 0.1), (0.0, 0.2)],
        },
        name="texts",
    )
    table = study_table(study, write_study(study, tmp_path, lambda *_: 1))
    assert set(table.rows["factor metric"].to_pylist()) == {"short", "long"}
    assert set(table.rows["game.rules.regrow_prob"].to_pylist()) == {"(0, 0.1)", "(0, 0.2)"}
    assert len(set(table.rows.column_names)) == len(table.rows.column_names)


def test_conditions_that_words_do_not_tell_apart_are_numbered_and_not_merged(tmp_path):
    agent = EXPERIMENT.agents[0]
    settings = replace(agent.algorithm.settings, gamma=0.5)
    other = replace(agent, algorithm=replace(agent.algorithm, settings=settings))
    study = Study(EXPERIMENT, {"agents": [(agent, agent), (other, other)]}, name="alike")
    checksums = [condition.checksum for condition in study.all_conditions]
    write_study(study, tmp_path, lambda condition, *_: checksums.index(condition.checksum))
    table = study_table(study, tmp_path)
    (first, levels), (second, other_levels) = table.design.conditions.items()
    assert second == f"{first} #2"
    assert other_levels["agents"] == f"{levels['agents']} #2"
    for place, name in enumerate((first, second)):
        rows = rows_of(table, condition=name, metric="collective_return", part="evaluation")
        assert [row["value"] for row in rows] == [place, place]


def test_a_condition_whose_name_ends_in_a_number_stays_itself():
    named = Study(EXPERIMENT, conditions={"beam #2": {TIME_OUT: 7}, "beam": {}})
    design = design_of(named)
    assert list(design.conditions) == ["beam #2", "beam"]
    assert design.reference == "beam"
    levels = Study(EXPERIMENT, {"size": {"beam #2": {TIME_OUT: 7}, "beam": {}}})
    assert [own["size"] for own in design_of(levels).conditions.values()] == ["beam #2", "beam"]
    agents = [[replace(EXPERIMENT.agents[0], reward=own)] * 2 for own in ("individual", "team")]
    design = design_of(Study(EXPERIMENT, {"agents": agents}))
    assert len({own["agents"] for own in design.conditions.values()}) == 2


# Any runs at hand


def at(time_out, seed, **changes):
    """The experiment with a time-out and a seed."""
    rules = replace(EXPERIMENT.game.rules, freeze_steps=time_out)
    return with_seed(EXPERIMENT, seed, game=replace(EXPERIMENT.game, rules=rules), **changes)


def test_any_runs_are_pooled_by_the_value_of_a_field_and_replicas_are_numbered_by_seed(tmp_path):
    for name, experiment in {"a": at(25, 1), "b": at(5, 1), "c": at(5, 9, replicas=3)}.items():
        write_run(tmp_path / name, experiment, lambda replica, n: 10 * replica)
    table = pooled_table([tmp_path], by=["game.rules.freeze-steps"])
    assert dict(table.replicas) == {"freeze_steps=5": 5, "freeze_steps=25": 2}
    assert table.rows[TIME_OUT].to_pylist()[0] == 5
    found = rows_of(table, condition="freeze_steps=5", part="evaluation", metric="collective_return")
    # Seed 1 has the replicas 0 and 1, seed 9 has 2 to 4; each has ten times its number in its run.
    assert [(own["replica"], own["value"]) for own in found] == [(0, 0), (1, 10), (2, 0), (3, 10), (4, 20)]
    assert not table.design.is_paired, "seed 9 is in one condition alone"
    assert pooled_table([tmp_path / "a", tmp_path / "b"], by=[TIME_OUT]).design.is_paired


def test_the_same_seed_twice_under_the_same_condition_is_refused_by_name(tmp_path):
    write_run(tmp_path / "a", at(5, 1), lambda *_: 1)
    write_run(tmp_path / "b", at(5, 1, episodes=20), lambda *_: 1)
    with pytest.raises(ValueError, match=r"a and .*b have the same seed, 1, .* they differ in episodes"):
        pooled_table([tmp_path], by=[TIME_OUT])
    assert len(pooled_table([tmp_path], by=[TIME_OUT, "episodes"]).design.conditions) == 2


def test_what_pooled_runs_and_conditions_differ_in_beside_is_said(tmp_path):
    write_run(tmp_path / "a", at(5, 1), lambda *_: 1)
    write_run(tmp_path / "b", at(5, 2, update_every=2), lambda *_: 1)
    write_run(tmp_path / "c", at(25, 1, episodes=20), lambda *_: 1)
    text = str(pooled_table([tmp_path], by=[TIME_OUT]))
    assert "The runs pooled as freeze_steps=5 also differ in update_every." in text
    assert "The conditions also differ in episodes." in text


def test_runs_that_have_not_ended_are_named_there_too(tmp_path):
    write_run(tmp_path / "a", at(5, 1), lambda *_: 1)
    write_run(tmp_path / "b", at(25, 1), lambda *_: 1, is_finished=False)
    table = pooled_table([tmp_path / "a", tmp_path / "b"], by=[TIME_OUT])
    assert dict(table.replicas) == {"freeze_steps=5": 2, "freeze_steps=25": 0}
    assert [own.reason for own in table.lacking] == ["has not ended"]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"by": ["game.rules.freez_steps"]}, "did you mean 'freeze_steps'"),
        ({"by": ["seed"]}, "by is 'seed'"),
        ({"by": ["name", "name"]}, "each once"),
        ({"by": ["name"], "reference": "x"}, "reference is 'x'"),
        ({"by": ["name"], "window": 0}, "window is 0"),
    ],
)
def test_runs_are_not_pooled_by_what_does_not_fit(tmp_path, how, message):
    write_run(tmp_path / "a", EXPERIMENT, lambda *_: 1)
    with pytest.raises(ValueError, match=message):
        pooled_table([tmp_path / "a"], **how)


def test_a_path_that_is_no_run_and_a_run_that_is_given_twice_are_refused(tmp_path):
    run = write_run(tmp_path / "a", EXPERIMENT, lambda *_: 1)
    (tmp_path / "none").mkdir()
    for paths, message in (([tmp_path / "none"], "none is no run"), ([run, tmp_path], "a is there twice")):
        with pytest.raises(ValueError, match=message):
            runs_in(paths)
