"""Statistics over replicas, compared with values computed by hand and with counted coverage."""

import numpy as np
import pytest
from scipy import stats

from cprl.measuring.statistics import curve_interval, difference, estimate, holm, judge_family


def test_intervals_are_by_student():
    values = [1.0, 2.0, 3.0, 4.0]
    found = estimate(values)
    # The table of t has 3.182 for three degrees of freedom; the standard error is sqrt(5 / 3) / 2.
    reach = 3.182 * (5 / 3) ** 0.5 / 2
    assert (found.value, found.replicas) == (2.5, 4)
    assert (found.low, found.high) == pytest.approx((2.5 - reach, 2.5 + reach), abs=1e-3)
    assert difference(values, [0.0] * 4, paired=True) == found


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([1234.0] * 2, "+1,234 [+1,234, +1,234]"),
        ([2.0] * 2, "+2.00 [+2.00, +2.00]"),
        ([-0.25], "-0.250"),
        ([0.0] * 2, "+0 [+0, +0]"),
        ([4e-6] * 2, "+4e-06 [+4e-06, +4e-06]"),
    ],
)
def test_an_estimate_has_the_digits_of_the_largest_of_its_numbers(values, text):
    assert f"{estimate(values):+}" == text
    assert str(estimate(values)) == text.replace("+", "")
    assert f"{estimate([1.5, 1.5]):.1f}" == "1.5 [1.5, 1.5]"


def test_one_replica_has_no_interval_and_values_that_are_not_finite_are_refused():
    alone = estimate([3.0])
    assert alone.value == 3.0
    assert np.isnan([alone.low, alone.high, alone.p_value]).all()
    for wrong in ([1.0, float("nan")], []):
        with pytest.raises(ValueError, match="values"):
            estimate(wrong)


def test_a_curve_has_an_interval_at_each_episode_where_several_replicas_have_a_value():
    curves = np.array([[1.0, 5.0, np.nan, np.nan], [3.0, 5.0, 2.0, np.nan], [5.0, 5.0, 4.0, np.nan]])
    middle, low, high = curve_interval(curves)
    for episode, values in enumerate(([1.0, 3.0, 5.0], [5.0, 5.0, 5.0], [2.0, 4.0])):
        alone = estimate(values)
        found = (middle[episode], low[episode], high[episode])
        assert found == pytest.approx((alone.value, alone.low, alone.high))
    assert np.isnan([middle[3], low[3], high[3]]).all()
    middle, low, high = curve_interval(curves[:1])
    assert middle[:2].tolist() == [1.0, 5.0]
    assert np.isnan([low, high]).all()


def test_p_values_are_those_of_t_tests_and_agree_with_intervals():
    values, reference = [3.0, 104.0, 208.0], [0.0, 100.0, 200.0]
    pairs, apart = (difference(values, reference, paired=paired) for paired in (True, False))
    assert pairs.p_value == pytest.approx(stats.ttest_rel(values, reference).pvalue)
    assert apart.p_value == pytest.approx(stats.ttest_ind(values, reference, equal_var=False).pvalue)
    at_the_bound = difference(values, [value + pairs.low for value in reference], paired=True)
    assert at_the_bound.p_value == pytest.approx(0.05)
    assert [estimate([value, value]).p_value for value in (0.0, 2.0)] == [1, 0]


@pytest.mark.parametrize(
    ("p_values", "differs"),
    [
        ([0.04], [True]),
        # Compared with 0.05 / 3, 0.05 / 2 and 0.05, from the smallest on.
        ([0.04, 0.01, 0.02], [True, True, True]),
        # 0.03 is above 0.05 / 2, so that 0.04 differs neither.
        ([0.04, 0.01, 0.03], [False, True, False]),
        ([0.02, 0.02, 0.02], [False, False, False]),
        # A single replica, which has no p-value, is no comparison.
        ([float("nan"), 0.024, 0.04], [False, True, True]),
        ([], []),
    ],
)
def test_of_several_differences_those_differ_that_holm_names(p_values, differs):
    assert holm(p_values).tolist() == differs


def test_differences_that_are_compared_together_are_judged_together():
    # Alone the second would differ too: its p-value is 0.046.
    pairs = {"a": [3.0, 3.1, 3.2], "b": [1.0, 1.5, 2.2], "c": [-1.0, 1.0, 0.5]}
    family = judge_family(
        {(name, "equality"): estimate(values) for name, values in pairs.items()}, ["condition"]
    )
    assert [round(one.p_value, 3) for one in family.values()] == [0.0, 0.046, 0.808]
    assert [one.differs for one in family.values()] == [True, False, False]
    assert family.tests == 3


def test_a_difference_within_a_margin_said_beforehand_is_none_and_its_reach_would_have_been_told():
    one = estimate([-0.5, 0.0, 0.5])
    # t of two degrees of freedom is 4.303, the standard error 0.5 / sqrt(3).
    assert one.reach == pytest.approx(4.303 * 0.5 / 3**0.5, abs=1e-3)
    assert one.is_within(1.3)
    assert not one.is_within(1.2)
    at_its_reach = estimate([value + one.reach for value in (-0.5, 0.0, 0.5)])
    assert at_its_reach.p_value == pytest.approx(0.05)
