"""What comes out of a study: table, means, differences, phases, figures, summary; numbers worked by hand."""

import gc
import json
import shutil
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from drawings import see_that_it_can_be_read
from PIL import Image
from study_runs import EXPERIMENT, TIME_OUT, write_run, write_study

from cprl import Study
from cprl.commands import main as cli
from cprl.experimental import factor_maps
from cprl.measuring.statistics import difference
from cprl.runs.files import write_listed
from cprl.runs.recipe import runs_in, write_circumstances
from cprl.studies import results, study_figures
from cprl.studies.factors import Uniform
from cprl.studies.status import Status
from cprl.studies.tables.comparing import (
    condition_differences,
    condition_means,
    condition_table,
    episodes_text,
    pairing_text,
    values_of,
)
from cprl.studies.tables.pooled import pooled_table
from cprl.studies.tables.sources import circumstances_of, design_of, study_table
from cprl.studies.tables.tidy_table import METADATA, StudyDesign, StudyTable
from cprl.studies.trials import trials_of
from cprl.terminal.style import WIDTH_IN
from cprl.terminal.text_tables import TextTable, markdown

SEES = "game.rules.window_rows"
GAMMA = "agents.*.algorithm.settings.gamma"
NAN = float("nan")
STUDY = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="small", replicas=3, block=2)
ONE = Study(EXPERIMENT, name="one")
PAIRED = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="pairs", replicas=3)
GRID = Study(EXPERIMENT, {TIME_OUT: [1, 5, 25], SEES: [3, 5]}, name="grid", question="Why?", replicas=3)


def ten_for_each_turn(condition, replica, number):
    """10 apples for each turn of time-out, 100 for each replica and one for each episode."""
    return 10 * condition.levels[TIME_OUT] + 100 * replica + number


def harvest(condition, replica, number):
    """Replicas get 0, 100 and 200; with a time-out of 25, 3, 4 and 8 more."""
    more = (3, 4, 8)[replica] if condition.levels[TIME_OUT] == 25 else 0
    return 100 * replica + more + (number if number >= 0 else 0)


def table_of(runs, factors, apples=lambda *_: 1, *, replicas=2, written=None, **study):
    """The table of a study whose runs are written there, as `write_study` is asked to."""
    study = Study(EXPERIMENT, factors, name="small", replicas=replicas, **study)
    return study_table(study, write_study(study, runs, apples, **(written or {})))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return write_study(STUDY, tmp_path_factory.mktemp("runs"), ten_for_each_turn)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return study_table(PAIRED, write_study(PAIRED, tmp_path_factory.mktemp("pairs"), harvest))


@pytest.fixture(scope="module")
def grid_runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("grid")
    return write_study(GRID, folder, harvest, but=("freeze_steps=5, window_rows=5",))


# The rows of a table


def rows_of(table, **wanted):
    """The rows that have these values, as dictionaries; by default of the harvest in training."""
    wanted = {"metric": "collective_return", "part": "training", **wanted}
    return [row for row in table.rows.to_pylist() if wanted.items() <= row.items()]


def test_a_row_is_a_window_of_a_metric_of_a_replica_under_a_condition(runs):
    table = study_table(STUDY, runs)
    rows = rows_of(table, condition="freeze_steps=25", replica=2)
    # Replica 2 is the first of the second block. 250 + 200 + the mean of 0..9 is 454.5, of 10..19 464.5.
    windows = [(row["episode"], row["window_episodes"], row["value"]) for row in rows]
    assert windows == [(0, 10, 454.5), (10, 10, 464.5), (20, 10, 474.5), (30, 10, 484.5)]
    trial = trials_of(STUDY)[-1]
    assert (trial.block.first, trial.condition.name) == (2, "freeze_steps=25")
    name, checksum = trial.name, trial.condition.checksum
    assert {(row["run"], row["checksum"], row[TIME_OUT]) for row in rows} == {(name, checksum, 25)}
    assert table.rows.schema.field(TIME_OUT).type == "int64"
    for part, value in (("evaluation", 50 + 100 - 1), ("random", 4)):
        (row,) = rows_of(table, condition="freeze_steps=5", replica=1, part=part)
        assert (row["episode"], row["window_episodes"], row["value"]) == (0, 3, value)


def test_episodes_stand_one_by_one_on_request_and_the_last_window_may_be_shorter(runs):
    first = {"condition": "freeze_steps=5", "replica": 0}
    each = study_table(STUDY, runs, window=1)
    assert [row["value"] for row in rows_of(each, **first)] == [50.0 + number for number in range(40)]
    assert [row["value"] for row in rows_of(each, **first, part="evaluation")] == [49.0] * 3
    rows = rows_of(study_table(STUDY, runs, window=15), **first)
    assert [(row["episode"], row["window_episodes"]) for row in rows] == [(0, 15), (15, 15), (30, 10)]
    assert rows[-1]["value"] == 84.5, "50 + the mean of 30..39"


def test_the_same_runs_give_the_same_file_to_the_bit_and_it_can_be_read_back(runs, tmp_path):
    table = study_table(STUDY, runs)
    first, second = (
        each.write(tmp_path / f"{place}.parquet")
        for place, each in enumerate((table, study_table(STUDY, runs)))
    )
    assert first.read_bytes() == second.read_bytes()
    again = StudyTable.read(first)
    assert str(again) == str(table)
    assert (again.design, again.provenance, again.window) == (table.design, table.provenance, 10)
    keys = table.rows.select(["condition", "replica", "part", "metric", "episode"])
    assert keys.group_by(keys.column_names).aggregate([]).num_rows == len(table.rows), "no row twice"
    metadata = json.loads(pq.read_schema(first).metadata[METADATA])
    assert (metadata["design"]["name"], metadata["versions"]["numpy"]) == ("small", np.__version__)
    for path in (next(runs.iterdir()) / "episodes.parquet", tmp_path / "none.parquet"):
        with pytest.raises(ValueError, match=f"{path.name} is not the table of a study"):
            StudyTable.read(path)


