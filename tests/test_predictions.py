"""Prediction intervals, shares and windows of running means, against numbers by hand and made-up runs."""

import numpy as np
import pytest

from cprl.measuring.predictions import curve_prediction, prediction
from cprl.measuring.published import EXPERIMENTS, curve
from cprl.measuring.running_means import estimate_window
from cprl.measuring.shares import share


def test_a_prediction_interval_is_wider_than_that_of_the_mean_by_the_scatter_of_the_runs():
    # Mean 3, standard deviation sqrt(2.5) = 1.5811; t of 4 degrees of freedom at 97.5 % = 2.7764.
    values = [1.0, 2.0, 3.0, 4.0, 5.0]
    of_mean, of_one, of_two = (prediction(values, runs=runs) for runs in (None, 1, 2))
    assert of_mean.high - 3 == pytest.approx(2.7764 * 1.5811 * np.sqrt(1 / 5), abs=1e-3)
    assert of_one.high - 3 == pytest.approx(2.7764 * 1.5811 * np.sqrt(1 / 5 + 1), abs=1e-3)
    assert of_two.high - 3 == pytest.approx(2.7764 * 1.5811 * np.sqrt(1 / 5 + 1 / 2), abs=1e-3)
    assert 3 - of_one.low == pytest.approx(of_one.high - 3)
    assert 7.8 in of_one
    assert 7.9 not in of_one
    assert str(of_mean) == "[1.037, 4.963]"


@pytest.mark.parametrize("runs", [1, 2])
@pytest.mark.parametrize("replicas", [3, 8])
def test_further_runs_lie_in_the_interval_as_often_as_its_confidence_says(runs, replicas):
    rng = np.random.default_rng(replicas)
    known = rng.normal(100, 20, (replicas, 20_000))  # 20,000 repetitions side by side, as episodes of a curve
    further = rng.normal(100, 20, (runs, 20_000)).mean(0)
    _, low, high = curve_prediction(known, runs=runs)
    assert np.mean((low <= further) & (further <= high)) == pytest.approx(0.95, abs=0.005)


def test_a_curve_has_an_interval_where_two_replicas_are_defined():
    curves = np.array([[1.0, 5.0, np.nan, np.nan], [3.0, 5.0, 2.0, np.nan]])
    middle, low, high = curve_prediction(curves)
    assert middle[:3].tolist() == [2.0, 5.0, 2.0]
    assert (low[1], high[1]) == (5.0, 5.0)
    assert np.isnan([low[2], high[2], middle[3], high[3]]).all()
    assert str(prediction([3.0])) == ""
    with pytest.raises(ValueError, match=r"curves is \[4\]; allowed: \[R, E\]"):
        curve_prediction(curves[0])
    with pytest.raises(ValueError, match=r"values is \[1\.0, nan\]; allowed: finite numbers"):
        prediction([1.0, np.nan])
    with pytest.raises(ValueError, match="runs is 0; allowed: "):
        prediction([1.0, 2.0], runs=0)
    with pytest.raises(ValueError, match="confidence is 95; allowed: above 0, below 1"):
        prediction([1.0, 2.0], confidence=95)


def test_shares_have_the_interval_of_clopper_and_pearson():
    # None of 8: the upper bound p has (1 - p)**8 = 0.025, so p = 1 - 0.025**(1 / 8) = 0.3694.
    none, some, all_ = share(0, 8), share(2, 8), share(8, 8)
    assert (none.low, none.high) == (0.0, pytest.approx(0.3694, abs=1e-4))
    assert (all_.low, all_.high) == (pytest.approx(1 - 0.3694, abs=1e-4), 1.0)
    # 2 of 8: P(at least 2) at the lower bound and P(at most 2) at the upper one are 0.025 each.
    assert (some.low, some.high) == (pytest.approx(0.0319, abs=1e-4), pytest.approx(0.6509, abs=1e-4))
    assert str(some) == "2 of 8 [0.03, 0.65]"
    with pytest.raises(ValueError, match="shown is 9; allowed: an integer from 0 to 8"):
        share(9, 8)


def drawn_curve(window, noise, seed, *, wandering):
    """A running mean over a learning curve with noise, as read off a figure: 830 points, 300 pixels high."""
    rng = np.random.default_rng(seed)
    episodes = 100 + 80 * np.tanh(np.arange(6000) / 800) + rng.normal(0, noise, 6000)
    episodes += wandering * noise * np.cumsum(rng.normal(size=6000))
    sums = np.cumsum(np.concatenate([[0.0], episodes]))
    means = (sums[window:] - sums[:-window]) / window
    at = np.linspace(0, len(means) - 1, 830)
    values = np.interp(at, np.arange(len(means)), means)
    pixel = np.ptp(values) / 300
    return at, np.round(values / pixel) * pixel


@pytest.mark.parametrize("window", [20, 30, 50, 75, 100, 150, 200])
@pytest.mark.parametrize("wandering", [0.0, 0.05])
def test_the_windows_of_made_up_curves_are_found(window, wandering):
    """All of 420: 7 windows, without and with a level that wanders, 3 levels of noise, 10 seeds."""
    found = [
        estimate_window(*drawn_curve(window, noise, seed, wandering=wandering)).window_episodes
        for noise in (10, 30, 60)
        for seed in range(10)
    ]
    assert found == [window] * 30


def test_the_windows_of_the_published_curves_are_found():
    for study in EXPERIMENTS:
        for name in study.curves.values():
            found = estimate_window(*curve(name))
            assert found.window_episodes == study.window_episodes, name
            assert found.nats[100] > 50, name
            assert 0 < found.better_by_nats <= min(found.nats[100], found.nats[200]), name


def test_windows_of_what_is_no_curve_are_refused():
    at = np.arange(2000.0)
    with pytest.raises(ValueError, match=r"episodes is \[2000\] and values \[3\]; allowed: \[P\] both"):
        estimate_window(at, [1.0, 2.0, 3.0])
    with pytest.raises(
        ValueError, match="episodes are 0 to 500; allowed: at least 1000, four of the longest"
    ):
        estimate_window(at[:501], at[:501])
    with pytest.raises(ValueError, match=r"episodes is .*; allowed: at least two, finite and ascending"):
        estimate_window(at[::-1], at)
    with pytest.raises(ValueError, match="windows is 1; allowed: "):
        estimate_window(at, at, windows=[1, 30])
