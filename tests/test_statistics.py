"""Statistics over replicas, compared with values computed by hand and with counted coverage."""

import numpy as np
import pytest

from cprl.measuring.statistics import (
    curve_interval,
    difference,
    estimate,
    excluded_by_chance,
    inter_quartile_mean,
)


def test_the_inter_quartile_mean_ignores_a_quarter_at_each_end():
    # Of 8 values it ignores two at each end: (3 + 4 + 5 + 6) / 4.
    assert inter_quartile_mean([-1000, 2, 3, 4, 5, 6, 7, 9999]) == 4.5
    assert inter_quartile_mean([[1, 2, 3], [4, 5, 6]]).tolist() == [2.0, 5.0], "of 3 values it ignores none"


def test_an_estimate_is_the_mean_with_an_interval_around_it():
    values = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 12.0]
    found = estimate(values, interval="bca")
    assert (found.value, found.replicas) == (5.0, 8)
    assert 1.0 < found.low < 5.0 < found.high < 12.0
    assert estimate(values, interval="bca") == found, "the same seed gives the same interval"
    wider = estimate(values, interval="bca", confidence=0.99)
    assert wider.low < found.low < found.high < wider.high
    assert estimate(values, statistic="iqm").value == 4.5
    assert str(estimate([2.0, 2.0])) == "2 [2, 2]"


def test_intervals_are_by_student_unless_something_else_is_asked_for():
    values = [1.0, 2.0, 3.0, 4.0]
    found = estimate(values)
    # The table of t has 3.182 for three degrees of freedom; the standard error is sqrt(5 / 3) / 2.
    reach = 3.182 * (5 / 3) ** 0.5 / 2
    assert (found.low, found.high) == pytest.approx((2.5 - reach, 2.5 + reach), abs=1e-3)
    assert estimate(values, interval="t") == found
    assert difference(values, [0.0] * 4, paired=True) == found
    iqm = estimate(values, statistic="iqm")
    assert iqm == estimate(values, statistic="iqm", interval="bca"), "which have no interval by t"


def test_bootstrapped_intervals_contain_the_true_mean_about_as_often_as_their_confidence_says():
    rng = np.random.default_rng(3)
    samples = rng.gamma(4.0, 1.0, (200, 12))  # a skewed distribution with mean 4
    held = [
        found.low <= 4.0 <= found.high
        for found in (estimate(own, interval="bca", resamples=500) for own in samples)
    ]
    # With 12 replicas the coverage of bootstrap intervals is known to be slightly below 95 %.
    assert 0.86 <= np.mean(held) <= 0.98


def test_strata_have_the_same_weight_and_are_resampled_separately():
    few, many = [0.0, 2.0], [100.0] * 50 + [102.0] * 50
    found = estimate(few, many, interval="bca")
    assert found.value == pytest.approx((1.0 + 101.0) / 2)
    # The second hardly moves the interval: that of the first alone, halved, is (0 .. 2) / 2.
    assert found.low == pytest.approx(50.5, abs=0.2)
    assert found.high == pytest.approx(51.5, abs=0.2)


def test_one_replica_has_no_interval_and_values_that_are_not_finite_are_refused():
    alone = estimate([3.0])
    assert alone.value == 3.0
    assert np.isnan([alone.low, alone.high]).all()
    with pytest.raises(ValueError, match=r"values is \[1\.0, nan\]; allowed: finite numbers"):
        estimate([1.0, float("nan")])
    with pytest.raises(ValueError, match=r"values is \[0\]; allowed: \[R\]"):
        estimate([])
    with pytest.raises(ValueError, match="there are no values"):
        estimate()
    with pytest.raises(ValueError, match="confidence is 95"):
        estimate([1.0, 2.0], confidence=95)


def test_a_curve_has_an_interval_at_each_episode():
    curves = np.array([[1.0, 5.0, np.nan, np.nan], [3.0, 5.0, 2.0, np.nan], [5.0, 5.0, 4.0, np.nan]])
    middle, low, high = curve_interval(curves)
    assert middle[:3].tolist() == [3.0, 5.0, 3.0]
    for episode, own in ((0, [1.0, 3.0, 5.0]), (1, [5.0, 5.0, 5.0]), (2, [2.0, 4.0])):
        alone = estimate(own, interval="t")
        assert (low[episode], high[episode]) == pytest.approx((alone.low, alone.high))
    assert np.isnan([middle[3], low[3], high[3]]).all()
    middle, low, high = curve_interval(curves[:1])
    assert middle[:2].tolist() == [1.0, 5.0]
    assert np.isnan([low, high]).all(), "a single replica has no interval"
    with pytest.raises(ValueError, match=r"curves is \[4\]; allowed: \[R, E\]"):
        curve_interval(curves[0])


def test_what_is_said_of_chance_is_about_what_happens_by_chance():
    rng = np.random.default_rng(0)
    for replicas, cases, told in ((2, 2, "two"), (4, 5, "five"), (9, 9, "eight")):
        excluded = 0
        for _ in range(200):
            one, other = rng.normal(size=(2, replicas))
            found = difference(one, other, paired=True, interval="bca")
            excluded += found.low > 0 or found.high < 0
        assert excluded / 200 == pytest.approx(1 / cases, abs=0.08)
        assert excluded_by_chance("bca", replicas) == f"one in {told}"
        assert excluded_by_chance("t", replicas) == "one in twenty"
    assert excluded_by_chance("bca", 1000) == "one in twenty"
    for wrong in (("sd", 4), ("t", 0)):
        with pytest.raises(ValueError, match="allowed"):
            excluded_by_chance(*wrong)