def test_episodes_in_which_a_metric_is_undefined_are_counted_and_no_part_of_a_mean(tmp_path):
    equality = lambda replica, number: NAN if number < 12 else number / 10  # noqa: E731
    rows = rows_of(table_of(tmp_path, {}, written={"equality": equality}), replica=0, metric="equality")
    assert [row["undefined"] for row in rows] == [10, 2, 0, 0]
    assert np.isnan(rows[0]["value"])
    assert rows[1]["value"] == pytest.approx((1.2 + 1.9) / 2)  # of episodes 12 to 19


def test_what_is_not_finished_is_named_and_not_part_of_the_table(tmp_path):
    unfinished, finished, failed, _ = trials_of(STUDY)
    write_run(tmp_path / unfinished.name, unfinished.experiment, lambda *_: 1, is_finished=False)
    write_run(tmp_path / finished.name, finished.experiment, lambda *_: 1)
    (tmp_path / "status").mkdir()
    Status(tmp_path / "status", failed.name).fail("ValueError: too hot", "trace")
    table = study_table(STUDY, tmp_path, status=tmp_path / "status")
    assert dict(table.replicas) == {"freeze_steps=5": 0, "freeze_steps=25": 2}
    assert {(run.condition, run.replicas): run.reason for run in table.missing_runs} == {
        ("freeze_steps=5", 2): "has not ended",
        ("freeze_steps=5", 1): "failed: ValueError: too hot",
        ("freeze_steps=25", 1): "was not begun",
    }
    assert "small: 2 replicas of 1 of 2 conditions" in str(table)
    assert all(text in str(table) for text in ("3 runs are not in it", *map(str, table.missing_runs)))


def test_two_trials_whose_directories_were_swapped_are_named_and_not_part_of_the_table(tmp_path):
    write_study(STUDY, tmp_path, ten_for_each_turn)
    one, other = (trial.name for trial in trials_of(STUDY)[:2])
    for before, after in ((one, "aside"), (other, one), ("aside", other)):
        (tmp_path / before).rename(tmp_path / after)
    table = study_table(STUDY, tmp_path)
    assert {lacking.name for lacking in table.missing_runs} == {one, other}
    assert not {one, other} & set(table.rows["run"].to_pylist())


def test_a_summary_made_again_keeps_the_line_that_runs_what_is_lacking(tmp_path):
    table = results.write_results(GRID, tmp_path, tmp_path / "runs", again="cprl sweep x.py")
    summary = (tmp_path / "summary.md").read_text()
    assert "This line runs what is lacking: `cprl sweep x.py`" in summary
    assert results.summarise_again(table, tmp_path).read_text() == summary


def test_a_study_none_of_whose_runs_is_there_has_an_empty_table_and_a_summary_that_says_so(tmp_path):
    table = results.write_results(GRID, tmp_path, tmp_path / "runs")
    assert (len(table.rows), table.metrics, len(table.missing_runs)) == (0, (), 6)
    assert len(StudyTable.read(tmp_path / "table.parquet").rows) == 0
    text = (tmp_path / "summary.md").read_text()
    assert "grid: 0 replicas of 0 of 6 conditions, 0 rows; 6 runs are not in it." in text
    assert text.count("was not begun") == 6
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize("name", ["episodes.parquet", "evaluation/trained.parquet"])
def test_a_damaged_run_is_named_and_does_not_end_the_table(tmp_path, name):
    write_study(STUDY, tmp_path, ten_for_each_turn)
    broken = trials_of(STUDY)[0].name
    (tmp_path / broken / name).write_bytes(b"PAR1")
    table = study_table(STUDY, tmp_path)
    (lacking,) = table.missing_runs
    assert (lacking.name, lacking.is_damaged) == (broken, True)
    assert broken not in table.rows["run"].to_pylist()


def test_cprl_table_ends_with_1_where_a_damaged_run_was_left_out(table_command, capsys):
    write_study(STUDY, Path("runs"), ten_for_each_turn)
    words = ["--by", TIME_OUT, "--metric", "collective_return"]
    table_command(*words)
    broken = trials_of(STUDY)[0].name
    Path("runs", broken, "episodes.parquet").write_bytes(b"PAR1")
    for more in (["--csv"], [*words[2:], "--out", "a.md"]):
        with pytest.raises(SystemExit) as ended:
            table_command(*words[:2], *more)
        assert ended.value.code == 1
    assert f"{broken}, 2 replicas, is damaged" in capsys.readouterr().out
    assert Path("a.md").exists(), "what can be read is written"


def test_a_run_with_fewer_episodes_than_its_experiment_is_named(tmp_path):
    (trial,) = trials_of(ONE)
    run = write_run(tmp_path / trial.name, replace(trial.experiment, episodes=20), lambda *_: 1)
    recipe = json.loads((run / "recipe.json").read_text())
    recipe["experiment"]["episodes"] = 40
    (run / "recipe.json").write_text(json.dumps(recipe))
    (lacking,) = study_table(ONE, tmp_path).missing_runs
    assert r"episodes by replica in training: {0: 20, 1: 20}; allowed: 40 of each" in lacking.reason


def made_under(folder, *circumstances):
    """The table of three conditions whose runs were made under these, and the names of their trials."""
    study = Study(EXPERIMENT, {TIME_OUT: [5, 25, 100]}, name="mixed")
    for trial, made in zip(trials_of(study), circumstances, strict=True):
        write_run(folder / trial.name, trial.experiment, lambda *_: 1, **made)
    return study_table(study, folder), [trial.name for trial in trials_of(study)]


