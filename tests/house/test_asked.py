"""What the tools of recipes/study/governs say of made-up tables with known answers."""

from dataclasses import replace
from math import isnan
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from asking import EXPERIMENT, MARGIN, Expectation
from bounds import Bound, at_most, board_key, read_bounds, write_bounds
from changes import PPO_AGENT
from courses import end_steps
from finished import name_among
from judging import (
    FROZEN,
    LAST,
    LEARNING,
    MORE_EXPLORATION,
    Outcomes,
    contrast,
    judge,
    judged_lines,
    judged_page,
)
from recovery import first_back, recovery_page
from schedules import exploration_at_end, target_period, updates
from scipy import stats
from sheet import sheet
from tabled import thinned

from cprl import presets
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.experiment import Experiment
from cprl.institutions import Tax
from cprl.measuring.table import where
from cprl.population import Learning, Scripted
from cprl.studies.tables.tidy_table import StudyDesign, StudyTable

REPLICAS = 8
NOISE = np.random.default_rng(0).normal(0.0, 20.0, (2, REPLICAS))
INCOMES = {
    "nothing": 200 + NOISE[0],
    "alike": 203 + NOISE[0] + 0.3 * NOISE[1],
    "better": 500 + NOISE[1],
    "worse": 100 + NOISE[1],
    "wild": 230 + 5 * NOISE[1],
}
"""The income of each replica, frozen, by condition; while they learn agents get 10 more."""


def rows(condition, part, values, metric="collective_return", episode=0, length=50):
    return [
        {
            **{"condition": condition, "checksum": "", "run": condition, "marks": "", "replica": replica},
            **{"part": part, "metric": metric, "episode": episode, "window_episodes": length},
            **{"undefined": 0, "value": float(value)},
        }
        for replica, value in enumerate(values)
    ]


def made_up():
    """Return outcomes of a study of the conditions in `INCOMES`."""
    table = []
    for condition, incomes in INCOMES.items():
        table += rows(condition, "evaluation", incomes)
        table += rows(condition, "training", incomes - 1000, episode=0, length=16)
        for window in (1, 2):
            table += rows(condition, "training", incomes + 10, episode=16 * window, length=16)
    names = {condition: {} for condition in INCOMES}
    design = StudyDesign(name="made_up", conditions=names, reference="nothing", is_paired=True)
    return Outcomes(table=StudyTable(design=design, rows=pa.Table.from_pylist(table), window=16))


def expect(sign, more, less=("nothing",), **fields):
    return Expectation(label=f"{more} {sign}", more=(more,), less=less, sign=sign, why="made up", **fields)


def holm_by_hand(p_values):
    """Return which p-values Holm's method calls significant, by their places."""
    significant = set()
    for rank, place in enumerate(np.argsort(p_values)):
        if p_values[place] > 0.05 / (len(p_values) - rank):
            break
        significant.add(place)
    return significant


def test_a_difference_has_the_interval_and_the_p_of_a_paired_t_test():
    (judged,) = judge(made_up(), [expect("more", "better")])
    paired = stats.ttest_rel(INCOMES["better"], INCOMES["nothing"])
    interval = paired.confidence_interval(0.95)
    assert judged.change.value == pytest.approx((INCOMES["better"] - INCOMES["nothing"]).mean())
    assert (judged.change.low, judged.change.high) == pytest.approx((interval.low, interval.high))
    assert judged.p_value == pytest.approx(paired.pvalue)
    assert judged.verdict == "as expected"


def test_a_contrast_of_several_conditions_is_taken_in_each_replica():
    expectation = replace(expect("more", "better", less=("worse",)), more=("better", "alike"))
    by_hand = (INCOMES["better"] + INCOMES["alike"]) / 2 - INCOMES["worse"]
    assert contrast(made_up(), expectation, FROZEN) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("condition", "verdict"), [("alike", "as expected"), ("better", "failed"), ("wild", "cannot be told")]
)
def test_same_is_judged_by_one_sided_tests_against_the_margin(condition, verdict):
    change = INCOMES[condition] - INCOMES["nothing"]
    above_low = stats.ttest_1samp(change, -MARGIN, alternative="greater").pvalue
    below_high = stats.ttest_1samp(change, MARGIN, alternative="less").pvalue
    above_high = stats.ttest_1samp(change, MARGIN, alternative="greater").pvalue
    below_low = stats.ttest_1samp(change, -MARGIN, alternative="less").pvalue
    (judged,) = judge(made_up(), [expect("same", condition)])
    assert judged.p_value == pytest.approx(min(1, 2 * min(max(above_low, below_high), above_high, below_low)))
    assert judged.verdict == verdict


def test_expectations_of_a_study_are_one_family():
    expectations = [expect("more", name) for name in ("better", "wild", "worse", "alike")]
    judged = judge(made_up(), expectations)
    p_values = [stats.ttest_rel(INCOMES[one.more[0]], INCOMES["nothing"]).pvalue for one in expectations]
    assert [one.p_value for one in judged] == pytest.approx(p_values)
    told = {place for place, one in enumerate(judged) if one.verdict != "cannot be told"}
    assert told == holm_by_hand(p_values)
    assert [one.verdict for one in judged][::2] == ["as expected", "failed"]


