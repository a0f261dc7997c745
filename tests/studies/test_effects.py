"""Effects of a grid, families of tests and the answer of a report, on made-up tables whose truth is known."""

import re
from dataclasses import replace
from itertools import product

import pyarrow as pa
import pytest

from cprl.experimental.factor_maps import heat_map
from cprl.measuring.statistics import contrasts
from cprl.studies.results import write_summary
from cprl.studies.study_figures import by_condition
from cprl.studies.tables.comparing import compared_metrics, comparison_tables, condition_table
from cprl.studies.tables.effects import effect_tables, effect_weights, effects_of
from cprl.studies.tables.tidy_table import StudyDesign, StudyTable
from cprl.system.defaults import STUDY_TABLE
from cprl.terminal.style import Sheet
from cprl.web.report import report

FINES, PROBS, REPLICAS = (0, 1, 4), (0.25, 1.0), 4
NOISE = (-1.0, 0.0, 0.0, 1.0)
"""Its standard error is sqrt(2 / 3 / 4) = 0.408; times Student's t of 3, 3.182, that is 1.3."""


def harvest_of(fine, prob, replica):
    """A fine of 4 gives 10 apples, and 2 more where it is certain; replicas differ by hundreds."""
    return 100 * replica + (10 + 2 * (prob == 1) + NOISE[replica]) * (fine == 4)


def income_of(fine, prob, replica):
    """Fines of 4 take 30 of these apples."""
    return harvest_of(fine, prob, replica) - 30 * (fine == 4)


def table_of(metrics, conditions, reference=None, replicas=REPLICAS, **design):
    """A table of so many replicas of a window in each part; `metrics` gives a value from the levels of a
    condition, in order, and the number of a replica."""
    rows = [
        {"condition": name, "replica": replica, "part": part, "metric": metric, "value": float(value)}
        | {"episode": 0, "window_episodes": 10, "undefined": 0}
        for (name, levels), replica, (metric, of) in product(
            conditions.items(), range(replicas), metrics.items()
        )
        for part, value in (
            ("training", of(*levels.values(), replica)),
            ("evaluation", of(*levels.values(), replica)),
            ("random", 1),
        )
    ]
    reference = reference or next(iter(conditions))
    design = StudyDesign(name="made up", conditions=conditions, reference=reference, is_paired=True, **design)
    return StudyTable(design=design, rows=pa.Table.from_pylist(rows), window=10)


def grid_of(*factors, **design):
    """The conditions of all combinations of levels, each factor a name and its levels."""
    names = [name for name, _ in factors]
    combinations = product(*(levels for _, levels in factors))
    each = [dict(zip(names, levels, strict=True)) for levels in combinations]
    return {", ".join(f"{name}={level}" for name, level in levels.items()): levels for levels in each}


GRID = grid_of(("fine", FINES), ("prob", PROBS))
BOTH = {"collective_return": harvest_of, "income": income_of}


def written(table, folder):
    """The report of a study with this table, without its tags."""
    table.write(folder / STUDY_TABLE)
    write_summary(table, folder)
    return re.sub(r"<[^>]*>", "", report(folder, folder / "page.html").read_text(encoding="utf-8"))


def test_a_main_effect_is_a_difference_of_means_over_cells_within_a_replica():
    table = table_of(BOTH, GRID, reference="fine=1, prob=1.0")
    effects = effects_of(table, "collective_return", part="evaluation")
    found = {name: one for (name, _), one in effects.items()}
    fine = found["fine 4 against 0"]
    assert fine.value == 11, "10 where it is seldom, 12 where it is certain"
    assert (fine.low, fine.high) == pytest.approx((11 - 1.3, 11 + 1.3), abs=0.01)
    assert found["fine 1 against 0"].value == 0
    assert found["prob 1 against 0.25"].value == pytest.approx(2 / 3), "2 in one of three fines"
    assert found["fine 4 against 0 x prob 1 against 0.25"].value == 2
    assert effects.tests == len(effects) == 3 + 2
    assert fine.differs
    assert not found["fine 1 against 0"].differs


