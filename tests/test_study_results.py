"""What a study's table says: means, differences, phases, figures and the summary; numbers worked by hand."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from study_runs import EXPERIMENT, TIME_OUT, write_run, write_study

from cprl import Study
from cprl.commands import main as cli
from cprl.measuring.statistics import difference, estimate
from cprl.studies.factors import Uniform
from cprl.studies.figures import courses as courses_module
from cprl.studies.figures import diagrams
from cprl.studies.figures import levels as by_factor_module
from cprl.studies.figures.courses import courses
from cprl.studies.figures.diagrams import grids, heat_map, phase_diagram
from cprl.studies.figures.levels import (
    _Axis,
    by_condition,
    by_factor,
    is_logarithmic,
    is_numeric,
    is_one,
    replicas_text,
    with_counts,
)
from cprl.studies.results import write_results
from cprl.studies.tables.comparing import Cells, cells, compare, markdown, metrics_of
from cprl.studies.tables.sources import design_of, ending, endings, sources_of
from cprl.studies.tables.table import StudyTable, study_table
from cprl.studies.trials import trials_of

SEES = "game.rules.window_rows"
NAN = float("nan")
PAIRED = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="pairs", replicas=3)
GRID = Study(EXPERIMENT, {TIME_OUT: [1, 5, 25], SEES: [3, 5]}, name="grid", question="Why?", replicas=3)


def harvest(condition, replica, number):
    """Replicas get 0, 100 and 200; with a time-out of 25, 3, 4 and 8 more."""
    more = (3, 4, 8)[replica] if condition.levels[TIME_OUT] == 25 else 0
    return 100 * replica + more + (number if number >= 0 else 0)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return study_table(PAIRED, write_study(PAIRED, tmp_path_factory.mktemp("pairs"), harvest))


@pytest.fixture(scope="module")
def grid_runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("grid")
    return write_study(GRID, folder, harvest, but=("freeze_steps=5, window_rows=5",))


# Statistics


def test_an_interval_by_t_is_that_of_the_tables():
    # 1, 2, 3, 4: mean 2.5, standard error sqrt(5/3) / 2 = 0.6455, t of 3 degrees of freedom 3.1824.
    found = estimate([1, 2, 3, 4])
    assert (found.value, found.replicas) == (2.5, 4)
    assert (found.low, found.high) == pytest.approx((2.5 - 2.0543, 2.5 + 2.0543), abs=1e-4)
    assert np.isnan(estimate([3.0]).low)
    same = estimate([2.0, 2.0])
    assert (same.low, same.high) == (2.0, 2.0)


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
    wide, narrow = (difference(values, reference, paired=own) for own in (False, True))
    assert wide.high - wide.low > 10 * (narrow.high - narrow.low)


@pytest.mark.parametrize(
    ("call", "message"),
    [(lambda: difference([1, 2], [1], paired=True), "values has 2 replicas and reference 1")],
)
def test_statistics_that_do_not_fit_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Comparisons


def test_conditions_are_compared_by_the_last_episodes_and_pairs_of_replicas(pairs):
    found = compare(pairs, "collective_return")
    reference, other = found.conditions
    # Episodes 10 to 39 have the mean 24.5.
    assert reference.values == {0: 24.5, 1: 124.5, 2: 224.5}
    assert other.values == {0: 27.5, 1: 128.5, 2: 232.5}
    assert (found.reference, reference.difference) == ("freeze_steps=5", None)
    assert other.difference.value == 5
    assert other.difference.low == pytest.approx(5 - 6.5724, abs=1e-3)
    assert found.episodes_text == "the last 30 episodes of training"
    assert found.differences_text == "differences from freeze_steps=5, paired by replica"
    assert compare(pairs, "collective_return", last=10).conditions[0].values[0] == 34.5
    evaluated = compare(pairs, "collective_return", part="evaluation")
    assert evaluated.conditions[1].values == {0: 3, 1: 104, 2: 208}
    assert evaluated.episodes_text == "3 fresh episodes of the trained agents"


def test_replicas_without_a_value_are_counted_and_pairs_are_those_that_both_have(tmp_path):
    def equality(replica, number):
        return NAN if replica == 1 or number == 39 else 0.25

    study = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="gaps", replicas=3)
    table = study_table(study, write_study(study, tmp_path, harvest, equality=equality))
    found = compare(table, "equality")
    own = found.conditions[1]
    # Of the last 30 episodes replica 1 has no value in any, the others have none in the last one: 30 + 2.
    assert (own.replicas, len(own.defined), own.episodes, own.undefined) == (3, 2, 90, 32)
    assert (own.estimate.value, own.estimate.replicas, own.difference.replicas) == (0.25, 2, 2)
    text = "\n".join(markdown(cells([found])))
    assert "| freeze_steps=25 | 3 | 0.250 [0.250, 0.250], undefined in 32 of 90 episodes |" in text
    assert "(of 2)" in "\n".join(markdown(cells([found], "differences")))


def test_a_table_in_markdown_has_replicas_intervals_and_differences_that_exclude_zero_in_bold(pairs):
    found = [compare(pairs, own) for own in metrics_of(pairs, ["collective_return"])]
    levels, differences = cells(found), cells(found, "differences")
    assert levels.head == ["condition", "replicas", "collective return, apples"]
    assert levels.heading == (
        "The last 30 episodes of training; means over replicas; 95% intervals over replicas by Student's t."
    )
    assert [row[:2] for row in levels.rows] == [["freeze_steps=5", "3"], ["freeze_steps=25", "3"]]
    assert differences.rows == [["freeze_steps=25", "3", "+5.0 [-1.6, +11.6]"]]


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"metric": "wealth"}, "metric is 'wealth'"),
        ({"part": "sleep"}, "part is 'sleep'"),
        ({"last": 5}, "last is 5"),
    ],
)
def test_comparisons_that_do_not_fit_are_refused(pairs, how, message):
    with pytest.raises(ValueError, match=message):
        compare(pairs, **{"metric": "collective_return", **how})


# Phases


@pytest.mark.parametrize(
    ("course", "agents", "label"),
    [
        # Random play gets 100; the peak is 400, a third of its lead over random play is 100.
        ([100] * 40, 4, "no better"),
        ([100] * 20 + [400] * 60, 4, "harvesting"),
        ([100] * 20 + [400] * 20 + [290] * 40, 4, "decline"),
        ([100] * 20 + [400] * 20 + [310] * 40, 4, "harvesting"),
        ([100] * 20 + [400] * 20 + [90] * 40, 4, "tragedy"),
        ([100] * 20 + [400] * 20 + [90] * 40, 1, "decline"),
        # From 80 a quarter of the way back to 400 is 160.
        ([100] * 20 + [400] * 20 + [80] * 40 + [170] * 40, 4, "recovery"),
        ([100] * 20 + [400] * 20 + [80] * 40 + [150] * 40, 4, "decline"),
    ],
)
def test_a_short_training_ends_in_the_phase_that_its_last_episodes_say(course, agents, label):
    assert ending(np.array(course, float), random=100.0, agents=agents) == label


def test_the_most_frequent_phase_of_a_condition_is_counted_over_replicas(tmp_path):
    def fall(condition, replica, number):
        return 400 if number < 20 or replica == 0 else 10

    how = {"factors": {TIME_OUT: [5, 25]}, "replicas": 3, "name": "falls"}
    study = Study(EXPERIMENT, **how)
    write_study(study, tmp_path, fall, random=100.0, but=("freeze_steps=25",))
    # The last 30 of 40 episodes include 10 of the peak: their mean is 140, above 95.
    found = endings(sources_of(study, tmp_path)[0])
    assert found.most_frequent("freeze_steps=5") == ("decline", 2, 3)
    assert dict(found.labels["freeze_steps=5"]) == {0: "harvesting", 1: "decline", 2: "decline"}
    assert found.most_frequent("freeze_steps=25") is None


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("a|b", r"a\|b"),
        ("pay_$1_or_$_", r"pay_\$1_or_\$_"),
        ("*a*", r"\*a\*"),
        ("<b>", r"\<b>"),
        ("a\nb", "a b"),
    ],
)
def test_names_in_a_table_in_markdown_are_texts_and_take_one_line(name, written):
    assert markdown(Cells("", ["condition", "x"], [[name, "**1**"]]))[2] == f"| {written} | **1** |"


# Figures


def size(path):
    with Image.open(path) as image:
        assert len(set(image.convert("L").resize((64, 64)).tobytes())) > 8, "it is not empty"
        return image.size


@pytest.mark.integration
def test_figures_of_a_grid_are_drawn_with_a_condition_that_has_no_run(grid_runs, tmp_path):
    table = study_table(GRID, grid_runs)
    found = endings(sources_of(GRID, grid_runs)[0])
    (pair,) = grids(table.design)
    assert pair == (TIME_OUT, SEES)
    for name, draw in {
        "factor": lambda path: by_factor(table, TIME_OUT, path),
        "levels": lambda path: by_condition(table, path),
        "differences": lambda path: by_condition(table, path, kind="differences"),
        "courses": lambda path: courses(table, path),
        "map": lambda path: heat_map(table, pair, path),
        "bars": lambda path: phase_diagram(table, found, path),
        "squares": lambda path: phase_diagram(table, found, path, factors=pair),
    }.items():
        width, height = size(draw(tmp_path / f"{name}.png"))
        assert min(width, height) > 300
        with pytest.raises(ValueError, match=r"path is '.*\.pdf'"):
            draw(tmp_path / f"{name}.pdf")


@pytest.mark.integration
@pytest.mark.parametrize("name", ["_x", "pay_$1_or_$_", "[/]", "a|b"])
def test_a_condition_of_any_name_is_in_the_legend_of_the_courses(name, tmp_path, drawn):
    study = Study(EXPERIMENT, conditions={name: {TIME_OUT: 1}, "other": {}}, name="names", replicas=1)
    runs = write_study(study, tmp_path, lambda *_: 5)
    courses(study_table(study, runs), tmp_path / "courses.png")
    (legend,) = drawn[0].legends
    assert any(name in text.get_text() for text in legend.get_texts())


@pytest.mark.integration
def test_conditions_that_were_not_run_do_not_count_among_the_replicas_of_a_figure():
    assert replicas_text({"as run": 8, "no beam": 8, "later": 0}) == "8 replicas each"
    assert replicas_text({"as run": 16, "no beam": 8, "later": 0}) == "8 to 16 replicas each (n)"
    assert replicas_text({"later": 0}) == "0 replicas each"
    names = {"as run": "as run", "later": "later"}
    assert with_counts(names, {"as run": 8, "later": 0}) == names
    assert with_counts(names, {"as run": 8, "later": 4})["later"] == "later (n=4)"


@pytest.mark.integration
def test_random_draws_are_drawn_as_points_and_have_no_heat_map(tmp_path):
    factors = {"agents.*.algorithm.settings.gamma": Uniform(0.5, 0.9), TIME_OUT: [5, 25]}
    study = Study(EXPERIMENT, factors, draws=4, name="draws", replicas=1)
    table = study_table(study, write_study(study, tmp_path / "runs", harvest))
    assert grids(table.design) == {}
    size(by_factor(table, "agents.*.algorithm.settings.gamma", tmp_path / "gamma.png"))
    with pytest.raises(ValueError, match="allowed: none, as the conditions are no grid of two factors"):
        heat_map(table, (TIME_OUT, "agents.*.algorithm.settings.gamma"), tmp_path / "map.png")


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn, instead of their files."""
    figures = []
    for module in (by_factor_module, courses_module, diagrams):
        monkeypatch.setattr(module, "save", lambda figure, path, **how: figures.append(figure))
    return figures