def test_learning_is_measured_in_the_last_windows_alone():
    (judged,) = judge(made_up(), [expect("more", "better", part="training")])
    assert judged.change is judged.changes[LEARNING]
    assert made_up().values("nothing", measure=LEARNING) == pytest.approx(
        dict(enumerate(INCOMES["nothing"] + 10))
    )


def test_more_exploration_is_read_from_the_table_of_frozen_agents():
    assert MORE_EXPLORATION not in judge(made_up(), [expect("more", "better")])[0].changes
    frozen = [
        {
            "condition": name,
            "replica": replica,
            "exploration": at,
            "metric": "income",
            "value": value + 100 * at,
        }
        for name, incomes in INCOMES.items()
        for replica, value in enumerate(incomes)
        for at in (0.05, 0.1)
    ]
    outcomes = replace(made_up(), frozen=pa.Table.from_pylist(frozen))
    assert outcomes.values("wild", measure=MORE_EXPLORATION) == pytest.approx(
        dict(enumerate(INCOMES["wild"] + 10))
    )


def test_conditions_of_another_study_are_read_from_its_table(tmp_path):
    made_up().table.write(tmp_path / "made_up" / "table.parquet")
    outcomes = replace(made_up(), others=tmp_path)
    (judged,) = judge(outcomes, [expect("same", "alike", less=("made_up/alike",))])
    assert (judged.change.value, judged.verdict) == (0.0, "as expected")
    with pytest.raises(ValueError, match="alikes"):
        judge(outcomes, [expect("same", "alikes")])


def test_pages_show_failed_expectations_first_and_what_has_not_run():
    outcomes = made_up()
    design = replace(outcomes.table.design, conditions={**outcomes.table.design.conditions, "later": {}})
    outcomes = replace(outcomes, table=replace(outcomes.table, design=design))
    expectations = [expect("more", "better"), expect("more", "worse"), expect("less", "later")]
    judged = judge(outcomes, expectations)
    assert [one.verdict for one in judged] == ["as expected", "failed"]
    text = "\n".join(judged_lines(judged, judged, expectations))
    assert text.index("## Failed") < text.index("## As expected") < text.index("Not run: later less.")


def test_no_change_of_a_share_needs_a_margin_of_its_own():
    with pytest.raises(ValueError, match="margin"):
        expect("same", "alike", metric="equality")
    assert expect("same", "alike", metric="equality", margin=0.1).margin == 0.1


def test_a_metric_that_no_table_has_is_refused():
    with pytest.raises(ValueError, match="equality"):
        judge(made_up(), [expect("more", "better", metric="equality")])


def test_one_replica_tells_nothing():
    outcomes = made_up()
    one_replica = outcomes.table.rows.filter(pa.compute.equal(outcomes.table.rows["replica"], 0))
    outcomes = replace(outcomes, table=replace(outcomes.table, rows=one_replica))
    (judged,) = judge(outcomes, [expect("more", "better")])
    assert isnan(judged.p_value)
    assert judged.verdict == "cannot be told"


def test_an_episode_ends_at_the_turns_of_its_world_times_the_worlds():
    episodes = pa.table({"world": [17, 16, 17, 16], "steps": [100, 120, 50, 80]})
    assert end_steps(episodes, worlds=2).tolist() == [200, 240, 300, 400]


def test_episodes_after_a_change_of_the_game_begin_at_the_change():
    change = 500
    rng = np.random.default_rng(1)
    ended = []
    for world in range(6):
        for begin, end in ((0, change), (change, 4000)):
            turn = begin
            while (turn := turn + (steps := int(rng.integers(60, 300)))) <= end:
                ended.append((turn, world, steps))
    ends, world, steps = zip(*sorted(ended), strict=True)
    episodes = pa.table({"world": world, "steps": steps})
    assert end_steps(episodes, worlds=3, change=3 * change).tolist() == [3 * turn for turn in ends]


@pytest.mark.parametrize(
    ("differences", "steps"),
    [
        ([0.0] * 40, 0),
        ([-100.0] * 12 + [0.0] * 28, 100_000),  # its first mean of five blocks within the margin
        ([np.nan, 60.0, 60.0] + [40.0] * 37, 0),  # the mean of the first four with an episode
        ([MARGIN + 1] * 40, np.nan),
    ],
)
def test_a_replica_is_back_when_its_mean_difference_is_within_the_margin(differences, steps):
    assert first_back(np.array(differences)) == pytest.approx(steps, nan_ok=True)


def test_income_is_the_harvest_where_no_money_moves():
    assert name_among(("collective_return",), "income") == "collective_return"
    assert name_among(("collective_return", "income"), "income") == "income"
    assert name_among(("agent_0/return",), "agent_0/return") == "agent_0/return"


