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


def test_published_curves_have_no_power_where_running_means_of_their_window_have_none():
    """A running mean over w episodes of anything has nulls at the frequencies k / w."""
    for study in EXPERIMENTS:
        for name in study.curves.values():
            episodes, values = curve(name)
            at = np.arange(np.ceil(episodes[0]), episodes[-1])
            steps = np.diff(np.interp(at, episodes, values))
            power = np.abs(np.fft.rfft(steps * np.hanning(len(steps)))) ** 2
            frequency = np.fft.rfftfreq(len(steps))
            seen = (frequency > 0.002) & (frequency < 0.06)

            def cost(window, power=power[seen], frequency=frequency[seen]):
                """Minus the log likelihood (Whittle), of increments of running means of white noise."""
                expected = np.sin(np.pi * frequency * window) ** 2 + 0.05
                return np.log((power / expected).mean()) + np.log(expected).mean()

            assert min(range(15, 251, 5), key=cost) == study.window_episodes, name