def dashes(figure):
    """The dashed lines of a figure's first panel with their colours, but for those of the legend."""
    lines = [own for own in figure.axes[0].lines if own.get_marker() == "_"]
    return [(own.get_color(), own.get_ydata().tolist()) for own in lines]


def unlike(tmp_path, factors, random):
    """A table of a study in which random play gets what a function of the levels says."""
    study = Study(EXPERIMENT, factors, name="unlike", replicas=2)
    for trial in trials_of(study):
        by_chance = random(trial.condition.levels)
        write_run(tmp_path / trial.name, trial.experiment, lambda *_: 0, random=by_chance)
    return study_table(study, tmp_path)


@pytest.mark.integration
def test_random_play_under_unlike_rules_is_a_line_each_in_the_colour_of_its_conditions(tmp_path, drawn):
    table = unlike(tmp_path, {TIME_OUT: [1, 5], SEES: [3, 5]}, lambda at: 4 if at[SEES] == 3 else -70)
    by_factor(table, TIME_OUT, "unlike.png")
    (blue, above), (orange, below) = dashes(drawn[0])
    assert (above, below) == ([4, 4], [-70, -70])
    trained = [own.get_color() for own in drawn[0].axes[0].lines if own.get_marker() == "o"]
    assert trained == [blue, orange]


