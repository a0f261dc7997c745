"""Verdicts on made-up runs: curves drawn as ours are, curves of another process, and too few replicas."""

import numpy as np
import pytest

from cprl.measuring.shares import share
from cprl.reporting import verdicts
from cprl.reporting.verdicts import CONTRADICTED, NOT_CONTRADICTED

POINTS, WINDOW = 400, 20


def runs_like_ours(number, rng, *, spread=1.0, heavy=False):
    """Running means of a learning curve, [number, POINTS]: noise, and a level and a drift of each run."""
    noise = np.cumsum(np.pad(rng.normal(size=(number, POINTS + WINDOW - 1)), ((0, 0), (1, 0))), axis=1)
    level = rng.standard_t(3, (number, 1)) if heavy else rng.normal(size=(number, 1))
    drift = np.cumsum(rng.normal(size=(number, POINTS)), axis=1) / np.sqrt(POINTS)
    own = (noise[:, WINDOW:] - noise[:, :-WINDOW]) / np.sqrt(WINDOW) + spread * (level + drift)
    return 100 + 60 * np.tanh(np.arange(POINTS) / 80) + 8 * own


def false_alarms(replicas, runs, *, repetitions=200, **how):
    """The share of curves drawn as ours are that are contradicted."""
    rng = np.random.default_rng([replicas, runs])
    found = []
    for _ in range(repetitions):
        drawn = runs_like_ours(replicas + runs, rng, **how)
        verdict = verdicts.of_curve(drawn[replicas:].mean(0), drawn[:replicas], runs=runs).verdict
        found.append(verdict == CONTRADICTED)
    return np.mean(found)


@pytest.mark.integration
@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("replicas", [4, 8])
@pytest.mark.parametrize("runs", [1, 2])
def test_a_curve_drawn_as_ours_are_is_seldom_contradicted(replicas, runs, heavy):
    """Of 200; with a rate of 5 % at most 19 are, with 99.8 % probability."""
    assert false_alarms(replicas, runs, heavy=heavy) <= 19 / 200


@pytest.mark.parametrize("runs", [1, 2])
def test_a_curve_a_fifth_above_ours_with_little_spread_is_contradicted(runs):
    """As experiment 3, ours a fifth too low: published 192, ours 155.7 with a standard deviation of 8."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        drawn = runs_like_ours(8 + runs, rng, spread=0.5)
        found = verdicts.of_curve(1.25 * drawn[8:].mean(0), drawn[:8], runs=runs)
        assert found.verdict == CONTRADICTED
        assert found.deviation > found.limit > found.others[0]


def test_a_curve_that_dips_elsewhere_is_contradicted_if_no_replica_dips_there():
    rng = np.random.default_rng(2)
    drawn = runs_like_ours(9, rng, spread=0.5)
    dip = np.exp(-(((np.arange(POINTS) - 200) / 20) ** 2))
    assert verdicts.of_curve(drawn[8] - 100 * dip, drawn[:8]).verdict == CONTRADICTED
    assert verdicts.of_curve(drawn[8], drawn[:8]).verdict == NOT_CONTRADICTED


@pytest.mark.parametrize("runs", [1, 2])
def test_two_replicas_tell_nothing(runs):
    drawn = runs_like_ours(2, np.random.default_rng(3))
    assert verdicts.of_curve(0 * drawn[0], drawn, runs=runs).verdict == "cannot be told with 2 runs"
    assert verdicts.of_number(1e9, np.array([1.0, 2.0])) == "cannot be told with 2 runs"
    assert verdicts.of_number(1.0, np.array([1.0])) == "cannot be told with 1 run"


def test_replicas_that_are_all_equal_are_held_against_the_error_of_reading():
    """Ours survive 1000 steps throughout; the published curve reads 1002 of them, then falls to 600."""
    ours = np.full((8, 100), 1000.0) + np.random.default_rng(4).normal(0, 0.5, (8, 100)).round(0)
    read = np.full(100, 1002.0)
    read[99] = 600
    ours[:, 99] = np.linspace(500, 700, 8)
    assert verdicts.of_curve(read, ours).verdict == NOT_CONTRADICTED
    read[50:] = 600
    assert verdicts.of_curve(read, ours).verdict == CONTRADICTED


def test_the_deviation_is_the_distance_in_standard_errors():
    # Two others, 0 and 2: mean 1, variance 2; of one run 2 (1 + 1 / 2) = 3, and the distances are 3 and 0.
    others = np.array([[0.0, 0.0], [2.0, 2.0]])
    found = verdicts.deviation(np.array([4.0, 1.0]), others, runs=1)
    assert found == pytest.approx(np.sqrt((9 / 3 + 0) / 2))


def test_a_number_is_contradicted_outside_the_prediction_interval():
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0])  # of one run 3 +- 4.81, of two 3 +- 3.67
    assert verdicts.of_number(7.0, values) == NOT_CONTRADICTED
    assert verdicts.of_number(7.0, values, runs=2) == CONTRADICTED


def test_a_claim_of_a_direction_is_judged_by_the_side_of_the_interval():
    assert verdicts.of_claim(0.1, 2.0, above=0, replicas=8) == NOT_CONTRADICTED
    assert verdicts.of_claim(-2.0, -0.1, above=0, replicas=8) == CONTRADICTED
    assert verdicts.of_claim(-2.0, -0.1, below=0, replicas=8) == NOT_CONTRADICTED
    assert verdicts.of_claim(0.5, 0.9, below=0.4, replicas=8) == CONTRADICTED
    assert verdicts.of_claim(-1.0, 1.0, above=0, replicas=8) == "cannot be told with 8 runs"
    assert verdicts.of_claim(0.1, 2.0, above=0, replicas=3) == "cannot be told with 3 runs"


def test_a_claim_of_likeness_is_judged_by_where_the_interval_lies():
    assert verdicts.of_likeness(0.9, 1.1, within=(0.8, 1.2), replicas=8) == NOT_CONTRADICTED
    assert verdicts.of_likeness(1.3, 1.5, within=(0.8, 1.2), replicas=8) == CONTRADICTED
    assert verdicts.of_likeness(1.1, 1.3, within=(0.8, 1.2), replicas=8) == "cannot be told with 8 runs"


def test_what_runs_show_as_a_rule_is_judged_by_the_share_that_do():
    assert verdicts.of_share(share(8, 8)) == NOT_CONTRADICTED
    assert verdicts.of_share(share(0, 8)) == CONTRADICTED
    assert verdicts.of_share(share(2, 8)) == "cannot be told with 8 runs", "[0.03, 0.65] holds a half"
    assert verdicts.of_share(share(30, 96)) == CONTRADICTED