def test_runs_of_other_versions_commits_and_processors_are_marked_and_named_in_a_sentence(tmp_path):
    def made(torch="2.13.0", *, dirty=False, **resumed):
        versions = {"python": "3.11.7", "torch": torch}
        return {"versions": versions, "git": {"commit": "ab" * 20, "dirty": dirty}, "cpu": "Xeon", **resumed}

    more = "The runs were made under more than one"
    table, names = made_under(tmp_path / "a", made(), made("2.14.0"), made(dirty=True))
    assert table.version_warnings == [
        f"{more} version of torch: 2.13.0 in 2 runs; 2.14.0 in 1 run ({names[1]}).",
        f"{more} git commit: abababababab in 2 runs; abababababab with changes in 1 run ({names[2]}).",
    ]
    marks = dict(zip(table.rows["run"].to_pylist(), table.rows["marks"].to_pylist(), strict=True))
    assert marks == {names[0]: "", names[1]: "torch", names[2]: "git commit"}
    assert all(sentence in str(table) for sentence in table.version_warnings)
    resumed = made(resumed=[{**made(), "cpu": "Epyc"}])
    (sentence,) = made_under(tmp_path / "b", made(), made(), resumed)[0].version_warnings
    assert "more than one processor: Xeon in 2 runs; Xeon then Epyc in 1 run" in sentence


def test_a_recipe_records_each_time_it_is_resumed_under_other_circumstances(tmp_path, monkeypatch):
    made = {"versions": {"torch": "2.0"}, "git": None, "cpu": "Xeon"}
    run = write_run(tmp_path / "run", EXPERIMENT, lambda *_: 1, **made)
    for version in ("2.1", "2.1", "2.2"):
        now = {**made, "versions": {"torch": version}}
        monkeypatch.setattr("cprl.runs.recipe._circumstances", lambda recipe, now=now: now)
        write_circumstances(run)
    resumed = json.loads((run / "recipe.json").read_text())["resumed"]
    assert [now["versions"]["torch"] for now in resumed] == ["2.1", "2.2"]
    assert circumstances_of(run) == {"torch": "2.0 then 2.1 then 2.2", "cpu": "Xeon"}


def test_levels_that_are_no_numbers_are_texts_and_a_column_has_no_name_twice(tmp_path):
    words = {"short": {TIME_OUT: 5}, "long": {TIME_OUT: 25}}
    table = table_of(tmp_path, {"metric": words, "game.rules.regrow_prob": [(0.0, 0.1), (0.0, 0.2)]})
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
        assert {row["value"] for row in rows_of(table, condition=name, part="evaluation")} == {place}


def test_a_condition_whose_name_ends_in_a_number_stays_itself():
    levels = {"beam #2": {TIME_OUT: 7}, "beam": {}}
    design = design_of(Study(EXPERIMENT, conditions=levels))
    assert (list(design.conditions), design.reference) == (["beam #2", "beam"], "beam")
    assert design_of(Study(EXPERIMENT, {"size": levels})).levels("size") == ["beam #2", "beam"]
    agents = [[replace(EXPERIMENT.agents[0], reward=reward)] * 2 for reward in ("individual", "team")]
    assert len(set(design_of(Study(EXPERIMENT, {"agents": agents})).levels("agents"))) == 2


# Any runs at hand


def at(time_out, seed, **changes):
    """The experiment with a time-out and a seed."""
    rules = replace(EXPERIMENT.game.rules, freeze_steps=time_out)
    return replace(EXPERIMENT, seed=seed, game=replace(EXPERIMENT.game, rules=rules), **changes)


def write_runs(folder, **experiments):
    for name, experiment in experiments.items():
        write_run(folder / name, experiment, lambda replica, number: 10 * replica)


def test_any_runs_are_pooled_by_the_value_of_a_field_and_replicas_are_numbered_by_seed(tmp_path):
    write_runs(tmp_path, a=at(25, 1), b=at(5, 1), c=at(5, 9, replicas=3))
    write_run(tmp_path / "apart" / "d", at(7, 1), lambda *_: 1, is_finished=False)
    table = pooled_table([tmp_path, tmp_path / "apart"], by=["game.rules.freeze-steps"])
    assert dict(table.replicas) == {"freeze_steps=5": 5, "freeze_steps=7": 0, "freeze_steps=25": 2}
    assert [lacking.reason for lacking in table.missing_runs] == ["has not ended"]
    assert table.rows[TIME_OUT].to_pylist()[0] == 5
    rows = rows_of(table, condition="freeze_steps=5", part="evaluation")
    # Seed 1 has the replicas 0 and 1, seed 9 has 2 to 4; each has ten times its number in its run.
    assert [(row["replica"], row["value"]) for row in rows] == [(0, 0), (1, 10), (2, 0), (3, 10), (4, 20)]
    assert not table.design.is_paired, "seed 9 is in one condition alone"
    assert pooled_table([tmp_path / "a", tmp_path / "b"], by=[TIME_OUT]).design.is_paired


def test_the_same_seed_twice_under_the_same_condition_is_refused_by_name(tmp_path):
    write_runs(tmp_path, a=at(5, 1), b=at(5, 1, episodes=20))
    with pytest.raises(ValueError, match=r"a and .*b have the same seed, 1, .* they differ in episodes"):
        pooled_table([tmp_path], by=[TIME_OUT])
    assert len(pooled_table([tmp_path], by=[TIME_OUT, "episodes"]).design.conditions) == 2


def test_what_pooled_runs_and_conditions_differ_in_beside_is_said(tmp_path):
    write_runs(tmp_path, a=at(5, 1), b=at(5, 2, update_every=2), c=at(25, 1, episodes=20))
    text = str(pooled_table([tmp_path], by=[TIME_OUT]))
    assert "The runs pooled as freeze_steps=5 also differ in update_every." in text
    assert "The conditions also differ in episodes." in text