@pytest.mark.integration
def test_random_play_that_belongs_to_no_line_is_not_drawn(tmp_path, drawn, monkeypatch):
    monkeypatch.setattr(by_factor_module, "_MOST_LINES", 1)
    factors = {TIME_OUT: [1, 5], SEES: [3, 5]}
    by_factor(unlike(tmp_path / "unlike", factors, lambda at: at[SEES]), TIME_OUT, "unlike.png")
    assert dashes(drawn[0]) == []
    by_factor(unlike(tmp_path / "same", factors, lambda at: at[TIME_OUT]), TIME_OUT, "same.png")
    assert sorted(set(dashes(drawn[1])[0][1])) == [1, 5]


@pytest.mark.integration
def test_a_figure_counts_the_episodes_in_which_a_metric_is_undefined(tmp_path, drawn):
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5]}, name="idle", replicas=2)
    idle = {"equality": lambda replica, number: NAN if number == 39 else 0.5}
    table = study_table(study, write_study(study, tmp_path, lambda *_: 1, **idle))
    by_factor(table, TIME_OUT, "idle.png", metrics=["equality"])
    assert "undefined in 4 of 120 episodes" in drawn[0].axes[0].get_title().replace("\n", " ")


@pytest.mark.integration
def test_a_course_below_0_is_drawn_whole(tmp_path, drawn):
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5]}, name="below", replicas=2)
    write_study(study, tmp_path, lambda condition, *_: condition.levels[TIME_OUT] - 60)
    courses(study_table(study, tmp_path), "courses.png")
    assert drawn[0].axes[0].get_ylim()[0] < -59
    assert drawn[0].axes[1].get_ylim()[0] == 0