def test_an_interaction_is_the_same_whatever_the_other_factors_are():
    conditions = grid_of(("a", (False, True)), ("b", ("x", "y")), ("c", (0.0, 1.0)))

    def value(a, b, c, replica):
        return replica + 5 * a + 7 * (a and b == "x") + 100 * c

    table = table_of({"income": value}, conditions, reference="a=False, b=y, c=0.0")
    found = effects_of(table, "income")
    by_hand = {
        "a True against False": 5 + 7 / 2,
        "b x against y": 7 / 2,
        "c 1 against 0": 100,
        "a True against False x b x against y": 7,
        "a True against False x c 1 against 0": 0,
        "b x against y x c 1 against 0": 0,
    }
    assert {name: one.value for (name, _), one in found.items()} == pytest.approx(by_hand)


def test_effects_are_of_whole_grids_of_paired_replicas_alone():
    assert effect_weights(table_of(BOTH, GRID))
    assert not effect_weights(table_of(BOTH, dict(list(GRID.items())[1:])))
    assert not effect_weights(table_of({"income": lambda fine, r: r}, grid_of(("fine", FINES))))
    assert not effect_weights(table_of(BOTH, GRID, is_grid=False))
    paired = table_of(BOTH, GRID)
    assert not effect_weights(replace(paired, design=replace(paired.design, is_paired=False)))
    assert effect_tables(table_of({"income": lambda r: r}, {"one": {}, "other": {}})) == []


def test_any_contrast_of_conditions_has_an_interval_over_the_replicas_that_have_them():
    table = table_of({"income": lambda level, r: level * r}, grid_of(("level", (1, 2, 4))))
    weights = {"level=1": 1.0, "level=2": 1.0, "level=4": -0.5}
    found = contrasts(table.windows(), "income", "condition", {"half": weights})["half", "income"]
    assert (found.value, found.replicas) == (1.5, REPLICAS), "the mean of r, 0 to 3"


def test_so_many_interactions_that_they_would_hide_everything_are_left_out_and_counted():
    conditions = grid_of(("a", range(6)), ("b", range(7)))
    table = table_of({"income": lambda a, b, r: a + b + r}, conditions, replicas=2)
    (found,) = effect_tables(table)
    assert len(found.rows) == 5 + 6
    assert "The 30 interactions of two factors are left out." in found.note


def test_the_summary_of_a_grid_has_its_effects_with_their_family(tmp_path):
    summary = write_summary(table_of(BOTH, GRID), tmp_path).read_text()
    assert (
        summary.count("| effect | collective return, apples | income of all agents together, apples |") == 2
    )
    assert "| fine 4 against 0 | **+11.0 [+9.7, +12.3]** | **-19.0 [-20.3, -17.7]** |" in summary
    assert "Bold: not 0 by Holm's method for the 5 differences of a column (two-sided" in summary


def test_the_answer_of_a_grid_is_about_income_where_money_moves_with_the_harvest_beside_it(tmp_path):
    page = written(table_of(BOTH, GRID), tmp_path)
    answer = page[page.index("Answer.") : page.index("Training")]
    income, harvest = answer.split("Harvest")
    assert "10 fresh episodes of the trained agents, effects of each factor" in income
    assert "Holm's method for the 5 effects on a metric" in income
    assert re.search(r"Income of all agents together.*less: fine 4 against 0 -19.0 \[", income, re.DOTALL)
    assert re.search(r"more: fine 4 against 0 \+11.0 \[\+9.7, \+12.3\]", harvest)
    without = written(table_of({"collective_return": harvest_of, "income": harvest_of}, GRID), tmp_path / "b")
    assert "Income" not in without


def test_what_is_not_shown_has_the_size_that_would_have_been(tmp_path):
    def value(level, replica):
        return {"a": 0, "b": NOISE[replica] + 0.5, "c": NOISE[replica] + 1.4, "d": NOISE[replica] + 20}[level]

    conditions = {name: {"level": name} for name in "abcd"}
    table = table_of({"equality": lambda *_: 0.5, "collective_return": value}, conditions)
    page = written(table, tmp_path)
    assert "more: d +20.0 [+18.7, +21.3]" in page
    assert "no difference shown: b +0.50 [-0.80, +1.80] (differences below 1.30 apples would not sh" in page
    assert "not shown among so many, though it would be alone: c +1.40 [+0.10, +2.70]" in page
    rows = condition_table(table, ["collective_return"], "differences").rows
    assert [name for name, _, change in rows if change.estimate.differs] == ["d"], "the page has one family"
    one = written(table_of({"collective_return": value}, conditions, replicas=1), tmp_path / "one")
    assert "cannot be told, as one replica has no interval: b -0.50; c +0.400; d +19.0" in one