def test_the_exploration_at_the_end_follows_from_the_schedule():
    settings = DQNSettings(epsilon_hold_steps=0, epsilon_decay_steps=1000, epsilon_end=0.1)
    learning = Learning(DQN(settings=settings))
    game = presets.game("commons")
    experiment = Experiment(name="x", game=game, agents=(learning,) * 4, steps=500)
    assert exploration_at_end(experiment, (500, 500)) == "0.55"
    assert exploration_at_end(experiment, (500, 2000)) == "0.10 to 0.55"
    mixed = (learning, Learning(PPO(settings=RolloutSettings())), Scripted("greedy"), Scripted("greedy"))
    mixed_text = "0.55, policy drawn, scripted"
    assert exploration_at_end(replace(experiment, agents=mixed), (500, 500)) == mixed_text


def test_a_board_is_the_same_under_other_institutions_and_beams_and_another_with_other_growth():
    game = presets.game("commons")
    governed = replace(game, institutions=(Tax(rate=0.5),), rules=replace(game.rules, may_fire=False))
    faster = replace(game, rules=replace(game.rules, regrow_prob=(0.0, 0.5)))
    assert board_key(governed) == board_key(game)
    assert board_key(faster) != board_key(game)


def test_updates_and_targets_follow_from_the_settings():
    steps, episodes = (400_000, 400_000), (1_500, 2_000)
    assert updates(EXPERIMENT, steps) == "24,999"  # one a turn of 16 worlds, but for the first
    assert target_period(EXPERIMENT, steps, episodes) == "250"
    ppo = replace(EXPERIMENT, agents=(PPO_AGENT,) * 4)
    assert updates(ppo, steps) == "6,240"  # 390 rollouts of 1,024 steps, 4 epochs of 4 minibatches
    assert target_period(ppo, steps, episodes) == "none: PPO has no target"
    published = replace(EXPERIMENT, agents=(Learning(DQN(settings=DQNSettings())),) * 4, worlds=1)
    # 399,985 updates, 3 of 2,000 or of 1,500 episodes.
    assert target_period(published, steps, episodes) == "600 to 800 (mean; every 3 episodes)"


def test_nobody_gets_more_than_grows_nor_more_than_an_apple_a_turn():
    game = presets.game("commons")
    short = replace(game, rules=replace(game.rules, episode_steps=10))
    assert at_most(short) == (40.0, "an apple a turn")
    barren = replace(game, rules=replace(game.rules, regrow_prob=(0.0,)))
    assert at_most(barren) == (len(game.map.sites), "regrowth")


def test_bounds_are_read_as_they_were_written(tmp_path):
    bound = Bound(
        **{"board": "key", "first": "study/condition, with a comma", "agents": 4, "turns": 1000, "sites": 89},
        **{"at_most": 2599.25, "limit": "regrowth", "planner": 1390.0, "scripted": None},
        **{"trained": 526.5, "trained_in": "study/quota"},
    )
    write_bounds({"key": bound}, tmp_path / "bounds.csv")
    assert read_bounds(tmp_path / "bounds.csv") == {"key": bound}
    assert (bound.best_known, bound.best) == (1390.0, "planner")
    better = replace(bound, trained=1400.0)
    assert (better.best_known, better.best) == (1400.0, "study/quota")


ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results" / "studies"
JUDGED = [
    path
    for path in sorted((ROOT / "recipes" / "study" / "governs").glob("*.py"))
    if (RESULTS / path.stem / "judged.md").exists()
]


@pytest.mark.integration
@pytest.mark.parametrize("study", JUDGED, ids=lambda path: path.stem)
def test_judged_expectations_are_those_of_the_committed_tables(study):
    page = (RESULTS / study.stem / "judged.md").read_text(encoding="utf-8")
    assert "\n".join(judged_page(study, RESULTS)) == page


@pytest.mark.integration
@pytest.mark.parametrize("study", ["order", "shocks"])
def test_how_fast_incomes_are_back_is_that_of_the_committed_courses(study):
    page = (RESULTS / study / "recovery.md").read_text(encoding="utf-8")
    assert recovery_page(ROOT / "recipes" / "study" / "governs" / f"{study}.py") == page


def test_a_thinned_table_keeps_every_so_many_windows_and_the_end_of_each_replica():
    whole = StudyTable.read(RESULTS / "best_response" / "table.parquet", last=LAST)
    thin = thinned(whole, 4)
    assert thin.windows().equals(whole.windows())
    assert thin.windows("evaluation").equals(whole.windows("evaluation"))
    trained, left = (len(where(table.rows, part="training")) for table in (whole, thin))
    assert trained / 4 < left < trained / 2
    committed = StudyTable.read(RESULTS / "shocks" / "table.parquet", last=LAST)
    assert thinned(committed, 4).rows.equals(committed.rows)


@pytest.mark.integration
def test_the_sheet_is_that_of_the_committed_tables_without_an_empty_cell():
    governs = RESULTS.parent / "governs"
    rows = sheet(RESULTS, read_bounds(governs / "bounds.csv"))
    lines = (governs / "sheet.md").read_text(encoding="utf-8").splitlines()
    assert [f"| {' | '.join(row)} |" for row in rows] == lines[4:]
    assert all(map(all, rows))
    assert "not computed" not in {cell for row in rows for cell in row}
