"""The published results, and the agreement of our curves with them."""

import numpy as np
import pytest

from cprl import presets
from cprl.measuring.published import EXPERIMENTS, agreement, curve, published_experiment


def test_every_experiment_has_a_recipe_and_curves():
    assert [one.number for one in EXPERIMENTS] == [1, 2, 3, 4, 5]
    assert sum(len(one.curves) for one in EXPERIMENTS) == 10
    for one in EXPERIMENTS:
        assert one.recipe in (*presets.BOARDS, "two_against_random")
        for name in one.curves.values():
            episodes, values = curve(name)
            assert len(episodes) == len(values) > 700
            assert (np.diff(episodes) >= 0).all()
            assert episodes[-1] <= one.episodes
    assert published_experiment("commons").trained == 491.17
    assert published_experiment("my_own") is None


def test_the_curves_have_known_points_of_the_figures():
    episodes, values = curve("exp1/return")
    dip = (episodes > 200) & (episodes < 400)
    assert values[dip].min() == pytest.approx(104, abs=1)
    # The mean of experiment 5's own curve is 451, not the 491.17 of the table.
    assert np.trapezoid(*curve("exp5/efficiency")[::-1]) / 4742 == pytest.approx(451, abs=1)


def test_a_curve_agrees_with_itself_and_not_with_its_mirror_image():
    episodes, values = curve("exp3/return")
    same = np.interp(np.arange(6000), episodes, values)
    correlation, difference = agreement("exp3/return", same)
    assert correlation == pytest.approx(1.0, abs=1e-3)
    assert difference < 0.5
    correlation, difference = agreement("exp3/return", 10 - same)
    assert correlation == pytest.approx(-1.0, abs=1e-3)
    assert agreement("exp3/return", same[:1000] + 7)[1] == pytest.approx(7, abs=0.2)
    with pytest.raises(ValueError, match="20 episodes have 2 points of exp3/return; allowed: at least 10"):
        agreement("exp3/return", same[:20])
