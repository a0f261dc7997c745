"""What a run came to, in the terminal: each number has a unit, and none is missing without a word."""

import io
import re
import shlex
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from places import ROOT
from rich.console import Console
from written_episodes import an_episode

from cprl.measuring.registry import INCOME, METRICS, title, with_unit
from cprl.measuring.statistics import Estimate
from cprl.measuring.table import labelled
from cprl.runs.episodes import table_of
from cprl.terminal.summary import summarise
from cprl.terminal.text_tables import Change, TextTable


def episode(number, harvest, **metrics):
    apples = np.array(harvest, dtype=float)
    known = {"collective_return": apples.sum(), "survival_steps": 900.0, **metrics}
    return replace(an_episode(number, **known), harvest=apples, return_=apples)


def played_by(**played):
    """The episodes of policies as a table; of one replica, or by replica."""
    by_replica = {name: of if isinstance(of, dict) else {0: of} for name, of in played.items()}
    return pa.concat_tables(
        labelled(table_of(episodes, [replica]), policy=name)
        for name, of in by_replica.items()
        for replica, episodes in of.items()
    )


def told_of(tmp_path, **played):
    """The cells of each row by its name, and all that was printed."""
    output = io.StringIO()
    table = played_by(**played)
    summarise(tmp_path, title="a run", played=table, console=Console(file=output, width=200))
    text = output.getvalue()
    cells = [[cell.strip() for cell in re.split("[│┃]", line)[1:-1]] for line in text.splitlines()]
    return {row[0]: row[1:] for row in cells if row}, text


def test_the_line_that_watches_again_can_be_copied(tmp_path):
    run = tmp_path / "own run [a]"
    run.mkdir()
    (run / "run.rrd").touch()
    output = io.StringIO()
    console = Console(file=output, width=200, markup=False)
    summarise(run, title="a run", played=played_by(random=[episode(0, [3, 1])]), console=console)
    (line,) = (line for line in output.getvalue().splitlines() if line.startswith("Watch again: "))
    assert shlex.split(line)[-2:] == ["watch", str(run)], "all recordings of a run that was resumed"


def test_rows_have_units_intervals_over_replicas_and_paired_differences(tmp_path):
    # Means of the replicas: 4, 2, 3 and 12, 6, 9 apples; t of two degrees of freedom is 4.30.
    random = {0: [episode(0, [3, 1])], 1: [episode(0, [1, 1])], 2: [episode(0, [2, 1]), episode(1, [2, 1])]}
    trained = {0: [episode(0, [9, 3])], 1: [episode(0, [5, 1])], 2: [episode(0, [7, 2]), episode(1, [7, 2])]}
    rows, text = told_of(tmp_path, random=random, trained=trained)
    assert rows[""] == ["random", "trained", "trained - random, paired"]
    assert rows["collective return, apples"] == ["3.00 [0.52, 5.48]", "9.0 [1.5, 16.5]", "+6.0 [+1.0, +11.0]"]
    assert rows["survival, steps"] == ["900 [900, 900]", "900 [900, 900]", "+0 [+0, +0]"]
    assert rows["episodes"] == ["4", "4", ""]
    assert "mean over replicas [95 % interval by Student's t]" in text


def test_a_table_says_once_that_bounds_cut_intervals(tmp_path):
    unequal = {r: [episode(0, [1, 1], equality=value)] for r, value in enumerate([0.2, 0.9, 0.9])}
    rows, text = told_of(tmp_path, random=unequal)
    assert rows["equality (1 - Gini), 0 to 1"] == ["0.67 [0.00, 1.00]"]
    assert text.count("Bounds of a metric cut an interval where Student's t passes them.") == 1
    other = {r: [episode(0, [1, 1], equality=value)] for r, value in enumerate([0.0, 0.0, 0.9])}
    rows, _ = told_of(tmp_path, random=unequal, trained=other)
    assert rows["equality (1 - Gini), 0 to 1"][-1] == "-0.37 [-1.00, +0.81]", "two shares lie at most 1 apart"


def test_returns_that_are_not_finite_are_shown_as_such(tmp_path):
    endless = {
        r: [replace(episode(0, [1, 1]), return_=np.array([value, 1.0]))]
        for r, value in enumerate([np.inf, -np.inf, 1.0])
    }
    rows, _ = told_of(tmp_path, random=endless, trained=dict.fromkeys(range(3), endless[0]))
    assert rows["income of all agents together, apples"] == ["nan", "inf", "+nan"]