@pytest.mark.integration
@pytest.mark.parametrize("draw", ["heat_map", "phase_diagram"])
def test_levels_are_mapped_in_the_order_in_which_they_were_given(tmp_path, drawn, draw):
    words = {"tall": {SEES: 9}, "low": {SEES: 3}, "middle": {SEES: 5}}
    study = Study(EXPERIMENT, {TIME_OUT: [25, 1], "view": words}, name="order", replicas=2)
    table = study_table(study, tmp_path)
    if draw == "heat_map":
        write_study(study, tmp_path, lambda *_: 1)
        heat_map(study_table(study, tmp_path), (TIME_OUT, "view"), "map.png")
    else:
        phase_diagram(table, endings([]), "phases.png", factors=(TIME_OUT, "view"))
    axes = drawn[0].axes[0]
    assert [own.get_text() for own in axes.get_xticklabels()] == ["tall", "low", "middle"]
    assert [own.get_text() for own in axes.get_yticklabels()] == ["25", "1"]


def test_random_play_of_a_table_in_float32_is_that_of_one_in_float64():
    exported = [estimate([float(np.float32(0.9055097465415143))]), None, estimate([0.9055097465415143])]
    assert is_one(exported)
    assert not is_one([*exported, estimate([0.9056])])


def test_numbers_that_are_far_apart_stand_on_a_logarithmic_axis_and_names_on_none():
    assert is_logarithmic([1, 5, 31])
    assert not is_logarithmic([1, 5, 30])
    assert not is_logarithmic([0, 100])
    assert is_numeric([1, 2.5])
    assert not is_numeric([1, "two"])
    assert not is_numeric([True, False])


