"""What a study's table says: means, differences, phases, figures and the summary; numbers worked by hand."""

import json
import shutil
import sys
from dataclasses import replace
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
from cprl.studies.figures import levels as levels_module
from cprl.studies.figures.courses import courses
from cprl.studies.figures.diagrams import grids, heat_map, phase_diagram
from cprl.studies.figures.levels import (
    by_condition,
    by_factor,
    is_logarithmic,
    is_numeric,
    is_one,
    names_of,
    places_of,
    replicas_text,
)
from cprl.studies.results import write_results
from cprl.studies.tables.comparing import Cells, cells, compare, markdown, metrics_of
from cprl.studies.tables.sources import design_of, ending, study_table
from cprl.studies.tables.table import StudyTable
from cprl.studies.trials import trials_of

SEES = "game.rules.window_rows"
GAMMA = "agents.*.algorithm.settings.gamma"
NAN = float("nan")
PAIRED = Study(EXPERIMENT, {TIME_OUT: [5, 25]}, name="pairs", replicas=3)
GRID = Study(EXPERIMENT, {TIME_OUT: [1, 5, 25], SEES: [3, 5]}, name="grid", question="Why?", replicas=3)


def harvest(condition, replica, number):
    """Replicas get 0, 100 and 200; with a time-out of 25, 3, 4 and 8 more."""
    more = (3, 4, 8)[replica] if condition.levels[TIME_OUT] == 25 else 0
    return 100 * replica + more + (number if number >= 0 else 0)


def table_of(runs, factors, apples=lambda *_: 1, *, replicas=2, written=None, **study):
    """The table of a study whose runs are written there, as `write_study` is asked to."""
    study = Study(EXPERIMENT, factors, name="small", replicas=replicas, **study)
    return study_table(study, write_study(study, runs, apples, **(written or {})))


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    return study_table(PAIRED, write_study(PAIRED, tmp_path_factory.mktemp("pairs"), harvest))


@pytest.fixture(scope="module")
def grid_runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("grid")
    return write_study(GRID, folder, harvest, but=("freeze_steps=5, window_rows=5",))


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
    compared = compare(pairs, "collective_return")
    reference, other = compared.conditions
    # Episodes 10 to 39 have the mean 24.5.
    assert reference.values == {0: 24.5, 1: 124.5, 2: 224.5}
    assert other.values == {0: 27.5, 1: 128.5, 2: 232.5}
    assert (compared.reference, reference.difference) == ("freeze_steps=5", None)
    assert other.difference.value == 5
    assert other.difference.low == pytest.approx(5 - 6.5724, abs=1e-3)
    assert compared.episodes_text == "the last 30 episodes of training"
    assert compared.pairing_text == "paired by replica"
    assert compare(pairs, "collective_return", last=10).conditions[0].values[0] == 34.5
    evaluated = compare(pairs, "collective_return", part="evaluation")
    assert evaluated.conditions[1].values == {0: 3, 1: 104, 2: 208}
    assert evaluated.episodes_text == "3 fresh episodes of the trained agents"


def test_replicas_without_a_value_are_counted_and_pairs_are_those_that_both_have(tmp_path):
    def equality(replica, number):
        return NAN if replica == 1 or number == 39 else 0.25

    table = table_of(tmp_path, {TIME_OUT: [5, 25]}, harvest, replicas=3, written={"equality": equality})
    compared = compare(table, "equality")
    longer = compared.conditions[1]
    # Of the last 30 episodes replica 1 has no value in any, the others have none in the last one: 30 + 2.
    assert (longer.replicas, len(longer.defined), longer.episodes, longer.undefined) == (3, 2, 90, 32)
    assert (longer.estimate.value, longer.estimate.replicas, longer.difference.replicas) == (0.25, 2, 2)
    text = "\n".join(markdown(cells([compared])))
    assert "| freeze_steps=25 | 3 | 0.250 [0.250, 0.250], undefined in 32 of 90 episodes |" in text
    assert "(of 2)" in "\n".join(markdown(cells([compared], "differences")))


