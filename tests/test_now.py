"""The live label follows a course of apples, episode by episode, without knowing what comes."""

from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from cprl.measuring.now import Now
from cprl.measuring.series import Recent
from cprl.runs.curves import curves_of

RANDOM = 282.0
TRAGEDY = np.repeat([312, 413, 492, 534, 587, 629, 618, 572, 418, 373, 270], 10)
"""Apples of four DQN agents who explore for sixty episodes; issue 17."""
SIXTEEN_WORLDS = (
    *(318, 395, 322, 323, 437, 516, 438, 360, 266, 243, 217, 206),
    *(195, 193, 200, 191, 197, 190),
)
"""Mean apples of each 16 episodes of recipes/tragedy.py, whose random play gets 280; the last ones about."""
RESULTS = Path(__file__).parents[1] / "docs" / "results"


def labels(values, *, random_play=RANDOM):
    """The labels of a course, one after the other, each with the number of episodes that it lasts."""
    now = Now()
    now.random_play = random_play
    return [(label, len(list(same))) for label, same in groupby(map(now.add, values))]


def test_a_tragedy_is_seen_from_its_numbers_before_it_is_over():
    expected = [("begins", 9), ("steady", 4), ("rising", 56), ("steady", 14), ("falling", 27)]
    assert labels(TRAGEDY) == expected
    assert labels([*TRAGEDY, *[189] * 20])[-1] == ("below random play", 18)
    now = Now()
    for apples in TRAGEDY:
        now.add(apples)
    assert now.peak == pytest.approx(629.0, rel=0.01)
    assert now.mean == pytest.approx(np.mean(TRAGEDY[-11:]))


@pytest.mark.parametrize(
    ("levels", "random_play", "expected"),
    [
        ((300, 600, 350), RANDOM, "begins steady rising falling"),
        # A quarter of the loss regained is a recovery, which is over above the peak, or a fall again.
        ((600, 300, 450, 700, 700), RANDOM, "begins steady falling recovering rising"),
        ((600, 300, 500, 300), RANDOM, "begins steady falling recovering falling"),
        # Without random play the first running mean stands for it; the same fall is a third of a larger lead.
        ((300, 600, 420), None, "begins steady rising falling"),
        ((300, 600, 420), -1000.0, "begins steady rising steady"),
        ((-150, -190), -153.0, "begins steady below random play"),
        ((0, 0), 0.0, "begins steady"),
    ],
)
def test_a_course_is_judged_by_what_it_gains_loses_and_regains(levels, random_play, expected):
    course = labels(np.repeat(levels, 20), random_play=random_play)
    assert " ".join(label for label, _ in course) == expected


def test_with_many_worlds_the_tragedy_is_seen_in_as_many_episodes_as_with_one():
    now, seen = Now(worlds=16), []
    now.random_play = 280.0
    for group, apples in enumerate(SIXTEEN_WORLDS, 1):
        seen.append((16 * group, now.add(apples)))
        assert now.mean == pytest.approx(apples, rel=0.1)
    first = {label: episode for episode, label in reversed(seen)}
    assert set(first) == {"steady", "rising", "falling", "below random play"}
    assert first["steady"] == 16, "sixteen episodes are evidence enough"
    assert first["rising"] < first["falling"] < first["below random play"] < 170
    assert dict(seen)[96] == "rising", "where the agents get most"
    assert all(label == "below random play" for episode, label in seen if episode >= 170)


def test_a_mean_counts_episodes_whatever_the_number_that_each_value_is_of():
    assert [Recent(10, each=worlds).window for worlds in (1, 3, 4, 10, 16, 256)] == [10, 4, 3, 1, 1, 1]
    recent = Recent(10, share=0.1, each=16)
    for value in range(40):
        recent.add(value)
    assert recent.window == 4, "a tenth of 640 episodes"


def test_noise_around_random_play_is_neither_rise_nor_fall():
    noise = RANDOM + np.random.default_rng(0).normal(0, 20, 500)
    assert labels(noise) == [("begins", 9), ("steady", 491)]


def test_a_published_length_run_rises_falls_and_recovers():
    means = curves_of(RESULTS / "commons_targets_10")["collective_return"].mean(0)
    course = " ".join(label for label, _ in labels(means))
    assert course == "begins steady rising steady falling recovering"


@pytest.mark.parametrize(
    ("epsilons", "expected"),
    [
        ([1.0, 1.0, 0.6, 0.3, 0.1, 0.1, 0.1], [True, True, True, True, True, False, False]),
        ([0.05, 0.05, 0.05], [None, False, False]),
        ([0.3, 0.2, 0.2], [None, True, False]),
        ([None, None], [None, None]),
    ],
)
def test_agents_explore_while_an_epsilon_falls_or_is_high(epsilons, expected):
    now, seen = Now(), []
    for epsilon in epsilons:
        now.add(5.0, None if epsilon is None else {"agent_0": epsilon, "agent_1": float("nan")})
        seen.append(now.explores)
    assert seen == expected


def test_the_recent_mean_is_of_a_share_of_the_values_so_far_but_of_some_at_least():
    recent = Recent(3, share=0.5)
    assert [recent.add(value) for value in range(10)] == [0, 0.5, 1, 2, 3, 4, 4.5, 5.5, 6, 7]
    assert recent.window == 5
    assert np.isnan(Recent(3).add(float("nan")))