def test_a_policy_that_harvests_nothing_has_words_instead_of_nan(tmp_path):
    nan = float("nan")
    idle = [episode(number, [0, 0], equality=nan, sustainability=nan) for number in range(2)]
    busy = [episode(0, [2, 2], equality=1.0), episode(1, [0, 0], equality=nan, sustainability=nan)]
    rows, text = told_of(tmp_path, random=idle, trained=busy)
    assert rows["equality (1 - Gini), 0 to 1"] == [
        "undefined in all 2 episodes",
        "1.00, undefined in 1 of 2 episodes",
        "",
    ]
    assert "nan" not in text
    assert "random: nobody harvested anything, so equality and sustainability are undefined" in text


def test_the_outcome_comes_first_and_what_institutions_never_did_has_no_table(tmp_path):
    def governed(number, harvest, broken):
        nothing = {"fines": np.zeros(2), "transfers": np.zeros(2), "violations": np.array(broken)}
        return replace(episode(number, harvest), **nothing)

    idle, busy = (governed(0, harvest, [0, 0]) for harvest in ([1, 1], [90, 30]))
    _, text = told_of(tmp_path, random=[idle], trained=[busy])
    first = "trained: 120 (+118 beside random play); random play: 2.00 apples an episode, all agents together"
    assert text.splitlines()[0] == first
    assert "violations" not in text
    rows, text = told_of(tmp_path, random=[idle], trained=[governed(0, [9, 3], [2, 0])])
    assert rows["agent 0: violations"] == ["0", "2.00", "+2.00"]


@pytest.mark.parametrize("names", [["a"] * 9, ["commons_targets_10_decay_500k, gamma=0.997"] * 4, ["x" * 90]])
def test_every_table_fits_80_columns_and_loses_no_number(names):
    head = ["condition", *(f"return of {name}, apples" for name in names)]
    numbers = [
        f"1,{place}00 [1,{place}11, 1,{place}22], undefined in {place} of 160" for place in range(len(names))
    ]
    rows = [[f"a_long_name_of_a_condition={place}, {names[0]}", *numbers] for place in range(3)]
    bounds = ((place + 0.5, place + 0.1, place + 0.9) for place in range(len(names)))
    apart = (
        Estimate(value=value, low=low, high=high, replicas=3, differs=True) for value, low, high in bounds
    )
    rows.append(["marked", *(Change(one, "(of 3)") for one in apart)])
    output = io.StringIO()
    Console(file=output, width=80).print(TextTable("a heading " * 20, head, rows, "Bold: a note " * 20))
    text = output.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    for place in range(len(names)):
        assert text.count(f"[1,{place}11, 1,{place}22]") == 3
        assert text.count(f"undefined in {place}") == 3
        assert text.count(f"[+{place}.10, +{place}.90] * (of 3)") == 1
    assert text.count("condition=2") >= 1


def test_one_replica_has_no_interval_and_one_policy_no_baseline(tmp_path):
    rows, text = told_of(tmp_path, trained=[episode(0, [2, 1])])
    assert rows["collective return, apples"] == ["3.00"]
    assert rows[""] == ["trained"]
    assert "One replica: no interval." in text
    assert not {"nan", "baseline", "difference"} & set(re.findall(r"\w+", text))


def test_rewards_that_are_no_apples_have_a_row_of_their_own(tmp_path):
    fined = replace(episode(0, [3, 1]), return_=np.array([-1.0, 1.0]))
    rows, _ = told_of(tmp_path, random=[fined])
    assert rows["collective return, apples"] == ["4.00"]
    assert rows["income of all agents together, apples"] == ["0"]


def test_units_are_those_of_the_docs():
    lines = (ROOT / "docs" / "metrics.md").read_text().splitlines()
    table = [line.split("|")[1:3] for line in lines if line.startswith("| `social/")]
    units = {name.strip(" `").removeprefix("social/"): unit.strip() for name, unit in table}
    assert set(units) == {name for name in METRICS if "/" not in name} - {INCOME}
    for name, unit in units.items():
        assert METRICS[name].unit.startswith(unit.replace("0..1", "0 to 1"))


@pytest.mark.parametrize(
    ("name", "rewards", "told"),
    [
        ("survival_steps", "", "survival, steps"),
        ("agent_0/return", "apples", "agent 0: return, apples"),
        ("agent_0/return", "", "agent 0: return"),
        ("of_ones_own", "apples", "of_ones_own"),
    ],
)
def test_a_metric_is_called_by_the_same_words_with_its_unit_everywhere(name, rewards, told):
    assert with_unit(name, rewards=rewards) == told
    assert title("of_ones_own") == "of_ones_own"


def test_episodes_with_an_undefined_equality_of_incomes_are_counted(tmp_path):
    fined = [
        replace(
            episode(number, [2, 2]),
            fines=np.ones(2),
            metrics={"institutions/fines": 2.0, "income_equality": equality},
        )
        for number, equality in enumerate([0.5, float("nan"), 0.7])
    ]
    rows, _ = told_of(tmp_path, trained=fined)
    assert rows["equality of incomes, 0 to 1"] == ["0.60, undefined in 1 of 3 episodes"]