def test_runs_are_not_pooled_by_what_does_not_fit(tmp_path):
    write_runs(tmp_path, a=EXPERIMENT)
    (tmp_path / "none").mkdir()
    for options, message in (
        ({"by": ["game.rules.freez_steps"]}, "did you mean 'freeze_steps'"),
        ({"by": ["seed"]}, "by is 'seed'"),
        ({"by": ["name", "name"]}, "each once"),
        ({"by": ["name"], "reference": "x"}, "reference is 'x'"),
        ({"by": ["name"], "window": 0}, "window is 0"),
    ):
        with pytest.raises(ValueError, match=message):
            pooled_table([tmp_path / "a"], **options)
    for paths, message in ((["none"], "none is no run"), (["a", "."], "a is there twice")):
        with pytest.raises(ValueError, match=message):
            runs_in([tmp_path / path for path in paths])


# Comparisons


def test_a_paired_difference_is_far_narrower_than_one_of_two_samples():
    values, reference = [3.0, 104.0, 208.0], [0.0, 100.0, 200.0]
    pairs = difference(values, reference, paired=True)
    # The differences are 3, 4 and 8: mean 5, standard error sqrt(7 / 3) = 1.5275, t of 2 is 4.3027.
    assert pairs.value == 5
    assert (pairs.low, pairs.high) == pytest.approx((5 - 6.5724, 5 + 6.5724), abs=1e-3)
    apart = difference(values, reference, paired=False)
    # Welch: variances 10508.3 and 10000 of 3 each, standard error 82.68; 3.9976 degrees of freedom, t 2.7770.
    assert (apart.value, apart.replicas) == (5, 6)
    assert apart.high - 5 == pytest.approx(229.6, abs=0.2)
    with pytest.raises(ValueError, match="values has 2 replicas and reference 1"):
        difference([1, 2], [1], paired=True)


def test_conditions_are_compared_by_the_last_episodes_and_pairs_of_replicas(pairs):
    number = "collective_return"
    values = values_of(pairs.windows(), number)
    # Episodes 10 to 39 have the mean 24.5.
    assert values["freeze_steps=5"] == {0: 24.5, 1: 124.5, 2: 224.5}
    assert values["freeze_steps=25"] == {0: 27.5, 1: 128.5, 2: 232.5}
    found = condition_differences(pairs, [number])
    assert list(found) == [("freeze_steps=25", number)], "the reference has no difference from itself"
    assert found["freeze_steps=25", number].value == 5
    assert found["freeze_steps=25", number].low == pytest.approx(5 - 6.5724, abs=1e-3)
    assert episodes_text(pairs) == "the last 30 episodes of training"
    assert pairing_text(pairs) == "paired by replica"
    assert values_of(pairs.windows(last=10), number)["freeze_steps=5"][0] == 34.5
    assert values_of(pairs.windows("evaluation"), number)["freeze_steps=25"] == {0: 3, 1: 104, 2: 208}
    assert episodes_text(pairs, "evaluation") == "3 fresh episodes of the trained agents"
    for table, options, message in (
        (pairs, {"metrics": ["wealth"]}, "metric is 'wealth'"),
        (pairs, {"part": "sleep"}, "part is 'sleep'"),
        (replace(pairs, last=5), {}, "last is 5"),
    ):
        with pytest.raises(ValueError, match=message):
            condition_means(table, **options)


@pytest.mark.integration
def test_a_table_that_was_compared_is_freed_with_its_last_name(tmp_path):
    table = table_of(tmp_path, {TIME_OUT: [5, 25]})
    assert condition_means(table, ["equality"])
    alive = weakref.ref(table)
    del table
    gc.collect()
    assert alive() is None


def test_replicas_without_a_value_are_counted_and_pairs_are_those_that_both_have(tmp_path):
    def equality(replica, number):
        return NAN if replica == 1 or number == 39 else 0.25

    table = table_of(tmp_path, {TIME_OUT: [5, 25]}, harvest, replicas=3, written={"equality": equality})
    longer = condition_means(table, ["equality"])["freeze_steps=25", "equality"]
    change = condition_differences(table, ["equality"])["freeze_steps=25", "equality"]
    # Of the last 30 episodes replica 1 has no value in any, the others have none in the last one: 30 + 2.
    assert (table.replicas["freeze_steps=25"], longer.episodes, longer.undefined) == (3, 90, 32)
    assert (longer.value, longer.replicas, change.replicas) == (0.25, 2, 2)
    text = "\n".join(markdown(condition_table(table, ["equality"])))
    assert "| freeze_steps=25 | 3 | 0.250 [0.250, 0.250], undefined in 32 of 90 episodes |" in text
    assert "(of 2)" in "\n".join(markdown(condition_table(table, ["equality"], "differences")))


def test_a_table_in_markdown_has_replicas_intervals_and_differences(pairs):
    levels, differences = (
        condition_table(pairs, ["collective_return"], kind) for kind in ("levels", "differences")
    )
    assert levels.head == ["condition", "replicas", "collective return, apples"]
    assert levels.heading == (
        "The last 30 episodes of training; means over replicas; 95% intervals over replicas by Student's t."
    )
    assert [row[:2] for row in levels.rows] == [["freeze_steps=5", "3"], ["freeze_steps=25", "3"]]
    assert [list(map(str, row)) for row in differences.rows] == [
        ["freeze_steps=25", "3", "+5.0 [-1.6, +11.6]"]
    ]