def test_the_answer_tests_what_the_table_below_it_tests(tmp_path):
    """A difference of p = 0.02 is not 0 if it is the only one, and may be 0 among six."""

    def value(level, replica):
        return 0 if level == "a" else NOISE[replica] + 1.8

    others = {"equality": value, "sustainability": lambda *_: 0.0, "largest_share": value}
    conditions = {name: {"level": name} for name in "ab"}
    alone, among = (table_of({"collective_return": value, **more}, conditions) for more in ({}, others))
    for table, folder, said in ((alone, "alone", "more: b"), (among, "among", "alone: b")):
        page = written(table, tmp_path / folder)
        assert said in page
        _, differences = comparison_tables(table, part="evaluation")
        assert differences.rows[0][2].estimate.differs == (said == "more: b")


def test_a_metric_that_is_another_by_construction_stands_and_counts_once():
    def steps(level, replica):
        return 1000 + 100 * level + replica

    metrics = {"collective_return": steps, "income": steps, "survival_steps": steps, "peacefulness": steps}
    conditions = grid_of(("level", (0, 1)))
    table = table_of(metrics, conditions)
    assert compared_metrics(table) == ("collective_return", "survival_steps")
    levels, differences = comparison_tables(table)
    assert levels.note == (
        "Not shown: income of all agents together is the same as collective return; peacefulness is the same "
        "as survival here, in every replica."
    )
    assert "for the 2 differences of this table (two" in differences.note
    asked = comparison_tables(table, ["survival_steps", "peacefulness"])
    assert asked[0].note == ""
    assert (
        "for the one difference of this table, of which those that two columns have in common"
        in asked[1].note
    )
    assert len(asked[1].head) == 4, "what is asked for is shown"


def test_a_difference_that_two_columns_have_in_common_is_one_test():
    """Only the penalty takes anything, so the quota's difference is the same before and after payments."""

    def harvest(level, replica):
        return replica**2 * (level != "none")

    def income(level, replica):
        return harvest(level, replica) - 3 * (level == "penalty")

    conditions = {name: {"level": name} for name in ("none", "quota", "penalty")}
    table = table_of({"collective_return": harvest, "income": income}, conditions)
    levels, differences = comparison_tables(table)
    assert len(levels.head) == 4
    assert (
        "for the 3 differences of this table, of which those that two columns have in comm"
        in differences.note
    )
    rounded = {"collective_return": harvest, "income": lambda level, r: harvest(level, r) * (1 + 1e-8)}
    assert compared_metrics(table_of(rounded, conditions)) == ("collective_return",), "payments are float32"


def test_what_an_institution_took_and_found_stands_beside_and_is_not_tested(tmp_path):
    taken = {
        "institutions/fines": lambda fine, prob, r: fine * 10,
        "institutions/violations": lambda *_: 0,
    }
    table = table_of({**BOTH, **taken}, GRID)
    levels, differences, measures = comparison_tables(table)
    assert measures.head == ["condition", "replicas", "fines of all, apples"], "nothing was violated"
    assert str(measures.rows[-1][2]) == "40.0 [40.0, 40.0]"
    assert not [name for name in (*levels.head, *differences.head) if "fines" in name]
    assert len(comparison_tables(table, ["income"])) == 2
    by_condition(table, tmp_path / "levels.svg")
    assert "fines of all" in (tmp_path / "levels.svg").read_text()


def test_agents_that_follow_a_script_are_not_called_trained(tmp_path):
    table = replace(table_of(BOTH, GRID), agents_learn=False)
    assert StudyTable.read(table.write(tmp_path / "table.parquet")).agents_learn is False
    summary = write_summary(table, tmp_path).read_text()
    assert "## The agents in fresh worlds" in summary
    assert "10 fresh episodes of the agents; means" in summary
    assert "rained agents" not in summary


def test_a_map_promises_no_intervals_and_names_the_family_of_its_stars(tmp_path, monkeypatch):
    sheets = []
    finish = Sheet.finish
    monkeypatch.setattr(Sheet, "finish", lambda sheet: (sheets.append(sheet), finish(sheet)))
    heat_map(table_of(BOTH, GRID), ("fine", "prob"), tmp_path / "map.png")
    assert "interval" not in sheets[0].caption
    assert "over n replicas." in sheets[0].caption
    assert "; * not 0 by Holm's method for the 7 differences of 2 metrics together." in sheets[0].caption