def test_a_table_in_markdown_has_replicas_intervals_and_differences(pairs):
    compared = [compare(pairs, metric) for metric in metrics_of(pairs, ["collective_return"])]
    levels, differences = cells(compared), cells(compared, "differences")
    assert levels.head == ["condition", "replicas", "collective return, apples"]
    assert levels.heading == (
        "The last 30 episodes of training; means over replicas; 95% intervals over replicas by Student's t."
    )
    assert [row[:2] for row in levels.rows] == [["freeze_steps=5", "3"], ["freeze_steps=25", "3"]]
    assert differences.rows == [["freeze_steps=25", "3", "+5.0 [-1.6, +11.6]"]]


def test_differences_are_bold_that_differ_among_all_of_their_table(tmp_path):
    def apples(condition, replica, number):
        return (
            100 * replica
            + {5: 0, 25: (4, 5, 6)[replica], 100: (40, 41, 42)[replica]}[condition.levels[TIME_OUT]]
        )

    table = table_of(tmp_path, {TIME_OUT: [5, 25, 100]}, apples, replicas=3)
    # 5 +- 1 and 41 +- 1 of 3 pairs: t is 8.66 and 71.0, p is 0.0131 and 0.0002; the equality is 0.5 in all.
    alone = cells([compare(table, "collective_return")], "differences")
    assert [row[2] for row in alone.rows] == ["**+5.00 [+2.52, +7.48]**", "**+41.0 [+38.5, +43.5]**"]
    assert "Holm's method for 2 comparisons" in alone.note
    several = cells(
        [compare(table, name) for name in ("collective_return", "equality", "peace")], "differences"
    )
    assert [row[2] for row in several.rows] == ["+5.00 [+2.52, +7.48]", "**+41.0 [+38.5, +43.5]**"]
    assert several.rows[0][3] == "+0.000 [+0.000, +0.000]"
    assert "for 6 comparisons" in several.note
    assert markdown(several)[-2:] == [several.note, ""]


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


@pytest.mark.parametrize(("name", "value"), [("metric", "wealth"), ("part", "sleep"), ("last", 5)])
def test_comparisons_that_do_not_fit_are_refused(pairs, name, value):
    with pytest.raises(ValueError, match=f"{name} is {value!r}"):
        compare(pairs, **{"metric": "collective_return", name: value})


# Phases


FALL = [100] * 20 + [400] * 20