def test_differences_are_bold_that_differ_among_all_of_their_table(tmp_path):
    more = {5: (0, 0, 0), 25: (4, 5, 6), 100: (40, 41, 42)}
    apples = lambda condition, replica, _: 100 * replica + more[condition.levels[TIME_OUT]][replica]  # noqa: E731
    table = table_of(tmp_path, {TIME_OUT: [5, 25, 100]}, apples, replicas=3)
    # 5 +- 1 and 41 +- 1 of 3 pairs: t is 8.66 and 71.0, p is 0.0131 and 0.0002; the equality is 0.5 in all.
    alone = condition_table(table, ["collective_return"], "differences")
    assert [line.split("|")[3].strip() for line in markdown(alone)[2:4]] == [
        "**+5.00 [+2.52, +7.48]**",
        "**+41.0 [+38.5, +43.5]**",
    ]
    assert "Holm's method for the 2 differences of this table" in alone.note
    metrics = "collective_return", "equality", "peace"
    several = condition_table(table, metrics, "differences")
    assert [line.split("|")[3].strip() for line in markdown(several)[2:4]] == [
        "+5.00 [+2.52, +7.48]",
        "**+41.0 [+38.5, +43.5]**",
    ]
    assert str(several.rows[0][3]) == "+0 [+0, +0]"
    assert "for the 6 differences of this table" in several.note
    assert markdown(several)[-2:] == [several.note, ""]


def test_names_in_a_table_in_markdown_are_texts_and_take_one_line():
    names = {"a|b": r"a\|b", "pay_$1_$_": r"pay_\$1_\$_", "*a*": r"\*a\*", "<b>": r"\<b>", "a\nb": "a b"}
    _, _, *lines, _ = markdown(TextTable("", ["condition", "x"], [[name, "1"] for name in names]))
    assert lines == [f"| {written} | 1 |" for written in names.values()]


# Phases


def test_windows_of_many_worlds_have_as_many_episodes_of_each(tmp_path):
    study = Study(replace(EXPERIMENT, worlds=2, replicas=1, episodes=30), {"game.rules.freeze_steps": [5]})
    runs = write_study(study, tmp_path, lambda *_: 1.0)
    run = runs / trials_of(study)[0].name
    rows = pq.read_table(run / "episodes.parquet")
    quick = rows["episode"].to_numpy() % 3 < 2  # two episodes of one world in the time of one of the other
    apples = pa.array(np.where(quick, 10.0, 40.0))
    changed = rows.append_column("world", pa.array(np.where(quick, 0, 1)))
    place = changed.column_names.index("collective_return")
    changed = changed.set_column(place, "collective_return", apples)
    halves = pa.array(np.where(quick, 10.0, 40.0) / 2)  # of two agents
    changed = changed.set_column(changed.column_names.index("harvest"), "harvest", halves)
    write_listed(run, "episodes.parquet", lambda file: pq.write_table(changed, file))
    table = study_table(study, runs)
    (values,) = values_of(table.windows(last=10), "collective_return").values()
    assert list(values.values()) == [25.0], "the last five of each"
    windows = [(row["episode"], row["window_episodes"]) for row in rows_of(table)]
    assert windows == [(0, 5), (5, 5), (10, 10), (20, 10)]


def test_the_most_frequent_phase_of_a_condition_is_counted_over_replicas(tmp_path):
    def fall(condition, replica, number):
        return 400 if number < 20 or replica == 0 else 10

    write_study(PAIRED, tmp_path, fall, random=100.0, but=("freeze_steps=25",))
    # The last 30 of 40 episodes include 10 of the peak: their mean is 140, above 95.
    phases = study_table(PAIRED, tmp_path).endings
    assert list(phases.items()) == [("freeze_steps=5", {"decline": 2, "harvesting": 1})]


# Figures


def assert_drawn(path):
    with Image.open(path) as image:
        assert len(set(image.convert("L").resize((64, 64)).tobytes())) > 8, "it is not empty"
        assert min(image.size) > 300


@pytest.mark.integration
def test_figures_of_a_grid_are_drawn_with_a_condition_that_has_no_run(grid_runs, tmp_path):
    table = study_table(GRID, grid_runs)
    (pair,) = factor_maps.grids(table.design)
    assert pair == (TIME_OUT, SEES)
    for name, draw in {
        "factor": lambda path: study_figures.by_factor(table, TIME_OUT, path),
        "levels": lambda path: study_figures.by_condition(table, path),
        "differences": lambda path: study_figures.by_condition(table, path, kind="differences"),
        "courses": lambda path: study_figures.courses(table, path),
        "map": lambda path: factor_maps.heat_map(table, pair, path),
        "phases": lambda path: factor_maps.phase_diagram(table, pair, path),
    }.items():
        assert_drawn(draw(tmp_path / f"{name}.png"))
        with pytest.raises(ValueError, match=r"path is '.*\.jpg'"):
            draw(tmp_path / f"{name}.jpg")


def test_differences_that_are_all_0_are_drawn_on_an_axis_around_it(tmp_path, drawn):
    table = table_of(tmp_path, {}, conditions={"one": {}, "other": {TIME_OUT: 6}})
    study_figures.by_condition(table, tmp_path / "a.png", kind="differences")
    assert {axes.get_xlim() for axes in drawn[0].axes if axes.get_visible()} == {(-1.0, 1.0)}


LONG = "agents.*.algorithm.settings"


@pytest.mark.integration
@pytest.mark.parametrize("width", ["page", "column"])
def test_a_study_of_24_conditions_most_of_which_were_not_run_has_figures_that_can_be_read(
    width, tmp_path, drawn
):
    factors = {
        TIME_OUT: [5, 25],
        f"{LONG}.optimizer": ["adam", "keras_rmsprop"],
        f"{LONG}.gamma": [0.9, 0.99],
        f"{LONG}.target_every_episodes": [3, 10, 30],
    }
    study = Study(EXPERIMENT, factors, name="combat", replicas=2)
    names = [condition.name for condition in study.all_conditions]
    table = study_table(study, write_study(study, tmp_path / "runs", harvest, but=names[5:]))
    for _, _, draw in study_figures.figures_of(table):
        draw(tmp_path / "a.png", width=width)
    assert len(drawn) > 5
    for figure in drawn:
        see_that_it_can_be_read(figure, WIDTH_IN[width])
        assert "Not run: 19 of 24 conditions." in figure.caption