def test_levels_that_are_too_close_for_their_names_stand_at_equal_distances():
    def axis(levels):
        study = Study(EXPERIMENT, {"agents.*.algorithm.settings.gamma": levels}, name="axis")
        return _Axis.of("agents.*.algorithm.settings.gamma", study_table(study, Path("none")))

    crowded = axis([0.5, 0.95, 0.99, 0.995])
    assert crowded.places == {0.5: 0, 0.95: 1, 0.99: 2, 0.995: 3}
    assert "equal distances" in crowded.title
    assert axis([0.5, 0.7, 0.9]).places == {0.5: 0.5, 0.7: 0.7, 0.9: 0.9}


def test_a_factor_with_names_is_refused_as_an_axis_of_numbers(tmp_path):
    study = Study(EXPERIMENT, {"word": {"a": {TIME_OUT: 5}, "b": {TIME_OUT: 25}}}, name="words")
    table = study_table(study, write_study(study, tmp_path / "runs", lambda *_: 1))
    with pytest.raises(ValueError, match="factor is 'word'"):
        by_factor(table, "word", tmp_path / "word.png")


def test_other_factors_are_held_at_the_levels_of_the_reference():
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5], SEES: [3, 5], "update_every": [1, 2]}, name="three")
    found = grids(design_of(study))
    assert list(found) == [(TIME_OUT, SEES), (TIME_OUT, "update_every"), (SEES, "update_every")]
    assert all("update_every=1" in name for name in found[TIME_OUT, SEES].values())
    assert len(found[TIME_OUT, SEES]) == 4


# What is written


@pytest.mark.integration
def test_the_results_of_a_study_are_a_table_a_summary_and_figures(grid_runs, tmp_path):
    table = write_results(GRID, tmp_path, grid_runs, again="cprl sweep grid.py")
    figures = {path.name for path in (tmp_path / "figures").iterdir()}
    pair = "game_rules_freeze_steps_game_rules_window_rows"
    assert figures == {
        "by_game_rules_freeze_steps.png", "by_game_rules_window_rows.png", "levels.png", "courses.png",
        "phases.png", "differences.png", f"map_{pair}_collective_return.png", f"map_{pair}_equality.png",
        f"phases_{pair}.png",
    }  # fmt: skip
    assert StudyTable.read(tmp_path / "table.parquet").summary == table.summary
    text = (tmp_path / "summary.md").read_text()
    assert "**Question.** Why?" in text
    (lacking,) = table.lacking
    assert f"- {lacking}" in text
    assert "This line runs what is lacking: `cprl sweep grid.py`" in text
    assert "| freeze_steps=25, window_rows=5 | 3 | 130" in text
    assert all(f"(figures/{name})" in text for name in figures)
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.integration
def test_results_are_written_again_over_earlier_ones_and_none_of_those_is_left(grid_runs, tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "map_old.png").write_bytes(b"")
    (tmp_path / "figures" / "mine.png").write_bytes(b"")
    study = Study(EXPERIMENT, {TIME_OUT: [5]}, name="one", replicas=3)
    write_study(study, tmp_path / "runs", harvest)
    first = write_results(study, tmp_path, tmp_path / "runs")
    before = (tmp_path / "summary.md").read_bytes(), (tmp_path / "table.parquet").read_bytes()
    write_results(study, tmp_path, tmp_path / "runs")
    assert before == ((tmp_path / "summary.md").read_bytes(), (tmp_path / "table.parquet").read_bytes())
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "levels.png", "courses.png", "phases.png", "mine.png",
    }  # fmt: skip
    assert first.lacking == ()