@pytest.mark.parametrize(
    ("course", "agents", "label"),
    [
        # Random play gets 100; the peak is 400, a third of its lead over random play is 100.
        ([100] * 40, 4, "no better"),
        ([*FALL, *[400] * 40], 4, "harvesting"),
        ([*FALL, *[290] * 40], 4, "decline"),
        ([*FALL, *[310] * 40], 4, "harvesting"),
        ([*FALL, *[90] * 40], 4, "tragedy"),
        ([*FALL, *[90] * 40], 1, "decline"),
        # From 80 a quarter of the way back to 400 is 160.
        ([*FALL, *[80] * 40, *[170] * 40], 4, "recovery"),
        ([*FALL, *[80] * 40, *[150] * 40], 4, "decline"),
    ],
)
def test_a_short_training_ends_in_the_phase_that_its_last_episodes_say(course, agents, label):
    assert ending(np.array(course, float), random=100.0, agents=agents) == label


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


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn, instead of their files."""
    figures = []
    for module in (levels_module, courses_module, diagrams):
        monkeypatch.setattr(module, "save", lambda figure, path, **how: figures.append(figure))
    return figures


@pytest.mark.integration
def test_figures_of_a_grid_are_drawn_with_a_condition_that_has_no_run(grid_runs, tmp_path):
    table = study_table(GRID, grid_runs)
    (pair,) = grids(table.design)
    assert pair == (TIME_OUT, SEES)
    for name, draw in {
        "factor": lambda path: by_factor(table, TIME_OUT, path),
        "levels": lambda path: by_condition(table, path),
        "differences": lambda path: by_condition(table, path, kind="differences"),
        "courses": lambda path: courses(table, path),
        "map": lambda path: heat_map(table, pair, path),
        "phases": lambda path: phase_diagram(table, pair, path),
    }.items():
        assert_drawn(draw(tmp_path / f"{name}.png"))
        with pytest.raises(ValueError, match=r"path is '.*\.pdf'"):
            draw(tmp_path / f"{name}.pdf")


@pytest.mark.integration
@pytest.mark.parametrize("name", ["_x", "pay_$1_or_$_", "[/]", "a|b"])
def test_a_condition_of_any_name_is_in_the_legend_of_the_courses(name, tmp_path, drawn):
    table = table_of(tmp_path, {}, conditions={name: {TIME_OUT: 1}, "other": {}}, replicas=1)
    courses(table, tmp_path / "courses.png")
    (legend,) = drawn[0].legends
    assert any(name in text.get_text() for text in legend.get_texts())


def test_conditions_that_were_not_run_do_not_count_among_the_replicas_of_a_figure():
    assert replicas_text({"as run": 8, "no beam": 8, "later": 0}) == "8 replicas each"
    assert replicas_text({"as run": 16, "no beam": 8, "later": 0}) == "8 to 16 replicas each (n)"
    assert replicas_text({"later": 0}) == "0 replicas each"


def test_figures_call_conditions_by_the_level_and_say_where_replicas_differ(pairs, tmp_path):
    assert names_of(pairs) == {"freeze_steps=5": "5", "freeze_steps=25": "25"}
    write_study(PAIRED, tmp_path, harvest, but=("freeze_steps=25",))
    assert names_of(study_table(PAIRED, tmp_path)) == names_of(pairs), "what was not run has no number"
    block = replace(PAIRED, block=2)
    write_study(block, tmp_path / "blocks", harvest)
    shutil.rmtree(tmp_path / "blocks" / trials_of(block)[1].name)
    words = names_of(study_table(block, tmp_path / "blocks"))
    assert words == {"freeze_steps=5": "5 (n=3)", "freeze_steps=25": "25 (n=1)"}


@pytest.mark.integration
def test_random_draws_are_drawn_as_points_and_have_no_heat_map(tmp_path):
    factors = {GAMMA: Uniform(0.5, 0.9), TIME_OUT: [5, 25]}
    table = table_of(tmp_path / "runs", factors, harvest, draws=4, replicas=1)
    assert grids(table.design) == {}
    assert_drawn(by_factor(table, GAMMA, tmp_path / "gamma.png"))
    with pytest.raises(ValueError, match="factors"):
        heat_map(table, (TIME_OUT, GAMMA), tmp_path / "map.png")


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
    by_factor(study_table(study, folder), TIME_OUT, "unlike.png")


@pytest.mark.integration
def test_random_play_under_unlike_rules_is_a_line_each_in_the_colour_of_its_conditions(tmp_path, drawn):
    draw_random_play(tmp_path, lambda levels: 4 if levels[SEES] == 3 else -70)
    (blue, above), (orange, below) = dashes(drawn[0])
    assert (above, below) == ([4, 4], [-70, -70])
    trained = [line.get_color() for line in drawn[0].axes[0].lines if line.get_marker() == "o"]
    assert trained == [blue, orange]


@pytest.mark.integration
def test_random_play_that_belongs_to_no_line_is_not_drawn(tmp_path, drawn, monkeypatch):
    monkeypatch.setattr(levels_module, "_MOST_LINES", 1)
    draw_random_play(tmp_path / "unlike", lambda levels: levels[SEES])
    assert dashes(drawn[0]) == []
    draw_random_play(tmp_path / "same", lambda levels: levels[TIME_OUT])
    assert sorted(set(dashes(drawn[1])[0][1])) == [1, 5]


@pytest.mark.integration
def test_a_figure_counts_the_episodes_in_which_a_metric_is_undefined(tmp_path, drawn):
    idle = {"equality": lambda replica, number: NAN if number == 39 else 0.5}
    by_factor(table_of(tmp_path, {TIME_OUT: [1, 5]}, written=idle), TIME_OUT, "i.png", metrics=["equality"])
    assert "undefined in 4 of 120 episodes" in drawn[0].axes[0].get_title().replace("\n", " ")


@pytest.mark.integration
def test_a_course_below_0_is_drawn_whole(tmp_path, drawn):
    table = table_of(tmp_path, {TIME_OUT: [1, 5]}, lambda condition, *_: condition.levels[TIME_OUT] - 60)
    courses(table, "courses.png")
    assert drawn[0].axes[0].get_ylim()[0] < -59
    assert drawn[0].axes[1].get_ylim()[0] == 0


@pytest.mark.integration
@pytest.mark.parametrize("is_map", [True, False])
def test_levels_are_mapped_in_the_order_in_which_they_were_given(tmp_path, drawn, is_map):
    words = {"tall": {SEES: 9}, "low": {SEES: 3}, "middle": {SEES: 5}}
    table = table_of(tmp_path, {TIME_OUT: [25, 1], "view": words})
    if is_map:
        heat_map(table, (TIME_OUT, "view"), "map.png")
    else:
        phase_diagram(table, (TIME_OUT, "view"), "phases.png")
    axes = drawn[0].axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["tall", "low", "middle"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["25", "1"]


def test_random_play_of_a_table_in_float32_is_that_of_one_in_float64():
    exported = [estimate([float(np.float32(0.9055097465415143))]), None, estimate([0.9055097465415143])]
    assert is_one(exported)
    assert not is_one([*exported, estimate([0.9056])])


def test_numbers_that_are_far_apart_stand_on_a_logarithmic_axis_and_names_on_none():
    assert [is_logarithmic(levels) for levels in ([1, 5, 31], [1, 5, 30], [0, 100])] == [True, False, False]
    assert [is_numeric(levels) for levels in ([1, 2.5], [1, "two"], [True, False])] == [True, False, False]


def test_levels_that_are_too_close_for_their_names_stand_at_equal_distances():
    assert places_of([0.5, 0.95, 0.99, 0.995]) == ({0.5: 0, 0.95: 1, 0.99: 2, 0.995: 3}, True)
    assert places_of([0.5, 0.9, 0.7]) == ({0.5: 0.5, 0.7: 0.7, 0.9: 0.9}, False)


def test_a_factor_with_names_is_refused_as_an_axis_of_numbers(tmp_path):
    table = table_of(tmp_path / "runs", {"word": {"a": {TIME_OUT: 5}, "b": {TIME_OUT: 25}}})
    with pytest.raises(ValueError, match="factor is 'word'"):
        by_factor(table, "word", tmp_path / "word.png")


def test_other_factors_are_held_at_the_levels_of_the_reference():
    study = Study(EXPERIMENT, {TIME_OUT: [1, 5], SEES: [3, 5], "update_every": [1, 2]}, name="three")
    by_pair = grids(design_of(study))
    assert list(by_pair) == [(TIME_OUT, SEES), (TIME_OUT, "update_every"), (SEES, "update_every")]
    assert all("update_every=1" in name for name in by_pair[TIME_OUT, SEES].values())
    assert len(by_pair[TIME_OUT, SEES]) == 4


# What is written


@pytest.mark.integration
def test_the_results_of_a_study_are_a_table_a_summary_and_figures(grid_runs, tmp_path):
    table = write_results(GRID, tmp_path, grid_runs, again="cprl sweep grid.py")
    figures = {path.name for path in (tmp_path / "figures").iterdir()}
    pair = "game_rules_freeze_steps_game_rules_window_rows"
    assert figures == {
        "by_game_rules_freeze_steps.png", "by_game_rules_window_rows.png", "levels.png", "courses.png",
        "differences.png", f"map_{pair}_collective_return.png", f"map_{pair}_equality.png",
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
def test_results_are_written_again_over_earlier_ones_and_none_of_those_is_left(tmp_path):
    (tmp_path / "figures").mkdir()
    for name in ("map_old.png", "phases.png", "mine.png"):
        (tmp_path / "figures" / name).write_bytes(b"")
    study = Study(EXPERIMENT, {TIME_OUT: [5]}, name="one", replicas=3)
    write_study(study, tmp_path / "runs", harvest)
    written = []
    for _ in range(2):
        assert write_results(study, tmp_path, tmp_path / "runs").lacking == ()
        written.append([(tmp_path / name).read_bytes() for name in ("summary.md", "table.parquet")])
    assert written[0] == written[1]
    figures = {path.name for path in (tmp_path / "figures").iterdir()}
    assert figures == {"levels.png", "courses.png", "mine.png"}


def test_a_study_without_a_finished_run_has_a_summary_that_says_so(tmp_path):
    write_results(GRID, tmp_path, tmp_path / "runs")
    text = (tmp_path / "summary.md").read_text()
    assert "grid: 0 replicas of 0 of 6 conditions, 0 rows; 6 runs are not in it." in text
    assert text.count("was not begun") == 6
    assert not (tmp_path / "figures").exists()


@pytest.fixture
def summary_of_pairs(tmp_path, monkeypatch):
    """Writes the results of the paired study, without figures, and gives the summary."""
    monkeypatch.setattr("cprl.studies.results._figures", lambda *_: iter(()))

    def written():
        write_results(PAIRED, tmp_path, tmp_path / "runs")
        return (tmp_path / "summary.md").read_text()

    return written


def test_the_summary_says_how_many_steps_each_replica_learned_from_where_the_runs_do(
    tmp_path, summary_of_pairs
):
    write_study(PAIRED, tmp_path / "runs", harvest)
    assert "environment steps" not in summary_of_pairs(), "runs of before did not say"
    reports = [tmp_path / "runs" / trial.name / "report.json" for trial in trials_of(PAIRED)]
    for place, report in enumerate(reports):
        report.write_text(json.dumps({"steps": 1000 + place}))
    lines = summary_of_pairs().split("| condition | episodes | environment steps |")[1].splitlines()[2:]
    assert [line.split("|")[3].strip() for line in lines if line] == ["1,000", "1,001"]
    reports[0].write_text("{")
    assert "1,000 |" not in summary_of_pairs(), "a damaged report ends no summary"


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
        (["--by", "name", "--part", "evaluation", "--last", "30"], "--last .* without --part evaluation"),
        (["--by", "name", "--part", "random", "--last", "30"], "--last .* without --part random"),
        ([], r"cprl table RUN\.\.\. --by "),
        (["--by", "name", "--summary"], "--summary .* without --by"),
    ],
)
def test_words_of_cprl_table_that_do_not_fit_are_refused_by_the_flag(words, message, table_command):
    with pytest.raises(SystemExit, match=message):
        table_command(*words)


def test_cprl_table_prints_any_runs_by_a_field_and_writes_them(table_command, capsys):
    write_study(PAIRED, Path("runs"), harvest)
    words = ["--by", "game.rules.freeze-steps", "--metric", "collective_return", "--out"]
    for out in ("table.parquet", "table.md", "table.csv"):
        table_command(*words, out)
    printed = capsys.readouterr().out
    assert "+5.0 [-1.6, +11.6]" in printed
    assert "2 runs by game.rules.freeze_steps: 6 replicas of 2 of 2 conditions" in printed
    assert len(StudyTable.read("table.parquet").rows) > 0
    assert "| freeze_steps=25 | 3 | +5.0 [-1.6, +11.6] |" in Path("table.md").read_text()
    for out, message in (("table.md", "is not overwritten"), ("a.txt", r"a name that ends in \.parquet")):
        with pytest.raises(SystemExit, match=message):
            table_command(*words, out)


def test_cprl_table_of_a_study_says_and_writes_what_its_table_alone_gives(table_command, capsys):
    table = write_results(PAIRED, "pairs", write_study(PAIRED, Path("runs"), harvest))
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
    table_command("--metric", "collective_return", "--reference", "freeze_steps=25", of="pairs")
    assert "-5.0 [-11.6, +1.6]" in capsys.readouterr().out
    for words in (["--window", "1"], ["--reference", "none"]):
        with pytest.raises(SystemExit, match=words[0]):
            table_command(*words, of="pairs")