@pytest.mark.integration
def test_conditions_of_any_name_are_in_the_legend_of_the_courses_and_have_a_panel_each_where_they_are_many(
    tmp_path, drawn
):
    names = ["_x", "pay_$1_or_$_", "[/]", "a|b", "5", "6", "7"]
    conditions = {name: {TIME_OUT: place + 6} for place, name in enumerate(names)}
    for count in (4, 7):
        few = dict(list(conditions.items())[:count])
        table = table_of(tmp_path / str(count), {}, conditions=few, replicas=1)
        study_figures.courses(table, tmp_path / "courses.png")
    together, apart = drawn
    texts = [text.get_text() for text in together.subfigs[0].legends[0].get_texts()]
    assert all(any(name in text for text in texts) for name in names[:4])
    titles = [axes.get_title("left") for axes in apart.axes if axes.get_visible()]
    assert titles == names[1:], "beside the first"


def test_conditions_that_were_not_run_do_not_count_among_the_replicas_of_a_figure():
    assert study_figures.replicas_text({"as run": 8, "no beam": 8, "later": 0}) == "8 replicas each"
    assert (
        study_figures.replicas_text({"as run": 16, "no beam": 8, "later": 0}) == "8 to 16 replicas each (n)"
    )
    assert study_figures.replicas_text({"later": 0}) == "0 replicas each"


def test_figures_call_conditions_by_the_level_and_say_where_replicas_differ(pairs, tmp_path):
    assert study_figures.condition_labels(pairs) == {"freeze_steps=5": "5", "freeze_steps=25": "25"}
    write_study(PAIRED, tmp_path, harvest, but=("freeze_steps=25",))
    part = study_figures.condition_labels(study_table(PAIRED, tmp_path))
    assert part == study_figures.condition_labels(pairs), "what was not run has no number"
    block = replace(PAIRED, block=2)
    write_study(block, tmp_path / "blocks", harvest)
    shutil.rmtree(tmp_path / "blocks" / trials_of(block)[1].name)
    words = study_figures.condition_labels(study_table(block, tmp_path / "blocks"))
    assert words == {"freeze_steps=5": "5 (n=3)", "freeze_steps=25": "25 (n=1)"}


@pytest.mark.integration
def test_random_draws_are_drawn_as_points_and_have_no_heat_map(tmp_path):
    factors = {GAMMA: Uniform(0.5, 0.9), TIME_OUT: [5, 25]}
    table = table_of(tmp_path / "runs", factors, harvest, draws=4, replicas=1)
    assert factor_maps.grids(table.design) == {}
    assert_drawn(study_figures.by_factor(table, GAMMA, tmp_path / "gamma.png"))
    with pytest.raises(ValueError, match="factors"):
        factor_maps.heat_map(table, (TIME_OUT, GAMMA), tmp_path / "map.png")


def dashes(figure):
    """The dashed lines of a figure's first panel with their colours, but for those of the legend."""
    lines = [line for line in figure.axes[0].lines if line.get_marker() == "_"]
    return [(line.get_color(), line.get_ydata().tolist()) for line in lines]


def draw_random_play(folder, random):
    """Draws the time-out of a grid in which random play gets what a function of the levels says."""
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5], SEES: [3, 5]}, name="unlike", replicas=2)
    for trial in trials_of(study):
        by_chance = random(trial.condition.levels)
        write_run(folder / trial.name, trial.experiment, lambda *_: 0, random=by_chance)
    study_figures.by_factor(study_table(study, folder), TIME_OUT, "unlike.png")


@pytest.mark.integration
def test_random_play_under_unlike_rules_is_a_line_each_in_the_colour_of_its_conditions(tmp_path, drawn):
    draw_random_play(tmp_path, lambda levels: 4 if levels[SEES] == 3 else -70)
    (blue, above), (orange, below) = dashes(drawn[0])
    assert (above, below) == ([4, 4], [-70, -70])
    trained = [line.get_color() for line in drawn[0].axes[0].lines if line.get_marker() == "o"]
    assert trained == [blue, orange]


@pytest.mark.integration
def test_random_play_that_belongs_to_no_line_is_not_drawn(tmp_path, drawn, monkeypatch):
    monkeypatch.setattr(study_figures, "_MOST_LINES", 1)
    draw_random_play(tmp_path / "unlike", lambda levels: levels[SEES])
    assert dashes(drawn[0]) == []
    draw_random_play(tmp_path / "same", lambda levels: levels[TIME_OUT])
    assert sorted(set(dashes(drawn[1])[0][1])) == [1, 5]


@pytest.mark.integration
def test_a_figure_counts_the_episodes_in_which_a_metric_is_undefined(tmp_path, drawn):
    idle = {"equality": lambda replica, number: NAN if number == 39 else 0.5}
    table = table_of(tmp_path, {TIME_OUT: [1, 5]}, written=idle)
    study_figures.by_factor(table, TIME_OUT, "i.png", metrics=["equality"])
    assert "undefined in 4 of 120 episodes" in drawn[0].axes[0].get_title("left").replace("\n", " ")


@pytest.mark.integration
def test_a_course_below_0_is_drawn_whole(tmp_path, drawn):
    table = table_of(tmp_path, {TIME_OUT: [1, 5]}, lambda condition, *_: condition.levels[TIME_OUT] - 60)
    study_figures.courses(table, "courses.png")
    assert drawn[0].axes[0].get_ylim()[0] < -59
    assert drawn[0].axes[1].get_ylim()[0] == 0


