"""Statistics over replicas, compared with values computed by hand and with counted coverage."""

import numpy as np
import pytest

from cprl.measuring.statistics import curve_interval, difference, estimate


def test_intervals_are_by_student():
    values = [1.0, 2.0, 3.0, 4.0]
    found = estimate(values)
    # The table of t has 3.182 for three degrees of freedom; the standard error is sqrt(5 / 3) / 2.
    reach = 3.182 * (5 / 3) ** 0.5 / 2
    assert (found.value, found.replicas) == (2.5, 4)
    assert (found.low, found.high) == pytest.approx((2.5 - reach, 2.5 + reach), abs=1e-3)
    assert difference(values, [0.0] * 4, paired=True) == found
    wider = estimate(values, confidence=0.99)
    assert wider.low < found.low < found.high < wider.high
    assert str(estimate([2.0, 2.0])) == "2 [2, 2]"


def test_one_replica_has_no_interval_and_values_that_are_not_finite_are_refused():
    alone = estimate([3.0])
    assert alone.value == 3.0
    assert np.isnan([alone.low, alone.high]).all()
    for wrong in ([1.0, float("nan")], []):
        with pytest.raises(ValueError, match="values"):
            estimate(wrong)


def test_a_curve_has_an_interval_at_each_episode():
    curves = np.array([[1.0, 5.0, np.nan, np.nan], [3.0, 5.0, 2.0, np.nan], [5.0, 5.0, 4.0, np.nan]])
    middle, low, high = curve_interval(curves)
    assert middle[:3].tolist() == [3.0, 5.0, 3.0]
    for episode, own in ((0, [1.0, 3.0, 5.0]), (1, [5.0, 5.0, 5.0]), (2, [2.0, 4.0])):
        alone = estimate(own)
        assert (low[episode], high[episode]) == pytest.approx((alone.low, alone.high))
    assert np.isnan([middle[3], low[3], high[3]]).all()
    middle, low, high = curve_interval(curves[:1])
    assert middle[:2].tolist() == [1.0, 5.0]
    assert np.isnan([low, high]).all(), "a single replica has no interval"