def test_a_study_without_a_finished_run_has_a_summary_that_says_so(tmp_path):
    write_results(GRID, tmp_path, tmp_path / "runs")
    text = (tmp_path / "summary.md").read_text()
    assert "grid: 0 replicas of 0 of 6 conditions, 0 rows; 6 runs are not in it." in text
    assert text.count("was not begun") == 6
    assert not (tmp_path / "figures").exists()


def test_the_summary_of_runs_under_other_versions_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.studies.results._draw", lambda *_: iter(()))
    for nth, trial in enumerate(trials_of(PAIRED)):
        write_run(tmp_path / "runs" / trial.name, trial.experiment, lambda *_: 1, cpu=("Xeon", "Epyc")[nth])
    write_results(PAIRED, tmp_path, tmp_path / "runs")
    text = (tmp_path / "summary.md").read_text()
    assert "- The runs were made under more than one processor: Xeon in 1 run; Epyc in 1 run" in text


def test_the_summary_says_how_many_steps_each_replica_learned_from_where_the_runs_do(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.studies.results._draw", lambda *_: iter(()))
    write_study(PAIRED, tmp_path / "runs", harvest)
    write_results(PAIRED, tmp_path, tmp_path / "runs")
    assert "environment steps" not in (tmp_path / "summary.md").read_text(), "runs of before did not say"
    for nth, trial in enumerate(trials_of(PAIRED)):
        (tmp_path / "runs" / trial.name / "report.json").write_text(json.dumps({"steps": 1000 + nth}))
    write_results(PAIRED, tmp_path, tmp_path / "runs")
    told = (tmp_path / "summary.md").read_text().split("| condition | episodes | environment steps |")[1]
    counts = [line.split("|")[3].strip() for line in told.splitlines()[2:] if line]
    assert counts == ["1,000", "1,001"]
    (tmp_path / "runs" / trials_of(PAIRED)[0].name / "report.json").write_text("{")
    write_results(PAIRED, tmp_path, tmp_path / "runs")
    assert "1,000 |" not in (tmp_path / "summary.md").read_text(), "a damaged report ends no summary"


# The command line


@pytest.mark.parametrize("part", ["evaluation", "random"])
def test_cprl_table_refuses_to_count_episodes_of_another_part_than_the_training(part, monkeypatch):
    command = ["cprl", "table", "runs", "--by", "name", "--part", part, "--last", "30"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit, match=f"--last counts episodes of the training; .* without --part {part}"):
        cli.main()


def test_cprl_table_without_a_field_to_group_by_says_the_flag(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["cprl", "table", "runs"])
    with pytest.raises(SystemExit, match=r"cprl table RUN\.\.\. --by "):
        cli.main()


def test_cprl_table_prints_any_runs_by_a_field_and_writes_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_study(PAIRED, Path("runs"), harvest)
    command = ["cprl", "table", "runs", "--by", "game.rules.freeze-steps", "--metric", "collective_return"]
    for out in ("table.parquet", "table.md"):
        monkeypatch.setattr(sys, "argv", [*command, "--out", out])
        cli.main()
    printed = capsys.readouterr().out
    assert "+5.0 [-1.6, +11.6]" in printed
    assert "2 runs by game.rules.freeze_steps: 6 replicas of 2 of 2 conditions" in printed
    assert len(StudyTable.read("table.parquet").rows) > 0
    assert "| freeze_steps=25 | 3 | +5.0 [-1.6, +11.6] |" in Path("table.md").read_text()
    for out, message in (
        ("table.md", "is not overwritten"),
        ("a.csv", "a name that ends in .parquet or .md"),
    ):
        monkeypatch.setattr(sys, "argv", [*command, "--out", out])
        with pytest.raises(SystemExit, match=message):
            cli.main()