@pytest.mark.integration
@pytest.mark.parametrize("draw", [factor_maps.heat_map, factor_maps.phase_diagram])
def test_levels_are_mapped_in_the_order_in_which_they_were_given(tmp_path, drawn, draw):
    words = {"tall": {SEES: 9}, "low": {SEES: 3}, "middle": {SEES: 5}}
    draw(table_of(tmp_path, {TIME_OUT: [25, 1], "view": words}), (TIME_OUT, "view"), "map.png")
    axes = drawn[0].axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["tall", "low", "middle"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["25", "1"]


def test_random_play_of_a_table_in_float32_is_that_of_one_in_float64():
    exported = [float(np.float32(0.9055097465415143)), 0.9055097465415143]
    assert study_figures.are_one_number(exported)
    assert not study_figures.are_one_number([*exported, 0.9056])


def test_numbers_far_apart_stand_on_a_logarithmic_axis_and_close_ones_at_equal_distances():
    assert [study_figures.is_logarithmic(levels) for levels in ([1, 5, 31], [1, 5, 30], [0, 9])] == [
        True,
        0,
        0,
    ]
    assert [study_figures.is_numeric(levels) for levels in ([1, 2.5], [1, "two"], [True, False])] == [
        True,
        0,
        0,
    ]
    close = study_figures.axis_places([0.5, 0.95, 0.99, 0.995])
    assert close == ({0.5: 0, 0.95: 1, 0.99: 2, 0.995: 3}, True)
    assert study_figures.axis_places([0.5, 0.9, 0.7]) == ({0.5: 0.5, 0.7: 0.7, 0.9: 0.9}, False)


def test_a_factor_with_names_is_refused_as_an_axis_of_numbers(tmp_path):
    table = table_of(tmp_path / "runs", {"word": {"a": {TIME_OUT: 5}, "b": {TIME_OUT: 25}}})
    with pytest.raises(ValueError, match="factor is 'word'"):
        study_figures.by_factor(table, "word", tmp_path / "word.png")


def test_other_factors_are_held_at_the_levels_of_the_reference():
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5], SEES: [3, 5], "update_every": [1, 2]}, name="three")
    by_pair = factor_maps.grids(design_of(study))
    assert list(by_pair) == [(TIME_OUT, SEES), (TIME_OUT, "update_every"), (SEES, "update_every")]
    assert all("update_every=1" in name for name in by_pair[TIME_OUT, SEES].values())
    assert len(by_pair[TIME_OUT, SEES]) == 4


# What is written


@pytest.mark.integration
def test_the_results_of_a_study_are_a_table_a_summary_and_figures(grid_runs, tmp_path):
    table = results.write_results(GRID, tmp_path, grid_runs, again="cprl sweep grid.py")
    drawn = {path.name for path in (tmp_path / "figures").iterdir()}
    pair = "game_rules_freeze_steps_game_rules_window_rows"
    assert drawn == {
        "by_game_rules_freeze_steps.png", "by_game_rules_window_rows.png", "levels.png", "courses.png",
        "differences.png", f"map_{pair}_collective_return.png", f"map_{pair}_equality.png",
    }  # fmt: skip
    unlike = {name: {phase: 3} for name, phase in zip(table.endings, ["tragedy", "decline"], strict=False)}
    assert f"phases_{pair}.png" in [
        name for name, *_ in study_figures.figures_of(replace(table, endings=unlike))
    ]
    unknown = {name: {} for name in table.endings}
    figures = study_figures.figures_of(replace(table, endings=unknown))
    assert not any(name.startswith("phases") for name, *_ in figures)
    assert StudyTable.read(tmp_path / "table.parquet").summary == table.summary
    text, (lacking,) = (tmp_path / "summary.md").read_text(), table.missing_runs
    for line in (
        "**Question.** Why?",
        f"- {lacking}",
        "This line runs what is lacking: `cprl sweep grid.py`",
        "| freeze_steps=25, window_rows=5 | 3 | 130",
        *(f"(figures/{name})" for name in drawn),
    ):
        assert line in text
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.integration
def test_results_are_written_again_over_earlier_ones_and_none_of_those_is_left(tmp_path):
    (tmp_path / "figures").mkdir()
    for name in ("map_old.png", "phases.png", "mine.png"):
        (tmp_path / "figures" / name).write_bytes(b"")
    study = Study(EXPERIMENT, {TIME_OUT: [5]}, name="one", replicas=3)
    write_study(study, tmp_path / "runs", harvest)
    written = []
    for _ in range(2):
        assert results.write_results(study, tmp_path, tmp_path / "runs").missing_runs == ()
        written.append([(tmp_path / name).read_bytes() for name in ("summary.md", "table.parquet")])
    assert written[0] == written[1]
    drawn = {path.name for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"levels.png", "courses.png", "mine.png"}


def test_the_summary_says_how_many_steps_each_replica_learned_from_where_the_runs_do(tmp_path, monkeypatch):
    def summary():
        results.write_results(PAIRED, tmp_path, tmp_path / "runs")
        return (tmp_path / "summary.md").read_text()

    monkeypatch.setattr(results, "figures_of", lambda *_, **__: iter(()))
    write_study(PAIRED, tmp_path / "runs", harvest)
    assert "environment steps" not in summary(), "runs of before did not say"
    reports = [tmp_path / "runs" / trial.name / "report.json" for trial in trials_of(PAIRED)]
    for place, report in enumerate(reports):
        report.write_text(json.dumps({"steps": 1000 + place}))
    lines = summary().split("| condition | episodes | environment steps |")[1].splitlines()[2:]
    assert [line.split("|")[3].strip() for line in lines if line] == ["1,000", "1,001"]
    reports[0].write_text("{")
    assert "1,000 |" not in summary(), "a damaged report ends no summary"


# The command line


@pytest.fixture
def table_command(tmp_path, monkeypatch):
    """Runs `cprl table` where the runs of the paired study are."""
    monkeypatch.chdir(tmp_path)

    def command(*words, of="runs"):
        monkeypatch.setattr(sys, "argv", ["cprl", "table", of, *words])
        cli.main()

    return command


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--by name --part evaluation --last 30", "--last .* without --part evaluation"),
        ("--by name --part random --last 30", "--last .* without --part random"),
        ("", r"cprl table RUN\.\.\. --by "),
        ("--by name --summary", "--summary .* without --by"),
        ("--by name --figures pdf", "--figures .* without --by"),
        ("--csv --figures pdf", "without --figures"),
        ("--csv --out a.csv", "without --out, as --out FILE.csv"),
        ("--csv --summary", "without --summary"),
        ("--csv --metric equality", "without --metric"),
        ("--csv --part random", "without --part"),
        ("--csv --last 10", "without --last"),
        ("--csv --reference x", "without --reference"),
    ],
)
def test_words_of_cprl_table_that_do_not_fit_are_refused_by_the_flag(words, message, table_command):
    with pytest.raises(SystemExit, match=message):
        table_command(*words.split())


def test_cprl_table_prints_any_runs_by_a_field_and_writes_them(table_command, capsys):
    write_study(PAIRED, Path("runs"), harvest)
    words = ["--by", "game.rules.freeze-steps", "--metric", "collective_return", "--out"]
    for out in ("table.parquet", "table.md", "table.csv"):
        table_command(*words, out)
    table_command(*words, "table.tex", "--out", "table.txt")
    printed = capsys.readouterr().out
    assert "+5.0 [-1.6, +11.6]" in printed
    assert "2 runs by game.rules.freeze_steps: 6 replicas of 2 of 2 conditions" in printed
    rows = StudyTable.read("table.parquet").rows
    assert set(rows["metric"].to_pylist()) == {"collective_return"}
    assert set(rows["part"].to_pylist()) == {"training", "evaluation", "random"}
    means = [row for row in pyarrow.csv.read_csv("table.csv").to_pylist() if row["column"] != "replicas"]
    assert [(row["row"], row["column"], row["replicas"]) for row in means] == [
        ("freeze_steps=5", "collective return, apples", 3),
        ("freeze_steps=25", "collective return, apples", 3),
        ("freeze_steps=25", "collective return, apples", 3),
    ]
    assert [row["value"] for row in means] == pytest.approx([124.5, 100 + 5 + 24.5, 5])
    assert (means[2]["low"], means[2]["high"]) == pytest.approx((-1.57, 11.57), abs=0.01)
    assert "Differences from" not in means[1]["table"]
    assert "+5.0 [$-$1.6, +11.6]" in Path("table.tex").read_text()
    assert "+5.0 [-1.6, +11.6]" in Path("table.txt").read_text()
    assert "| freeze_steps=25 | 3 | +5.0 [-1.6, +11.6] |" in Path("table.md").read_text()
    for out, message in (("table.md", "is not overwritten"), ("a.pdf", r"a name that ends in \.parquet")):
        with pytest.raises(SystemExit, match=message):
            table_command(*words, out)


@pytest.mark.integration
def test_cprl_table_of_a_study_says_and_writes_what_its_table_alone_gives(table_command, capsys):
    table = results.write_results(PAIRED, "pairs", write_study(PAIRED, Path("runs"), harvest))
    summary = Path("pairs/summary.md").read_text()
    Path("pairs/summary.md").unlink()
    capsys.readouterr()
    table_command("--csv", of="pairs")
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.replace('"', "").split(",") == table.rows.column_names
    assert len(rows) == len(table.rows)
    shutil.rmtree("runs")
    table_command("--summary", of="pairs")
    assert Path("pairs/summary.md").read_text() == summary
    before = Path("pairs/figures/differences.png").read_bytes()
    table_command("--summary", "--reference", "freeze_steps=25", of="pairs")
    assert Path("pairs/figures/differences.png").read_bytes() != before
    assert "Differences from freeze_steps=25" in Path("pairs/summary.md").read_text()
    table_command("--metric", "collective_return", "--reference", "freeze_steps=25", of="pairs")
    assert "-5.0 [-11.6, +1.6]" in capsys.readouterr().out
    table_command("--figures", "pdf", "--metric", "equality", of="pairs")
    drawn = {path.name for path in Path("pairs/figures").glob("*.pdf")}
    assert drawn == {
        f"{name}.pdf" for name in ("by_game_rules_freeze_steps", "courses", "differences", "levels")
    }
    assert "Figure: pairs/figures/levels.pdf" in capsys.readouterr().out
    for words in (["--window", "1"], ["--reference", "none"]):
        with pytest.raises(SystemExit, match=words[0]):
            table_command(*words, of="pairs")


# Replicas that trained as many steps, and ended different numbers of episodes


def test_the_last_episodes_are_those_of_each_replica():
    windows = {0: [(0, 10, 1.0), (10, 10, 2.0), (20, 4, 3.0)], 1: [(0, 10, 4.0), (10, 3, 5.0)]}
    rows = [
        {"condition": "a", "replica": replica, "part": "training", "metric": "income"}
        | {"episode": episode, "window_episodes": length, "undefined": 0, "value": value}
        for replica, of_replica in windows.items()
        for episode, length, value in of_replica
    ]
    design = StudyDesign(name="small", conditions={"a": {}}, reference="a", is_paired=True)
    table = StudyTable(design=design, rows=pa.Table.from_pylist(rows), window=10)
    assert values_of(table.windows(last=10), "income") == {"a": {0: 3.0, 1: 5.0}}
    ten = replace(table, last=10)
    assert episodes_text(ten) == "the last 3 to 4 episodes of training"
    assert condition_means(ten, ["income"])["a", "income"].episodes == 7
    values = values_of(table.windows(last=14), "income")["a"]
    assert values == pytest.approx({0: (10 * 2.0 + 4 * 3.0) / 14, 1: 55 / 13})
